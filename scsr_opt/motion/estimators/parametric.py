"""Motion of the whole scene with few numbers: translation, affine or perspective, with acceleration.

The velocity is a sum of generators, fields that are fixed: two shifts, four linear fields (affine motion), and two
quadratic ones (the generators of a homography: a plane that tilts). The numbers that the recording does not support
stay 0: a richer model is taken only where it explains more than the noise would (`_asked_for`), or where a fit starts
from one.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import gaussian_filter

from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.inversion import Corner, bilinear, corner_of, in_turn
from scsr_opt.motion.trajectory import Motion

# (frames from the key frame that take part, presmoothing in sensor pixels, most Gauss–Newton steps): from near and
# blurred to everything and sharp.
_SCHEDULE = ((8, 2.5, 10), (16, 1.5, 6), (32, 1.2, 5), (np.inf, 1.0, 12))
# Steps end when they move nothing by more than this at the farthest moment, in units of the presmoothing (the last ones
# go on to a tenth of it).
_SMALL = 0.02

# A start that varies by less than this over pixels and moments (sensor pixels) is a translation.
_VARIES = 0.1

# In a region that was found by contradicting something, a good part may belong to other surfaces: the motion is that of
# the share that agrees best, and the start is trusted enough to leave out the nearest times.
_MINORITY = 0.2

# Where a quarter of the points has led, all of them are looked at for so many times fewer steps.
_FEWER = 3

# Points of the key frame that are looked at. Presmoothed pictures change little from pixel to pixel: a sixth of a
# sensor of 400×250 says as much as all of it. There are few lengths, so that what was compiled once serves for each
# picture and region: these two, and four times the first.
_LEAST_POINTS, _POINTS = 1024, 16384
# The picture is cut into so many blocks each way, whose votes tell how certain a number is.
_BLOCKS = 16

_SHIFTS, _LINEAR, _QUADRATIC = slice(0, 2), slice(2, 6), slice(6, 8)
_GENERATORS = 8


def generators(position: Float[np.ndarray, "2 *n"], height: int, width: int) -> Float[np.ndarray, "8 2 *n"]:
    """The fields whose sums are the velocities considered, at (row, column) of a `height` × `width` picture.

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
) -> Motion:
    """One velocity (and acceleration) for the whole scene, or one that varies linearly or as a tilting plane's.

    Minimises the variance of the pictures along the motion, weighted down where it stays high (another motion,
    occlusion) and where the scene moves by a pixel or more from spike to spike or fires only a few times (what passes
    from spike to spike looks as if it stood still), by Gauss–Newton from near times to far ones. 2 numbers for a
    translation, 6 for affine motion, 8 for perspective motion, twice that with the acceleration that is fitted last;
    each of these only where the recording asks for it, and no more than `affine` and `perspective` allow. `start` gives
    a first velocity: its mean, or where it varies the affine one nearest to it, whose numbers are then all fitted. With
    `where`, only these pixels of the key frame are looked at, and perspective, for which a region is too small, is left
    out; the motion is still given everywhere. Where `start` was itself `fitted`, to other pixels, it is only fitted to
    all moments once more, at up to four times as many points. `sparse`: most of the way is gone with a quarter of the
    points.
    """
    height, width = pictures.picture.shape[1:]
    points = _points(height, width, where, pictures.firing, every=fitted)
    few = points.quarter if sparse and points.region.sum() > 3 * _LEAST_POINTS else None
    numbers = np.zeros((2, _GENERATORS), np.float32)
    active = np.zeros((2, _GENERATORS), bool)
    active[0, _SHIFTS] = True
    fields = generators(np.mgrid[0:height, 0:width].astype(np.float32), height, width)
    if start is not None:
        here = np.ones((height, width), bool) if where is None else where
        known, basis = start.velocity[:, here].reshape(2, -1), fields[:, :, here].reshape(_GENERATORS, -1)
        varies = float(np.ptp(known, axis=1).max() * np.abs(np.asarray(pictures.after)).max()) if known.size else 0.0
        active[0, _LINEAR] = affine and varies > _VARIES
        numbers[0, active[0]] = np.linalg.lstsq(basis[active[0]].T, known.ravel(), rcond=None)[0]
    schedule, majority = (_SCHEDULE, 0.5) if where is None else (_SCHEDULE[1:], _MINORITY)
    schedule = schedule[-1:] if fitted else schedule
    after = np.asarray(pictures.after)
    for reach, sigma, steps in schedule:
        near = np.flatnonzero(np.abs(after) <= reach)
        if near.size < 2:  # one picture shows no motion
            continue
        begin, end = int(near[0]), int(near[-1]) + 1
        last = reach == np.inf
        blurred = pictures.presmoothed(sigma).picture
        looked_at = [(points, steps)]
        # Near times only give a start to the far ones, where some of the points lead most of the way.
        if few is not None:
            looked_at = [(few, steps), (points, steps // _FEWER)] if last else [(few, steps)]

        def fit(
            numbers: Float[np.ndarray, "2 8"],
            active: Bool[np.ndarray, "2 8"],
            blurred: Float[Array, "n h w"] = blurred,
            interval: tuple[int, int] = (begin, end),
            looked_at: list[tuple[_Points, int]] = looked_at,
            enough: float = _SMALL * sigma * (0.1 if last else 1.0),
        ) -> tuple[Float[np.ndarray, "2 8"], "_Votes"]:
            found = numbers
            for some, most in looked_at:
                found, votes = _fit(
                    blurred, pictures.after, np.array(interval, np.int32), some, found, active,
                    np.int32(most), np.float32(enough), np.float32(majority),
                )  # fmt: skip
            return np.asarray(found), votes

        numbers, votes = fit(numbers, active)
        richer = [(0, _LINEAR)] if affine else []
        richer += [(0, _QUADRATIC)] if affine and perspective and last and where is None else []
        for order, group in richer:
            if not active[order, group].any() and _asked_for(votes, active, (order, group)):
                active[order, group] = True
                numbers, votes = fit(numbers, active)
        if last and after.size >= 4 and _asked_for(votes, active, (1, active[0])):
            active[1] = active[0]
            numbers, votes = fit(numbers, active)
    velocity, acceleration = np.einsum("op,pchw->ochw", numbers, fields)
    return Motion(velocity, acceleration, np.ones((height, width), np.float32))


# Sensor pixels over which the rate of firing is averaged, and the least one that is told from none.
_AROUND, _SELDOM = 2.0, 1e-3
# Intervals between spikes that a fit's pictures have to span for a point to count half. With few of them, several
# pictures show the same interval.
_INTERVALS = 6.0


class _Points(NamedTuple):
    """Where in the key frame is looked: `position` (2, n), between pixels, where the slope of bilinear interpolation is
    that of both sides; `fields` (8, 2, n), the generators there; `block`; `region` 1, or 0 where an entry only pads;
    `interval`, frames from spike to spike, 0 where that is not taken into account."""

    position: Float[np.ndarray, "2 n"]
    fields: Float[np.ndarray, "8 2 n"]
    block: Int[np.ndarray, " n"]
    region: Float[np.ndarray, " n"]
    interval: Float[np.ndarray, " n"]

    @property
    def quarter(self) -> "_Points":
        """Every fourth of them."""
        return _Points(*(of[..., ::4] for of in self))


def _points(
    height: int,
    width: int,
    where: Bool[np.ndarray, "h w"] | None,
    firing: Float[np.ndarray | Array, "h w"] | None,
    *,
    every: bool = False,
) -> _Points:
    """Where to look: at a quarter of the points or more, spread evenly, or at `every` one; at most at `_POINTS`."""
    inner = np.ones((height - 1, width - 1), bool) if where is None else where[:-1, :-1]
    row, column = np.nonzero(inner)
    size = _LEAST_POINTS
    while (size if every else 4 * size - 1) < min(row.size, _POINTS):
        size *= 4
    # Spread evenly, whatever their number (the additive recurrence by powers of the plastic number, Roberts 2018).
    # Points that lie alike in a mirrored picture were tried: one still in five lost 1 dB (docs/decisions/0001).
    if row.size > size:
        chosen = (row * 0.7548776662 + column * 0.5698402910) % 1 < size / row.size
        row, column = row[chosen], column[chosen]
    row, column = row[:size], column[:size]

    def block(of: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        return (of - of.min(initial=0)) * _BLOCKS // max(int(np.ptp(of)) + 1 if of.size else 1, 1)

    pad = (0, size - row.size)
    row, column, block_of = (np.pad(v, pad) for v in (row, column, block(row) * _BLOCKS + block(column)))
    position = np.stack([row, column]).astype(np.float32) + np.float32(0.5)
    region = np.pad(np.ones(size - pad[1], np.float32), pad)
    interval = np.zeros(size, np.float32)
    # Not in a region: it may hold several surfaces, and how often they fire says which, not how well it is seen.
    if firing is not None and where is None:
        around = gaussian_filter(np.asarray(firing), _AROUND, mode="nearest")[row, column]
        interval = 1 / np.maximum(around, _SELDOM)
    return _Points(position, generators(position, height, width), block_of.astype(np.int32), region, interval)


def moves_as_one(pictures: MotionFrames) -> bool:
    """Does the recording ask for an affine motion of the whole scene in place of rest?

    A score test (`_asked_for`) without a fit. All pixels speak together, so that it hears what is far too slow for any
    of them alone to contradict rest: a pan by 0.15 sensor pixels over 101 frames by day.
    """
    _, height, width = pictures.picture.shape
    after, none = np.asarray(pictures.after), np.zeros((2, _GENERATORS), bool)
    if after.size < 2:  # one picture shows no motion
        return False
    _, votes = _fit(
        pictures.presmoothed(_SCHEDULE[-1][1]).picture, pictures.after, np.array((0, after.size), np.int32),
        _points(height, width, None, pictures.firing), np.zeros(none.shape, np.float32), none,
        np.int32(0), np.float32(0), np.float32(0.5),
    )  # fmt: skip
    return _asked_for(votes, none, (0, slice(_SHIFTS.start, _LINEAR.stop)))


class _Votes(NamedTuple):
    """At the end of a fit, over all numbers considered: `matrix` of the normal equations, and their right-hand side
    block by block, `pull`. Order: velocity's generators, then acceleration's."""

    matrix: Float[Array, "16 16"]
    pull: Float[Array, "blocks 16"]


# The likelihood of a false alarm is that of a χ² value above this per number (p < 10⁻⁴ for 4 numbers).
_ASKED = 7.5


def _asked_for(
    votes: _Votes, active: Bool[np.ndarray, "2 8"], group: tuple[int, slice | Bool[np.ndarray, " 8"]]
) -> bool:
    """Would more numbers explain more than noise does? Score test (Rao, 1948), robust to noise that is not white.

    How much the pull of each block varies from block to block tells how certain the whole pull is, whatever the
    correlation of the noise within a block (White, 1982); with b blocks and p numbers, Hotelling's T² takes the place
    of χ².
    """
    further = np.zeros_like(active)
    further[group] = True
    known, asked = np.flatnonzero(active.ravel()), np.flatnonzero(further.ravel())
    matrix, pull = np.asarray(votes.matrix, float), np.asarray(votes.pull, float)
    pull = pull[np.abs(pull).sum(1) > 0]
    scale = 1 / np.sqrt(np.diag(matrix) + 1e-30)
    matrix, pull = matrix * scale[:, None] * scale, pull * scale
    # What is left of each block's pull when the numbers that are fitted already have answered to it.
    answer = np.linalg.lstsq(matrix[np.ix_(known, known)], matrix[np.ix_(known, asked)], rcond=1e-9)[0]
    left = pull[:, asked] - pull[:, known] @ answer
    blocks, numbers = left.shape
    if blocks < 2 * numbers:
        return False
    statistic = left.sum(0) @ np.linalg.pinv(left.T @ left, rcond=1e-9, hermitian=True) @ left.sum(0)
    return bool(statistic * (blocks - numbers) / blocks > _ASKED * numbers)


# How many times an update is gone, at most, and where it is larger than the one before.
_FARTHEST, _GROWING = 4.0, 2.0


class _Steps(NamedTuple):
    """So far: the numbers; the last Gauss–Newton update, and how many times it was gone; how many were `done`, and by
    how much the last one moved what moves most, sensor pixels."""

    numbers: Float[Array, "2 8"]
    update: Float[Array, "2 8"]
    times: Float[Array, ""]
    done: Int[Array, ""]
    moved: Float[Array, ""]


@jax.jit
def _fit(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    interval: Int[Array, " 2"],
    points: _Points,
    numbers: Float[Array, "2 8"],
    active: Bool[Array, "2 8"],
    steps: Int[Array, ""],
    enough: Float[Array, ""],
    majority: Float[Array, ""],
) -> tuple[Float[Array, "2 8"], _Votes]:
    """Gauss–Newton over the `active` numbers, with the pictures from `interval[0]` up to `interval[1]`.

    Which pictures and numbers take part is data, so that one compilation serves for all.
    """
    longest = jnp.maximum(jnp.max(jnp.abs(after[jnp.stack([interval[0], interval[1] - 1])])), 1)
    span = after[interval[1] - 1] - after[interval[0]]
    on = active.reshape(-1)
    _, height, width = pictures.shape
    key_picture = pictures[jnp.argmin(jnp.abs(after))]
    about = bilinear(key_picture[None], *jnp.asarray(points.position))[0]

    def equations(numbers: Float[Array, "2 8"]) -> tuple[Array, Array]:
        velocity, acceleration = jnp.einsum("op,pcn->ocn", numbers, points.fields)

        # Moment by moment, so that the sums stay in the cache.
        def place(b: Array) -> tuple[Corner, Array]:
            tau = after[b]
            row, column = (points.position[k] + tau * velocity[k] + 0.5 * tau**2 * acceleration[k] for k in (0, 1))
            inside = (row >= 0) & (column >= 0) & (row <= height - 1) & (column <= width - 1)
            return corner_of(row, column, height, width), inside.astype(row.dtype)

        def look(b: Array, placed: tuple[Corner, Array]) -> tuple[Array, tuple[Array, Array], Array]:
            corner, inside = placed
            return *_value_and_slope(pictures, b, corner), inside

        def add(b: Array, found: tuple[Array, tuple[Array, Array], Array], sums: _Sums) -> _Sums:
            tau, (value, slope, inside) = after[b], found
            value = (value - about) * inside
            return _Sums(
                tuple(sum_ + tau**k * inside for k, sum_ in enumerate(sums.times)),
                tuple(sum_ + factor * value for factor, sum_ in zip((1, tau, tau**2 / 2), sums.values, strict=True)),
                sums.squares + value**2,
                tuple(sum_ + one * inside for one, sum_ in zip(slope, sums.slopes, strict=True)),
            )

        sums = in_turn(place, look, add, _Sums.none(about), interval[0], interval[1])
        times, values, slopes = (jnp.stack(of) for of in (sums.times, sums.values, sums.slopes))
        # As in `drift`: the regressors τ and τ²/2 without their mean, and the residual about the mean.
        seen = jnp.maximum(times[0], 1e-6)
        first = jnp.stack([times[1], times[2] / 2])
        change = values[1:3] - first * (values[0] / seen)[None]
        square = jnp.stack([jnp.stack([times[2], times[3] / 2]), jnp.stack([times[3] / 2, times[4] / 4])])
        spread = square - first[:, None] * first[None] / seen[None, None]
        mismatch = jnp.maximum(sums.squares - values[0] ** 2 / seen, 0) / seen
        # Cauchy weights: regions that move otherwise stop pulling as soon as the rest agrees.
        usual = _quantile(mismatch, jnp.asarray(points.region), majority)
        trust = points.region / (1 + (mismatch / (3 * usual + 1e-12)) ** 2)
        # What passes within an interval looks as if it stood still.
        trust = trust / (1 + (jnp.hypot(*velocity) * points.interval) ** 4)
        # What fires seldom changes seldom, as if it stood still, however slowly it moves.
        trust = trust / (1 + (_INTERVALS * points.interval / jnp.maximum(span, 1)) ** 4)
        down, right = slopes / seen[None]
        regressors = down[None] * points.fields[:, 0] + right[None] * points.fields[:, 1]
        weights = spread * trust[None, None]
        matrix = [[(regressors * weights[q, r][None]) @ regressors.T for r in (0, 1)] for q in (0, 1)]
        pull = -jnp.concatenate([regressors * (change[q] * trust)[None] for q in (0, 1)])
        return jnp.block(matrix), pull

    # Pixels at the farthest moment that a unit of each number moves, at most: no generator is larger than 1.
    lever = jnp.stack([longest, 0.5 * longest**2])[:, None]

    def step(carry: _Steps) -> _Steps:
        numbers = carry.numbers
        matrix, pull = equations(numbers)
        # Unit diagonal: velocities and accelerations differ by orders of magnitude. A trace of damping keeps the step
        # finite where the picture has no texture.
        scale = jnp.where(on, 1 / jnp.sqrt(jnp.diag(matrix) + 1e-12), 0)
        damping = jnp.where(on, 1e-6, 1).astype(matrix.dtype)
        scaled = matrix * scale[:, None] * scale[None, :] + jnp.diag(damping)
        update = (jnp.linalg.solve(scaled, pull.sum(1) * scale) * scale).reshape(2, -1)
        # Where each update is a share of the one before, as with weights that follow slowly, all that are still to come
        # are taken at once (Aitken, 1926, for vectors).
        last, now = carry.update * lever, update * lever
        share = jnp.sum(now * last) / jnp.maximum(jnp.sum(last**2), 1e-20)
        more = jnp.where(share < 1, carry.times / jnp.maximum(1 - share, 1e-6), _GROWING)
        times = jnp.where(carry.done > 0, jnp.clip(more, 1, _FARTHEST), 1)
        moved = times * jnp.abs(now).max(1).sum()
        return _Steps(numbers + times * update, update, times, carry.done + 1, moved)

    def go_on(carry: _Steps) -> Array:
        return (carry.done < steps) & (carry.moved > enough)

    one, infinite = (jnp.asarray(number, pictures.dtype) for number in (1, jnp.inf))
    begin = _Steps(numbers, jnp.zeros_like(numbers), one, jnp.zeros_like(steps), infinite)
    numbers = jax.lax.while_loop(go_on, step, begin).numbers
    matrix, pull = equations(numbers)
    votes = jax.ops.segment_sum(pull.T, points.block, num_segments=_BLOCKS**2)
    return numbers, _Votes(matrix, votes)


def _quantile(values: Float[Array, " n"], among: Float[Array, " n"], share: Float[Array, ""]) -> Float[Array, ""]:
    """What this share of the values does not exceed, of those `among` which is 1; none is below 0. By halving, to 10⁻⁹
    of the largest: sorting took most of a step."""
    wanted = share * among.sum()

    def halve(_: Array, between: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = between
        middle = (low + high) / 2
        enough = jnp.where(values <= middle, among, 0).sum() >= wanted
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    largest = jnp.max(values * among)
    return jax.lax.fori_loop(0, 30, halve, (jnp.zeros_like(largest), largest))[1]


class _Sums(NamedTuple):
    """Over the moments, at each point: of τ⁰ to τ⁴, of the value times 1, τ and τ²/2, of its square, of its slopes."""

    times: tuple[Float[Array, " n"], ...]
    values: tuple[Float[Array, " n"], ...]
    squares: Float[Array, " n"]
    slopes: tuple[Float[Array, " n"], ...]

    @classmethod
    def none(cls, like: Float[Array, " n"]) -> "_Sums":
        nothing = jnp.zeros_like(like)
        return cls((nothing,) * 5, (nothing,) * 3, nothing, (nothing,) * 2)


def _value_and_slope(
    pictures: Float[Array, "n h w"], number: Array, at: Corner
) -> tuple[Float[Array, " m"], tuple[Float[Array, " m"], Float[Array, " m"]]]:
    """Bilinear interpolation in the picture of this number, and its slope."""
    _, height, width = pictures.shape
    down, right = at.down, at.right
    # Out of all pictures: taken out first, one would be copied.
    flat, corner = pictures.reshape(-1), number * (height * width) + at.number
    a, b, c, d = (flat.at[corner + k].get(mode="promise_in_bounds") for k in (0, 1, width, width + 1))
    above, below = a + right * (b - a), c + right * (d - c)
    return above + down * (below - above), (below - above, (1 - down) * (b - a) + down * (d - c))
