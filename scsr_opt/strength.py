"""How much weight the prior gets: the strength λ of Eq. 4, from the recording itself.

Two things are known. The noise between neighbouring intervals of a pixel says how far the gradient of f is moved by
chance (`strength_of_noise`); on that scale the best strength of stills and clips by day lies within a factor of 2 of 1.
In dim light it does not: the noise of photons stays where that of counting in whole frames averages out, and smooth
scenes want several times as much. So λ is validated (`validated_strength`): part of the samples is held out, and the
picture made from the others has to predict them.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from scsr_opt.camera.measuring import Intervals, Measuring
from scsr_opt.camera.samples import Samples, spike_intervals
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion
from scsr_opt.operators.operator import LinearOperator
from scsr_opt.operators.sampling import DataTerm, PlacedSamples, accumulate, with_exposure
from scsr_opt.placing import Measurements, Stream, measured
from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser
from scsr_opt.solvers.iterate import Solver, run
from scsr_opt.solvers.problem import Problem, with_bound
from scsr_opt.solvers.proximal_gradient import FISTA
from scsr_opt.solvers.smooth import Smooth

# λ = _SMOOTHING · √(noise / frames) · 2 / scale · relative_strength. The square root is how far noise moves the
# gradient of f at a pixel, which total variation has to hold down; the constant and the scale's part were found on
# stills with known answers, several kinds of motion, two lights and two scales (docs/measurements.md).
_SMOOTHING = 0.06

# Side of the part of the picture that λ is validated on, in high-resolution pixels.
_SIDE = 256
# One sample in so many is held out. Where the scene moves by a sensor pixel, other pixels see what this one sees: all
# samples of one pixel in five. Where it does not, one stretch of time in five, of so many frames and two intervals at
# least. Each gap in a pixel's time adds an error at both its ends, which asks for more of a prior than all samples do.
_MOVED = 1.0
_SHARE, _STRETCH = 5, 8
# Held-out samples tell what a sensor pixel sees, which needs less of a prior than what lies between: the strength
# that gives the best picture was so many times the one that predicts best, by time and by pixels. Nor is much less than
# by noise alone believed, where it lost more often than not.
_BEYOND, _AT_LEAST = (1.4, 1.7), (0.7, 0.4)
# What other measurements than intervals ask for is not known beforehand: windows want 4 to 64 times as much
# (docs/data-term.md).
_LOWEST, _HIGHEST, _HIGHEST_OF_OTHERS = 0.25, 16.0, 256.0
# Strengths of a learned prior are tried with Huber-TV in its place, which takes a fraction of the time. Where that
# predicts best with k times the strength by noise, the learned prior does with a·k^b (both measured): it knows pictures
# better, and noise moves it less.
_STAND_IN = (0.65, 0.6)
# A validation need not be solved to the end.
_ITERATIONS, _TOLERANCE = 60, 5e-4


def strength_of_noise(noise: float, scale: int, prior: Prior) -> float:
    """λ from how much neighbouring intervals differ (`noise_of_mean`). **Raises:** as `relative_strength`."""
    return _SMOOTHING * noise * 2 / scale * relative_strength(prior)


def relative_strength(prior: Prior) -> float:
    """That of the prior. **Raises:** `InputError` where there is none."""
    found = prior.relative_strength
    if found is None:
        raise InputError(
            f"No strength is given, and that of {type(prior).__name__} cannot be set from the recording; hand one in: "
            "with PlugAndPlay about the variance of the noise to be taken away at sensor resolution, such as 1e-4."
        )
    return found


def noise_of_mean(stream: Stream) -> float:
    """Standard deviation of a pixel's mean over the recording, intensity, as neighbouring intervals differ by it; from
    a sample of the pixels."""
    few = stream.spikes[:, ::2, ::2]
    bad = None if stream.bad_pixels is None else stream.bad_pixels[::2, ::2]
    samples = spike_intervals(few, white_rate=stream.white_rate, bad_pixels=bad, ends=0)
    follows = (samples.row[1:] == samples.row[:-1]) & (samples.column[1:] == samples.column[:-1])
    difference = (samples.value[1:] - samples.value[:-1])[follows]
    duration = ((samples.weight[1:] + samples.weight[:-1]) / 2)[follows]
    if difference.size:
        noise = difference**2 * duration / 2  # variance of an interval of one frame
        noise = float(np.minimum(noise, np.quantile(noise, 0.9)).mean())  # passing edges are not noise
    else:
        noise = 0.0
    noise = max(noise, 1e-3)  # spikes are counted in whole frames: never free of it
    return (noise / len(stream.spikes)) ** 0.5


class Validated(NamedTuple):
    """A strength λ, and the last picture that was made to find it, (H, W), intensity: a start much nearer to the
    solution than playback. None where that is of a part of the sensor only, or not finite."""

    strength: float
    image: Float[Array, "H W"] | None


class _Validation(NamedTuple):
    """Samples to make a picture from, and the weights of those to predict; `by_pixel`: the share of pixels that are
    held out as a whole or not at all."""

    placed: PlacedSamples
    held: Float[Array, " n"]
    plain: DataTerm
    by_pixel: float


def validated_strength(
    stream: Stream,
    motion: Motion,
    taken: Measurements,
    image: Float[Array, "H W"],
    *,
    scale: int,
    prior: Prior,
    solver: Solver,
    measuring: Measuring,
    gain: Float[np.ndarray, "h w"] | None = None,
    optics: LinearOperator | None = None,
    noise: float | None = None,
) -> Validated:
    """λ by holding out a fifth of the samples: the strength that predicts them best, and somewhat more (`_BEYOND`).

    Strengths a factor of 2 apart are tried from that of the noise on, the best is interpolated. A part of the picture
    serves, of 256 high-resolution pixels a side, so that the cost does not grow with the sensor: the one whose contrast
    is nearest to the mean of all. A lens makes that part the whole picture, as its blur is made for one size.

    **Arguments:** `taken`, the measurements of the recording along the motion; `image`, X^(0) (`first_picture`);
    `prior`, `solver`, `measuring`, `gain` and `optics` as for the reconstruction; `FISTA` stands in for solvers that
    use the prior's proximal step, as it does, and `HuberTotalVariation` for a `RidgeRegulariser`. `noise`: what
    `noise_of_mean` finds, if that is known.

    **Raises:** as `relative_strength`.
    """
    least = strength_of_noise(noise_of_mean(stream) if noise is None else noise, scale, prior)
    side = max(_SIDE // scale, 1) if optics is None else max(stream.spikes.shape[1:])
    good = np.ones(stream.spikes.shape[1:], bool) if stream.bad_pixels is None else ~stream.bad_pixels
    rows, columns = _typical(np.asarray(image), scale, side, good)
    part = Stream(
        stream.spikes[:, rows, columns],
        stream.key,
        stream.white_rate,
        None if stream.bad_pixels is None else stream.bad_pixels[rows, columns],
    )
    gain = None if gain is None else gain[rows, columns]
    everything = part.spikes.shape == stream.spikes.shape
    moved = motion.speed[rows, columns] * np.float32(len(stream.spikes))
    if everything and (taken.merged_for == 1).all():
        validation = _split(taken.padded, taken.placed, moved, optics)
    else:
        # None are merged, as what is held out has to be in pieces.
        apart = measured(
            part,
            taken.path.part(rows, columns),
            scale=scale,
            measuring=measuring,
            gain=gain,
            merge=False,
        )
        validation = _split(apart.padded, apart.placed, moved, optics)
    if validation is None:
        return Validated(least, None)
    # A prior that is used by its gradient need not have a proximal step.
    kind = solver if isinstance(solver, Smooth) else FISTA()
    solver = dataclasses.replace(kind, iterations=_ITERATIONS, tolerance=_TOLERANCE)
    image = first = image[_scaled(rows, scale), _scaled(columns, scale)]
    term, state = validation.plain, None
    tried: dict[float, float] = {}
    learned = isinstance(prior, RidgeRegulariser)
    stand_in = HuberTotalVariation() if learned else prior
    share = relative_strength(prior) / relative_strength(stand_in)

    def solved(factor: float) -> Array:
        nonlocal state, image
        λ = jnp.asarray(least * factor / share, jnp.float32)
        outcome = run(solver, Problem(term, stand_in, λ), first, similar=state)
        state, image = outcome.state, jnp.asarray(outcome.image)
        return image

    for _ in range(2 if validation.placed.finest > 1 else 0):  # the motion during exposures is taken from these
        term = with_exposure(validation.plain, validation.placed, solved(1.0))

    def missed(factor: float) -> float:
        if factor not in tried:
            tried[factor] = float(_missed(validation, solved(factor)))
        return tried[factor]

    best, highest = 1.0, _HIGHEST if isinstance(measuring, Intervals) else _HIGHEST_OF_OTHERS
    while missed(2 * best) < missed(best) and 2 * best < highest:
        best *= 2
    while best <= 1 and missed(best / 2) < missed(best) and best / 2 >= _LOWEST:
        best /= 2
    best *= 2 ** _vertex(missed(best / 2), missed(best), missed(2 * best))
    beyond, at_least = (
        by_time ** (1 - validation.by_pixel) * by_pixel**validation.by_pixel
        for by_time, by_pixel in (_BEYOND, _AT_LEAST)
    )
    if learned:
        best = _STAND_IN[0] * best ** _STAND_IN[1]
    usable = everything and bool(jnp.isfinite(image).all())
    return Validated(least * max(at_least, beyond * best), image if usable else None)


def _typical(
    image: Float[np.ndarray, "H W"], scale: int, side: int, good: Bool[np.ndarray, "h w"]
) -> tuple[slice, slice]:
    """The rows and columns, sensor pixels, of a part of up to `side` a side whose mean contrast in `image` is nearest
    to that of all; of parts that overlap by half or more, the one nearest to the middle among equals. Only `good`
    pixels count, and parts with less than half their share of them are left out."""
    height, width = good.shape
    down, right = (np.diff(image, axis=k, prepend=np.take(image, [0], k)) for k in (0, 1))
    contrast = good * (np.abs(down) + np.abs(right)).reshape(height, scale, width, scale).mean((1, 3))
    begins = [np.linspace(0, max(n - side, 0), 2 * -(-n // side) - 1).round() for n in good.shape]
    places = np.stack(np.meshgrid(*begins, indexing="ij"), -1).reshape(-1, 2).astype(int)
    places = places[np.argsort(np.hypot(*(places - places.mean(0)).T), kind="stable")]
    parts = [(slice(row, min(row + side, height)), slice(column, min(column + side, width)))
             for row, column in places.tolist()]  # fmt: skip
    off = [abs(contrast[part].sum() / max(good[part].sum(), 1) - contrast.sum() / max(good.sum(), 1)) for part in parts]
    few = [good[part].mean() < good.mean() / 2 for part in parts]
    return parts[int(np.where(few, np.inf, off).argmin())]


def _scaled(of: slice, scale: int) -> slice:
    """The high-resolution pixels of sensor pixels."""
    return slice(scale * of.start, scale * of.stop)


def _split(
    samples: Samples, placed: PlacedSamples, moved: Float[np.ndarray, "h w"], optics: LinearOperator | None
) -> _Validation | None:
    """The samples, a fifth of them held out; None if there are too few to do so."""
    held, weight = _held_out(samples, moved), np.asarray(placed.weight)
    if np.count_nonzero(weight * held) < 100 or np.count_nonzero(weight * ~held) < 100:
        return None
    rest = eqx.tree_at(lambda p: p.weight, placed, jnp.asarray(weight * ~held))
    by_pixel = float((moved >= _MOVED).mean())
    return _Validation(rest, jnp.asarray(weight * held), with_bound(accumulate(rest, optics=optics)), by_pixel)


def _held_out(samples: Samples, moved: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, " n"]:
    """Which of the samples; `moved`, sensor pixels by which the scene moves at each pixel."""
    rows, columns = np.indices(moved.shape)
    pixel = np.asarray(samples.row) * moved.shape[1] + np.asarray(samples.column)
    whole = (moved >= _MOVED).reshape(-1)
    # A knight's move apart: no two neighbours.
    held = whole[pixel] & ((2 * rows + columns) % _SHARE == 0).reshape(-1)[pixel]
    if not whole.all():
        duration = np.asarray(samples.stop - samples.start)
        typical = float(np.average(duration, weights=samples.weight + np.float32(1e-9)))
        stretch = (samples.start + samples.stop) / 2 // max(_STRETCH, 2 * typical)
        # From pixel to pixel another stretch, so that no time is missing.
        by_time = (stretch.astype(np.int32) + (rows * 7 + columns * 3).reshape(-1)[pixel]) % _SHARE == 0
        held = np.where(whole[pixel], held, by_time)
    return np.asarray(held)


@eqx.filter_jit
def _missed(validation: _Validation, image: Float[Array, "H W"]) -> Float[Array, ""]:
    """Mean square by which the picture misses the held-out samples."""
    placed = validation.placed
    error = placed.read(validation.plain.blurred(image)) - placed.value
    return jnp.sum(validation.held * error**2) / jnp.sum(validation.held)


def _vertex(before: float, at: float, after: float) -> float:
    """Where the parabola through three values at −1, 0 and 1 is least, within these."""
    curvature = before - 2 * at + after
    return float(np.clip((before - after) / (2 * curvature), -1, 1)) if curvature > 0 else 0.0
