"""Motion of a scene or region with few numbers: translation, affine or perspective, with acceleration.

The velocity is a weighted sum of generators, fixed fields: two shifts, four linear fields (affine motion), and two
quadratic ones (the generators of a homography: a plane that tilts). Weights that the recording does not support stay 0:
a richer model is taken only where it explains more than noise would (score test, `_supported`), or where a fit starts
from one.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import gaussian_filter

from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.estimators.settings import ParametricSettings
from scsr_opt.motion.inversion import Corner, corner_of, in_turn
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.trajectory import Motion

# The generators of a homography, and which of them are shifts, linear and quadratic in position.
_GENERATORS = 8
_SHIFTS, _LINEAR, _QUADRATIC = slice(0, 2), slice(2, 6), slice(6, 8)


def generators(position: Float[np.ndarray, "2 *n"], height: int, width: int) -> Float[np.ndarray, "8 2 *n"]:
    """The generators, velocity fields whose weighted sums are the motions considered, at (row, column) of a picture of
    `height` × `width` pixels.

    With ρ, γ the row and column from the picture's middle over its longer side: (1, 0), (0, 1); (ρ, 0), (γ, 0), (0, ρ),
    (0, γ); (ρ², ργ), (ργ, γ²).
    """
    ρ = (position[0] - (height - 1) / 2) / max(height, width)
    γ = (position[1] - (width - 1) / 2) / max(height, width)
    one, none = np.ones_like(ρ), np.zeros_like(ρ)
    down = (one, none, ρ, γ, none, none, ρ * ρ, ρ * γ)
    right = (none, one, none, none, ρ, γ, ρ * γ, γ * γ)
    return np.stack([np.stack(down), np.stack(right)], axis=1).astype(np.float32)


def parametric(
    pictures: MotionFrames,
    *,
    affine: bool = True,
    perspective: bool = True,
    start: Motion | None = None,
    where: Bool[np.ndarray, "h w"] | None = None,
    fitted: bool = False,
    sparse: bool = False,
    settings: MotionSettings = DEFAULTS,
) -> Motion:
    """One velocity and acceleration for the whole scene, or fields of them that are affine or those of a tilting plane.

    Minimises the variance of the pictures along the motion by Gauss–Newton, from near times to far ones. Points have
    less weight where the variance stays high (another motion, occlusion), and where the scene moves by a pixel or more
    from spike to spike or fires only a few times (what passes between two spikes looks as if it stood still). The
    motion has 2 numbers for a translation, 6 if affine, 8 if perspective, and twice as many with the acceleration,
    which is fitted last; each group only where a score test supports it.

    **Arguments:**
    - `affine`, `perspective`: whether the motion may be so.
    - `start`: a first velocity: its mean, or, where it varies, the affine field nearest to it, whose numbers are then
      all fitted.
    - `where`: the key frame's pixels to which the motion is fitted; all if None. A region is too small for
      perspective, which is then left out. The motion is given everywhere.
    - `fitted`: `start` was fitted to other pixels before: it is fitted to all moments once, at up to four times as many
      points.
    - `sparse`: whether most steps are done with a quarter of the points.

    **Returns:** the `Motion`, of confidence 1.
    """
    height, width = pictures.picture.shape[1:]
    options, after = settings.parametric, np.asarray(pictures.after)
    points = _points(height, width, where, pictures.firing, all_points=fitted, settings=options)
    few = points.quarter if sparse and points.region.sum() > 3 * options.least_points else None
    fields = generators(np.mgrid[0:height, 0:width].astype(np.float32), height, width)
    longest = float(np.abs(after).max())
    numbers, active = _start_numbers(fields, start, where, affine=affine, longest=longest, settings=options)
    share = options.agreeing_share if where is None else options.agreeing_share_region
    for level in _levels(after, whole=where is None, last_only=fitted, settings=settings):
        blurred = pictures.presmoothed(level.sigma)
        fits = [(points, level.steps)]
        # Near times only give a start for far ones, and some of the points go most of the way.
        if few is not None:
            fits = [(few, level.steps)] + ([(points, level.steps // options.sparse_step_divisor)] if level.last else [])

        def fit(
            numbers: Float[np.ndarray, "2 8"],
            active: Bool[np.ndarray, "2 8"],
            level: _Level = level,
            blurred: Float[Array, "n h w"] = blurred,
            fits: list[tuple[_Points, int]] = fits,
        ) -> tuple[Float[np.ndarray, "2 8"], _Equations]:
            found = numbers
            for some, steps in fits:
                limits = _Limits(steps, level.tolerance, share)
                found, equations = _fit(blurred, after, level.interval, some, found, active, limits, options)
            return found, equations

        numbers, equations = fit(numbers, active)
        richer = [(0, _LINEAR)] if affine else []
        richer += [(0, _QUADRATIC)] if affine and perspective and level.last and where is None else []
        for order, group in richer:
            if not active[order, group].any() and _supported(equations, active, (order, group), options):
                active[order, group] = True
                numbers, equations = fit(numbers, active)
        if level.last and after.size >= 4 and _supported(equations, active, (1, active[0]), options):
            active[1] = active[0]
            numbers, equations = fit(numbers, active)
    velocity, acceleration = np.einsum("op,pchw->ochw", numbers, fields)
    return Motion(velocity, acceleration, np.ones((height, width), np.float32))


def _start_numbers(
    fields: Float[np.ndarray, "8 2 h w"],
    start: Motion | None,
    where: Bool[np.ndarray, "h w"] | None,
    *,
    affine: bool,
    longest: float,
    settings: ParametricSettings,
) -> tuple[Float[np.ndarray, "2 8"], Bool[np.ndarray, "2 8"]]:
    """Numbers of velocity and acceleration nearest to a start, and which of them are fitted."""
    numbers, active = np.zeros((2, _GENERATORS), np.float32), np.zeros((2, _GENERATORS), bool)
    active[0, _SHIFTS] = True
    if start is not None:
        here = np.ones(fields.shape[2:], bool) if where is None else where
        known, basis = start.velocity[:, here].reshape(2, -1), fields[:, :, here].reshape(_GENERATORS, -1)
        varies = float(np.ptp(known, axis=1).max() * longest) if known.size else 0.0
        active[0, _LINEAR] = affine and varies > settings.varying_px
        numbers[0, active[0]] = np.linalg.lstsq(basis[active[0]].T, known.ravel(), rcond=None)[0]
    return numbers, active


class _Level(NamedTuple):
    """A level of the coarse-to-fine search: the `interval` of pictures that take part, first to last (exclusive); their
    presmoothing `sigma`, sensor pixels; Gauss–Newton `steps` at most; the `tolerance`, sensor pixels at the farthest
    moment, at which these end; whether it is the `last` one."""

    interval: Int[np.ndarray, " 2"]
    sigma: float
    steps: int
    tolerance: float
    last: bool


def _levels(
    after: Float[np.ndarray, " n"], *, whole: bool, last_only: bool, settings: MotionSettings
) -> Iterator[_Level]:
    """The levels that have two pictures or more; without the nearest times if not for the `whole` scene, where a start
    is known."""
    options, reaches = settings.parametric, (*settings.comparison.near_times_frames, np.inf)
    levels = list(zip(reaches, options.presmoothing_px, options.most_steps, strict=True))
    for reach, sigma, steps in levels[-1:] if last_only else levels if whole else levels[1:]:
        near = np.flatnonzero(np.abs(after) <= reach)
        if near.size < 2:
            continue
        interval = np.array((int(near[0]), int(near[-1]) + 1), np.int32)
        last = reach == np.inf
        tolerance = options.step_tolerance * sigma * (options.last_tolerance_ratio if last else 1.0)
        yield _Level(interval, sigma, steps, tolerance, last)


class _Points(NamedTuple):
    """Points of the key frame at which pictures are compared.

    **Fields:** `position` (2, n), halfway between pixels, where the slope of bilinear interpolation is that of both
    sides; `fields` (8, 2, n), the generators there; `block`, the number of the picture's block; `region` 1, or 0 for an
    entry that only pads; `interval`, frames from spike to spike, 0 where these are not taken into account.
    """

    position: Float[np.ndarray, "2 n"]
    fields: Float[np.ndarray, "8 2 n"]
    block: Int[np.ndarray, " n"]
    region: Float[np.ndarray, " n"]
    interval: Float[np.ndarray, " n"]

    @property
    def quarter(self) -> "_Points":
        """Every fourth point."""
        return _Points(*(of[..., ::4] for of in self))


def _points(
    height: int,
    width: int,
    where: Bool[np.ndarray, "h w"] | None,
    firing: Float[np.ndarray | Array, "h w"] | None,
    *,
    all_points: bool = False,
    settings: ParametricSettings,
) -> _Points:
    """Points spread evenly over the pixels `where`: a quarter of them or more, or `all_points`; at most `most_points`.
    `firing`: spikes per frame."""
    inner = np.ones((height - 1, width - 1), bool) if where is None else where[:-1, :-1]
    row, column = np.nonzero(inner)
    size = settings.least_points
    while (size if all_points else 4 * size - 1) < min(row.size, settings.most_points):
        size *= 4
    # Spread evenly, whatever their number (the additive recurrence by powers of the plastic number, Roberts 2018).
    # Points that are symmetric in a mirrored picture lost 1 dB on one still in five (docs/decisions/0001).
    if row.size > size:
        chosen = (row * 0.7548776662 + column * 0.5698402910) % 1 < size / row.size
        row, column = row[chosen], column[chosen]
    row, column = row[:size], column[:size]
    blocks = settings.blocks_per_side

    def block(of: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        first, extent = (int(of.min()), int(np.ptp(of)) + 1) if of.size else (0, 1)
        return (of - first) * blocks // extent

    pad = (0, size - row.size)
    row, column, block_of = (np.pad(v, pad) for v in (row, column, block(row) * blocks + block(column)))
    position = np.stack([row, column]).astype(np.float32) + np.float32(0.5)
    region = np.pad(np.ones(size - pad[1], np.float32), pad)
    interval = np.zeros(size, np.float32)
    # Not in a region: it may hold several surfaces, and the rate of firing then says which, not how well it is seen.
    if firing is not None and where is None:
        around = gaussian_filter(np.asarray(firing), settings.firing_window_px, mode="nearest")[row, column]
        interval = 1 / np.maximum(around, settings.least_firing_rate)
    return _Points(position, generators(position, height, width), block_of.astype(np.int32), region, interval)


def shows_global_motion(pictures: MotionFrames, settings: MotionSettings = DEFAULTS) -> bool:
    """Whether the recording supports an affine motion of the whole scene against rest.

    A score test without a fit. All pixels together detect motion that is far too slow for any one of them to contradict
    rest: a pan by 0.15 sensor pixels over 101 frames by day.
    """
    _, height, width = pictures.picture.shape
    options = settings.parametric
    after, none = np.asarray(pictures.after), np.zeros((2, _GENERATORS), bool)
    if after.size < 2:  # one picture shows no motion
        return False
    _, equations = _fit(
        pictures.presmoothed(options.presmoothing_px[-1]), after, np.array((0, after.size), np.int32),
        _points(height, width, None, pictures.firing, settings=options), np.zeros(none.shape, np.float32), none,
        _Limits(0, 0.0, options.agreeing_share), options,
    )  # fmt: skip
    return _supported(equations, none, (0, slice(_SHIFTS.start, _LINEAR.stop)), options)


class _Equations(NamedTuple):
    """Normal equations at the end of a fit, over all numbers, velocity's generators, then acceleration's: the `matrix`,
    and the right-hand side (negative gradient) of each block of the picture."""

    matrix: Float[np.ndarray, "16 16"]
    gradients: Float[np.ndarray, "blocks 16"]


def _supported(
    equations: _Equations,
    active: Bool[np.ndarray, "2 8"],
    group: tuple[int, slice | Bool[np.ndarray, " 8"]],
    settings: ParametricSettings,
) -> bool:
    """Whether a `group` of more numbers explains more than noise does: a score test (Rao, 1948) that is robust to noise
    that is not white.

    The variance of the gradient from block to block gives the uncertainty of the whole gradient, whatever the
    correlation of the noise within a block (White, 1982); with b blocks and p numbers, Hotelling's T² takes the place
    of χ².
    """
    further = np.zeros_like(active)
    further[group] = True
    known, tested = np.flatnonzero(active.ravel()), np.flatnonzero(further.ravel())
    matrix, gradients = equations
    gradients = gradients[np.abs(gradients).sum(1) > 0]
    scale = 1 / np.sqrt(np.diag(matrix) + 1e-30)
    matrix, gradients = matrix * scale[:, None] * scale, gradients * scale
    # The part of each block's gradient that the numbers already fitted do not answer.
    answer = np.linalg.lstsq(matrix[np.ix_(known, known)], matrix[np.ix_(known, tested)], rcond=1e-9)[0]
    left = gradients[:, tested] - gradients[:, known] @ answer
    blocks, numbers = left.shape
    if blocks < 2 * numbers:
        return False
    statistic = left.sum(0) @ np.linalg.pinv(left.T @ left, rcond=1e-9, hermitian=True) @ left.sum(0)
    return bool(statistic * (blocks - numbers) / blocks > settings.score_per_number * numbers)


class _Limits(NamedTuple):
    """Limits of a fit: the `steps` at most; the displacement at the farthest moment, sensor pixels, below which it has
    converged; and the share of the points whose residual sets the scale of outliers."""

    steps: int
    tolerance: float
    agreeing_share: float


def _fit(
    pictures: Float[Array, "n h w"],
    after: Float[np.ndarray, " n"],
    interval: Int[np.ndarray, " 2"],
    points: _Points,
    numbers: Float[np.ndarray, "2 8"],
    active: Bool[np.ndarray, "2 8"],
    limits: _Limits,
    settings: ParametricSettings,
) -> tuple[Float[np.ndarray, "2 8"], _Equations]:
    """Gauss–Newton over the `active` numbers, with the pictures from `interval[0]` up to `interval[1]`: the numbers,
    and the equations there."""
    longest = max(np.abs(after[[interval[0], interval[1] - 1]]).max(), 1)
    on = active.reshape(-1)
    # The key picture there, about which sums of squares are taken so that little is lost to rounding. Points lie
    # halfway between pixels.
    row, column = points.position.astype(int)
    key_picture = np.asarray(pictures)[np.abs(after).argmin()]
    about = (key_picture[row, column] + key_picture[row + 1, column]) / 2
    about = (about + (key_picture[row, column + 1] + key_picture[row + 1, column + 1]) / 2) / 2
    # Largest displacement at the farthest moment by a unit of each number: no generator is larger than 1.
    lever = np.array([[longest], [0.5 * longest**2]])
    last, times, moved = np.zeros(numbers.shape), 1.0, np.inf
    for done in range(limits.steps + 1):
        sums = _Sums(
            *map(np.asarray, _sums_along(pictures, after, interval, points.position, *_fields(numbers, points), about))
        )
        matrix, gradient = _normal_equations(sums, numbers, points, after, interval, limits.agreeing_share, settings)
        # The equations at the numbers found are those of a last turn without a step.
        if done >= limits.steps or moved <= limits.tolerance:
            break
        # Unit diagonal: velocities and accelerations differ by orders of magnitude. Slight damping keeps the step
        # finite where the picture has no texture.
        scale = np.where(on, 1 / np.sqrt(np.diag(matrix) + 1e-12), 0)
        scaled = matrix * scale[:, None] * scale + np.diag(np.where(on, 1e-6, 1))
        update = (np.linalg.solve(scaled, gradient.sum(1) * scale) * scale).reshape(numbers.shape)
        # Where each update is a constant share of the one before, as with weights that follow slowly, the sum of all
        # further ones is taken at once (Aitken, 1926, for vectors).
        now = update * lever
        share = np.sum(now * last) / max(np.sum(last**2), 1e-20)
        more = times / max(1 - share, 1e-6) if share < 1 else settings.growing_step_ratio
        times = float(np.clip(more, 1, settings.longest_step_ratio)) if done > 0 else 1.0
        moved = times * np.abs(now).max(1).sum()
        numbers, last = (numbers + times * update).astype(np.float32), now
    blocks = settings.blocks_per_side**2
    gradients = np.stack([np.bincount(points.block, of, blocks) for of in gradient], axis=1)
    return numbers, _Equations(matrix, gradients)


def _fields(numbers: Float[np.ndarray, "2 8"], points: _Points) -> Float[np.ndarray, "2 2 m"]:
    """Velocity and acceleration at the points."""
    return np.einsum("op,pcn->ocn", numbers, points.fields)


def _normal_equations(
    sums: "_Sums",
    numbers: Float[np.ndarray, "2 8"],
    points: _Points,
    after: Float[np.ndarray, " n"],
    interval: Int[np.ndarray, " 2"],
    agreeing_share: float,
    settings: ParametricSettings,
) -> tuple[Float[np.ndarray, "16 16"], Float[np.ndarray, "16 m"]]:
    """Matrix of the Gauss–Newton step, and the negative gradient of each point."""
    span = after[interval[1] - 1] - after[interval[0]]
    times, values = sums.times, sums.values
    # As in `drift`: the regressors τ and τ²/2 without their mean, and the residual about the mean.
    seen = np.maximum(times[0], np.float32(1e-6))
    first = np.stack([times[1], times[2] / 2])
    change = values[1:3] - first * (values[0] / seen)
    spread = np.array([[times[2], times[3] / 2], [times[3] / 2, times[4] / 4]]) - first[:, None] * first / seen
    mismatch = np.maximum(sums.squares - values[0] ** 2 / seen, 0) / seen
    # Cauchy weights: regions that move otherwise lose their weight as soon as the rest agrees.
    agreeing = mismatch[points.region > 0]
    wanted = max(int(np.ceil(agreeing_share * agreeing.size)) - 1, 0)
    usual = np.partition(agreeing, wanted)[wanted] if agreeing.size else np.float32(0)
    weight = points.region / (1 + (mismatch / (np.float32(settings.outlier_scale) * usual + np.float32(1e-12))) ** 2)
    # Motion between two spikes is not resolved: the scene looks as if it stood still.
    velocity = _fields(numbers, points)[0]
    weight /= 1 + (np.hypot(*velocity) * points.interval) ** 4
    # Points that fire seldom change seldom, as if they stood still, however slowly they move.
    weight /= 1 + (np.float32(settings.spanned_intervals) * points.interval / max(span, 1)) ** 4
    down, right = sums.slopes / seen
    regressors = down * points.fields[:, 0] + right * points.fields[:, 1]
    weighted = spread * weight
    matrix = np.block([[(regressors * weighted[q, r]) @ regressors.T for r in (0, 1)] for q in (0, 1)])
    return matrix.astype(float), -np.concatenate([regressors * (change[q] * weight) for q in (0, 1)])


class _Sums(NamedTuple):
    """Sums over the moments at each point: of τ⁰ to τ⁴, of the value times 1, τ and τ²/2, of its square, of its
    slopes."""

    times: Float[Array | np.ndarray, "5 m"]
    values: Float[Array | np.ndarray, "3 m"]
    squares: Float[Array | np.ndarray, " m"]
    slopes: Float[Array | np.ndarray, "2 m"]


@jax.jit
def _sums_along(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    interval: Int[Array, " 2"],
    position: Float[Array, "2 m"],
    velocity: Float[Array, "2 m"],
    acceleration: Float[Array, "2 m"],
    about: Float[Array, " m"],
) -> _Sums:
    """Sums over the pictures from `interval[0]` up to `interval[1]` along a motion; values less `about`.

    The pictures that take part are data, so that one compiled program serves all levels.
    """
    _, height, width = pictures.shape

    # Moment by moment, so that the sums stay in the cache.
    def place(b: Array) -> tuple[Corner, Array]:
        tau = after[b]
        row, column = (position[k] + tau * velocity[k] + 0.5 * tau**2 * acceleration[k] for k in (0, 1))
        inside = (row >= 0) & (column >= 0) & (row <= height - 1) & (column <= width - 1)
        return corner_of(row, column, height, width), inside.astype(row.dtype)

    def look(b: Array, placed: tuple[Corner, Array]) -> tuple[Array, tuple[Array, Array], Array]:
        corner, inside = placed
        return *_value_and_slope(pictures, b, corner), inside

    def add(b: Array, found: tuple[Array, tuple[Array, Array], Array], sums: list[Array]) -> list[Array]:
        tau, (value, slope, inside) = after[b], found
        value = (value - about) * inside
        more = [tau**k * inside for k in range(5)] + [factor * value for factor in (1, tau, tau**2 / 2, value)]
        more += [one * inside for one in slope]
        return [total + each for total, each in zip(sums, more, strict=True)]

    sums = in_turn(place, look, add, [jnp.zeros_like(about)] * 11, interval[0], interval[1])
    return _Sums(jnp.stack(sums[:5]), jnp.stack(sums[5:8]), sums[8], jnp.stack(sums[9:]))


def _value_and_slope(
    pictures: Float[Array, "n h w"], number: Array, at: Corner
) -> tuple[Float[Array, " m"], tuple[Float[Array, " m"], Float[Array, " m"]]]:
    """The picture of this `number`, interpolated bilinearly, and its slope down and to the right."""
    _, height, width = pictures.shape
    down, right = at.down, at.right
    # Indexed in the whole stack: slicing one picture first would copy it.
    flat, corner = pictures.reshape(-1), number * (height * width) + at.number
    a, b, c, d = (flat.at[corner + k].get(mode="promise_in_bounds") for k in (0, 1, width, width + 1))
    above, below = a + right * (b - a), c + right * (d - c)
    return above + down * (below - above), (below - above, (1 - down) * (b - a) + down * (d - c))
