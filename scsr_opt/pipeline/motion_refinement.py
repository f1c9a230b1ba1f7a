"""Motion refined against the picture that it gave: the other half of minimising Eq. 4 over picture and motion.

With U = B X, the blurred picture, held still, a motion is better if it predicts the samples better:

    minimise over θ   Σ_j ω_j ρ_j (r_j(θ)·U − Y_j)²

r_j(θ) reads U where sample j was taken, at several positions along its exposure, and ρ_j weighs down what no motion
explains. Where the motion is few numbers, θ are these (Levenberg–Marquardt); otherwise a step of Lucas and Kanade
(1981) moves each pixel's velocity by what the samples around it ask for. Picture and motion are then solved for in
turn.

A picture that follows the noise asks for the motion that it was made with: refine with the picture of a prior, solved
at full strength.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from scsr_opt.camera.samples import Samples
from scsr_opt.errors import InputError
from scsr_opt.motion.estimators.frames import smooth
from scsr_opt.motion.estimators.parametric import generators
from scsr_opt.motion.inversion import bilinear
from scsr_opt.motion.trajectory import Layers, Motion
from scsr_opt.operators.sampling import PlacedSamples, moments
from scsr_opt.pipeline.settings import RefinementSettings


def refine(
    motion: Motion,
    picture: Float[Array, "H W"],
    samples: Samples,
    placed: PlacedSamples,
    *,
    key: float | int,
    settings: RefinementSettings = RefinementSettings(),
) -> Motion:
    """A motion nearer to the one that predicts `samples` best from `picture`.

    **Arguments:**
    - `motion`: as it was when the samples were placed.
    - `picture`: U = B X, `DataTerm.blurred` of an image.
    - `samples`, `placed`: (n,) each, the samples padded as they were placed, with times in frames.
    - `key`: time of the key frame.
    - `settings`: how far a velocity may go in a step, and when steps end.

    **Returns:** a motion of the same kind. A motion of few numbers (translation, affine, perspective; `parametric`)
    keeps which of them are 0, and is refined as far as it goes; of a motion of many numbers, or of layers, each
    velocity makes one step of at most half a sensor pixel at the farthest moment. Nothing moves: returned as it is.

    **Raises:** `InputError` if samples and places do not belong together, or the picture has another size.
    """
    if placed.value.shape != samples.value.shape or picture.shape != placed.shape:
        raise InputError(
            f"refine was given {samples.value.size} samples, {placed.value.size} places on a picture of "
            f"{placed.shape}, and a picture of {picture.shape}; give the padded samples, what "
            "`place` made of them, and B X."
        )
    longest = float(np.max(np.abs(np.asarray(samples.stop if samples.count else 0) - key), initial=1.0))
    if not motion.moves:
        return motion
    if motion.layers is None:
        numbers = _numbers(motion, longest, settings.exact_px)
        if numbers is not None:
            return _of_few_numbers(motion, numbers, picture, samples, placed, key, longest, settings)
    shape = motion.velocity.shape[1:]
    pull, information = _votes(picture, samples, placed, jnp.float32(key), shape, settings.outlier_deviations)
    return _stepped(motion, pull, information, longest, settings)


def _numbers(motion: Motion, longest: float, exact_px: float) -> Float[np.ndarray, "2 8"] | None:
    """Velocity and acceleration as sums of generators, with 0 for those that take no part; None if they are not."""
    height, width = motion.velocity.shape[1:]
    fields = generators(np.mgrid[0:height, 0:width].astype(np.float32), height, width)
    basis, wanted = fields.reshape(8, -1).T.astype(float), np.stack([motion.velocity, motion.acceleration])
    wanted = wanted.reshape(2, -1).T.astype(float)
    numbers, *_ = np.linalg.lstsq(basis, wanted, rcond=None)
    reach = np.array([longest, longest**2 / 2])
    if (np.abs(basis @ numbers - wanted).max(0) * reach).max() > exact_px:
        return None
    return np.where(np.abs(numbers.T) * reach[:, None] > 1e-4, numbers.T, 0).astype(np.float32)


def _of_few_numbers(
    motion: Motion,
    numbers: Float[np.ndarray, "2 8"],
    picture: Float[Array, "H W"],
    samples: Samples,
    placed: PlacedSamples,
    key: float | int,
    longest: float,
    settings: RefinementSettings,
) -> Motion:
    # All numbers in sensor pixels at the farthest moment, so that one damping and one tolerance serve for all.
    units = np.repeat(np.array([[longest], [longest**2 / 2]], np.float32), 8, axis=1)
    some = slice(None, None, max(1, -(-samples.value.size // settings.samples)))
    fewer = jax.tree.map(lambda values: jnp.asarray(values[some]), samples)
    residual = placed.read(picture)[some] - placed.value[some]
    weight = _robust(residual, placed.weight[some], fewer.weight, settings.outlier_deviations)
    parameters = _Parameters(jnp.asarray(numbers), jnp.asarray(units), jnp.asarray(np.flatnonzero(numbers)))
    begin = jnp.asarray((numbers * units)[numbers != 0])
    found = _least_squares(
        begin, parameters, picture, fewer, weight, jnp.float32(key), placed.finest, placed.scale, settings
    )
    if not np.isfinite(found).all():
        return motion
    height, width = motion.velocity.shape[1:]
    fields = generators(np.mgrid[0:height, 0:width].astype(np.float32), height, width)
    velocity, acceleration = np.einsum("op,pchw->ochw", np.asarray(found, np.float32), fields)
    return Motion(velocity, acceleration, motion.confidence)


def _robust(
    residual: Float[Array, " n"], weight: Float[Array, " n"], duration: Float[Array, " n"], deviations: float
) -> Float[Array, " n"]:
    """Cauchy weights times `weight`; the variance of a residual falls with the sample's duration."""
    square = residual**2 * duration
    usual = jnp.sum(weight * square) / jnp.maximum(jnp.sum(weight), 1e-12)
    return weight / (1 + square / (deviations**2 * usual + 1e-12))


class _Parameters(NamedTuple):
    """Velocity and acceleration as numbers of the eight generators, and which of them are refined.

    **Fields:** `numbers`, (2, 8); `units`, (2, 8), what each is multiplied by to be sensor pixels at the farthest
    moment; `active`, (p,), indices into the sixteen.
    """

    numbers: Float[Array, "2 8"]
    units: Float[Array, "2 8"]
    active: Int[Array, " p"]


@eqx.filter_jit
def _least_squares(
    begin: Float[Array, " p"],
    parameters: _Parameters,
    picture: Float[Array, "H W"],
    samples: Samples,
    weight: Float[Array, " n"],
    key: Float[Array, ""],
    positions: int,
    scale: int,
    settings: RefinementSettings,
) -> Float[Array, "2 8"]:
    """The numbers that predict the samples best, from `begin`, (p,), in sensor pixels at the farthest moment."""
    height, width = (n // scale for n in picture.shape)
    # Optimistix makes its own numbers in JAX's default precision, which may be double.
    dtype = jax.dtypes.canonicalize_dtype(float)
    begin, numbers, units, picture, weight, key = (
        v.astype(dtype) for v in (begin, parameters.numbers, parameters.units, picture, weight, key)
    )
    start, stop, value = (jnp.asarray(v, dtype) for v in (samples.start, samples.stop, samples.value))
    pixel = jnp.stack([samples.row, samples.column]).astype(value.dtype)
    middle = jnp.array([[(height - 1) / 2], [(width - 1) / 2]], value.dtype)
    # Beyond it the aperture would leave the picture, and U is 0.
    border = jnp.array([[picture.shape[0] - scale], [picture.shape[1] - scale]], value.dtype)
    along = (np.arange(positions) + 0.5) / positions
    root = jnp.sqrt(weight)

    def all_numbers(few: Float[Array, " p"]) -> Float[Array, "2 8"]:
        return (numbers * units).reshape(-1).at[parameters.active].set(few).reshape(2, 8) / units

    def displacement(point: Float[Array, "2 n"], numbers: Float[Array, "2 8"], τ: Float[Array, " n"]):
        ρ, γ = (point - middle) / max(height, width)
        d = numbers[0][:, None] * τ[None] + numbers[1][:, None] * (0.5 * τ**2)[None]
        tilt = d[6] * ρ + d[7] * γ
        return jnp.stack([d[0] + d[2] * ρ + d[3] * γ + tilt * ρ, d[1] + d[4] * ρ + d[5] * γ + tilt * γ])

    def residuals(few: Float[Array, " p"], _: None) -> Float[Array, " n"]:
        now = all_numbers(few)
        total = jnp.zeros_like(value)
        for part in along:
            τ = start + (stop - start) * jnp.asarray(part, value.dtype) - key
            seen = pixel
            for _step in range(settings.inversion_steps):
                seen = pixel - displacement(seen, now, τ)
            total = total + bilinear(picture[None], *jnp.clip(seen * scale, 0, border))[0]
        return root * (total / positions - value)

    import optimistix as optx  # takes 0.2 s, and most reconstructions refine nothing

    solver = optx.LevenbergMarquardt(rtol=settings.least_step_px, atol=settings.least_step_px)
    solution = optx.least_squares(residuals, solver, begin, max_steps=settings.steps, throw=False)
    return all_numbers(solution.value)


@eqx.filter_jit
def _votes(
    picture: Float[Array, "H W"],
    samples: Samples,
    placed: PlacedSamples,
    key: Float[Array, ""],
    shape: tuple[int, int],
    deviations: float,
) -> tuple[Float[Array, "2 h w"], Float[Array, "2 2 h w"]]:
    """−Jᵀ ω res and Jᵀ ω J in units of the noise, J = ∂(r_j·U)/∂v, added up at the key-frame pixel that each sample
    shows: what it asks of the velocity there."""
    height, width = shape
    flat, wide = picture.reshape(-1), picture.shape[1]
    start, stop = jnp.asarray(samples.start), jnp.asarray(samples.stop)
    slope = jnp.zeros((2, start.size), picture.dtype)
    for number in range(placed.finest):
        taps = jax.tree.map(lambda of, number=number: of[number], placed.taps)
        τ = moments(start, stop, placed.positions, number) - key
        a, b, c, d = (flat[taps.index + offset] for offset in (0, 1, wide, wide + 1))
        across = jnp.stack([(c - a) + taps.right * (d - b - c + a), (b - a) + taps.down * (d - b - c + a)])
        # What a pixel sees lies at p − vτ: a higher velocity takes it back.
        slope = slope - placed.scale * placed.share(number, τ)[None] * across
    residual = placed.read(picture) - placed.value
    weight = _robust(residual, placed.weight, jnp.asarray(samples.weight), deviations)
    noise = jnp.sum(weight * residual**2) / jnp.maximum(jnp.sum(weight > 0, dtype=weight.dtype), 1)
    weight = weight / (noise + 1e-20)
    shown = jax.tree.map(lambda of: of[0], placed.taps)
    row, column = jnp.divmod(shown.index, wide)
    row = jnp.clip(jnp.round((row.astype(start.dtype) + shown.down) / placed.scale).astype(jnp.int32), 0, height - 1)
    column = jnp.clip(
        jnp.round((column.astype(start.dtype) + shown.right) / placed.scale).astype(jnp.int32), 0, width - 1
    )
    weighted = weight[None] * slope
    sums = jnp.concatenate([-residual[None] * weighted, weighted[:1] * slope, weighted[1:] * slope])
    pixel = row * width + column
    totals = jnp.zeros((6, height * width), picture.dtype).at[:, pixel].add(sums).reshape(6, height, width)
    return totals[:2], totals[2:].reshape(2, 2, height, width)


def _stepped(
    motion: Motion,
    pull: Float[Array, "2 h w"],
    information: Float[Array, "2 2 h w"],
    longest: float,
    settings: RefinementSettings,
) -> Motion:
    """One step of each velocity, least squares over a window; with layers, only over what belongs to the same one."""
    window, most = settings.smoothing_px, settings.most_step_px
    if motion.layers is None:
        velocity = motion.velocity + _update(pull, information, jnp.float32(longest), window, most)
        return eqx.tree_at(lambda m: m.velocity, motion, np.asarray(velocity, np.float32))
    velocity = motion.layers.velocity.copy()
    for number in range(len(velocity)):
        own = jnp.asarray(motion.layers.label == number, pull.dtype)
        own_pull, own_information = pull * own[None], information * own[None, None]
        velocity[number] += np.asarray(_update(own_pull, own_information, jnp.float32(longest), window, most))
    layers: Layers = eqx.tree_at(lambda found: found.velocity, motion.layers, velocity)
    return Motion.of_layers(layers, motion.confidence)


@eqx.filter_jit
def _update(
    pull: Float[Array, "2 h w"],
    information: Float[Array, "2 2 h w"],
    longest: Float[Array, ""],
    smoothing_px: float,
    most_step_px: float,
) -> Float[Array, "2 h w"]:
    window = jnp.asarray(smoothing_px, pull.dtype)
    pixels = 4 * jnp.pi * window**2  # effective number in a Gaussian window
    pull, information = pixels * smooth(pull, window), pixels * smooth(information, window)
    known = (longest / most_step_px) ** 2
    a, b, d = information[0, 0] + known, information[0, 1], information[1, 1] + known
    update = jnp.stack([d * pull[0] - b * pull[1], a * pull[1] - b * pull[0]]) / (a * d - b * b)[None]
    length = jnp.sqrt(update[0] ** 2 + update[1] ** 2)
    return update * jnp.minimum(1, most_step_px / longest / jnp.maximum(length, 1e-12))[None]
