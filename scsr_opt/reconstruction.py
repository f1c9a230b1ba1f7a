"""From spikes to a super-resolved picture: the one function that most users call."""

import math
import operator
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import SupportsFloat, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped
from numpy.typing import ArrayLike

from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.samples import Samples, spike_intervals
from scsr_opt.errors import InputError
from scsr_opt.motion.estimate import Estimator, estimate_motion, filled, given
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators.blur import Blur
from scsr_opt.operators.sampling import accumulate, place, with_exposure
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.total_variation import TotalVariation
from scsr_opt.progress import Progress
from scsr_opt.solvers.iterate import Solver, run
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA
from scsr_opt.solvers.solution import Result, Solution, Stage

# Spike frames used around the key frame (2.5 ms at 40 kHz): enough to see every sensor pixel through many apertures,
# short enough for motion to be smooth.
FRAMES = 101

# Pixels of the largest picture: a solve holds about 40 numbers for each, 16 GB in all.
_MOST_PIXELS = 10**8

# Corrections for motion during the exposures (majorise–minimise steps); each takes back most of what is left.
_CORRECTIONS = 3
_LOOSE = 5.0


def reconstruct(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    frames: SupportsIndex = FRAMES,
    white_rate: SupportsFloat | None = None,
    velocity: ArrayLike | Sequence[float] | Estimator | None = None,
    bad_pixels: ArrayLike | None = None,
    prior: Prior | None = None,
    solver: Solver | None = None,
    strength: SupportsFloat | None = None,
    optics: Blur | None = None,
    progress: Progress | None = None,
    keep_images: bool = False,
) -> Solution:
    """The high-resolution picture X of a moment, from all spikes around it (paper, Eq. 4).

    **Arguments:**
    - `spikes`: (T, h, w) of 0 and 1, or a `Recording`.
    - `scale`: s ≥ 1, any integer; 1 denoises and sharpens only.
    - `key`: frame whose picture is wanted, 0 … T−1; the middle one if not given.
    - `frames`: how many frames around the key frame are used (all, if the recording has fewer).
    - `white_rate`: spikes per frame of a pixel at intensity 1; that of the recording, or 0.6, if not given.
    - `velocity`: known motion at the key frame, (2, h, w) or two numbers, sensor pixels per frame ([0] down, [1]
      right); or an `Estimator` (`Still`, `Global`, `Dense`, `Automatic`). Estimated by `Automatic` if not given.
    - `bad_pixels`: (h, w), true where a pixel must not be used (added to those of the recording).
    - `prior`: Ψ; isotropic `TotalVariation` if not given.
    - `solver`: `FISTA` if not given. Its limit of iterations holds for the first solve and, where exposures are long
      enough to need them, for each of three corrections after it.
    - `strength`: λ; from the data if not given.
    - `optics`: the lens, as a `Blur` of the high-resolution picture.
    - `progress`: told of the progress. `keep_images`: every stage keeps its pictures.

    **Returns:** `Solution`; `.image` is (s·h, s·w) float32, intensity 1 = white.

    **Raises:** `InputError` if something handed in cannot be used. A solve that fails is not raised, but said by
    `Solution.result`.
    """
    clock = _Clock()
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
    height, width = recording.height, recording.width
    scale = _whole(scale, "scale", 1)
    if scale**2 * height * width > _MOST_PIXELS:
        raise InputError(
            f"At scale {scale} the picture would have {scale**2 * height * width / 1e6:.0f} million pixels; at most "
            f"{_MOST_PIXELS / 1e6:.0f} million fit in memory: take a smaller scale or crop the recording."
        )
    _check_type(prior, Prior, "prior", "TotalVariation()")
    _check_type(solver, Solver, "solver", "FISTA()")
    _check_type(optics, Blur, "optics", "Blur.gaussian(shape, sigma)")
    key = recording.frames // 2 if key is None else _whole(key, "key", 0, recording.frames - 1)
    start, stop = recording.around(key, _whole(frames, "frames", 1))
    frames, key = stop - start, key - start
    rate = recording.white_rate if white_rate is None else white_rate
    white_rate = _number(rate, "white_rate", lambda v: v > 0, "above 0, in spikes per frame")
    if strength is not None:
        strength = _number(strength, "strength", lambda v: v >= 0, "of at least 0")
    bad = _bad_pixels(recording, bad_pixels)
    stream = recording.window(start, stop)
    if bad is not None:
        stream[:, bad] = 0  # whatever they fired, nothing after this line knows
    clock.lap("reading")

    if velocity is None or isinstance(velocity, Estimator):
        motion = estimate_motion(stream, key=key, white_rate=white_rate, estimator=velocity, bad_pixels=bad)
    else:
        motion = given(velocity, height, width)
    clock.lap("motion")

    samples = _samples(stream, motion, scale=scale, white_rate=white_rate, bad=bad)
    shape = (scale * height, scale * width)
    placed = place(
        jax.tree.map(jnp.asarray, samples.padded()),
        trajectory_of(motion, key=key, start=0, stop=frames),
        scale=scale,
        positions=_positions(samples, motion, scale),
        shape=shape,
    )
    used = int(jnp.count_nonzero(placed.weight))
    if used == 0:
        stats = {"iterations": 0, "samples": 0, "seconds": clock.laps}
        return Solution(np.zeros(shape, np.float32), (), Result.no_samples, stats, motion.velocity, motion.confidence)
    uncorrected = term = accumulate(placed, optics=optics)
    clock.lap("samples")

    λ = _strength(stream, white_rate, scale, bad) if strength is None else strength
    prior = TotalVariation() if prior is None else prior
    solver = FISTA() if solver is None else solver
    image = _first_picture(stream, key, white_rate, bad, shape)
    stages: list[Stage] = []
    similar = None
    corrections = _CORRECTIONS if placed.positions > 1 else 0
    for correction in range(corrections + 1):
        problem = Problem(term, prior, jnp.asarray(λ, jnp.float32))
        last = correction == corrections
        outcome = run(
            solver,
            problem,
            image,
            similar=similar,
            progress=progress,
            keep_images=keep_images,
            # What is corrected next need not be solved to the end.
            tolerance=solver.tolerance if last else _LOOSE * solver.tolerance,
        )
        stages += [replace(s, number=len(stages) + n) for n, s in enumerate(outcome.stages, 1)]
        if last or not outcome.result.good:
            break
        similar = outcome.state
        term = with_exposure(uncorrected, placed, jnp.asarray(outcome.image))
    clock.lap("solving")
    stats = {
        "iterations": len(stages),
        "samples": used,
        "positions": placed.positions,
        "strength": float(λ),
        "objective": stages[-1].objective,
        "speed_max": float(motion.speed.max()),
        "seconds": clock.laps,
    }
    return Solution(
        outcome.image, tuple(stages), outcome.result, stats, motion.velocity, motion.confidence, outcome.state
    )


class _Clock:
    """Seconds by part of the work."""

    def __init__(self):
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now


# How far a surface may move while intervals are merged, in high-resolution pixels: below the aperture's own blur.
_MERGED_MOTION = 0.25
# Length of an exposure, in high-resolution pixels, from which on it is sampled at several positions.
_EXPOSURE_MOTION = 0.75


def _samples(
    spikes: Shaped[np.ndarray, "T h w"],
    motion: Motion,
    *,
    scale: int,
    white_rate: float,
    bad: Bool[np.ndarray, "h w"] | None,
) -> Samples:
    """Spike intervals, merged as far as the motion allows, weighted by their share of the recording."""
    frames = spikes.shape[0]
    with np.errstate(divide="ignore"):
        still_for = _MERGED_MOTION / (scale * motion.speed)
    shortest = np.clip(still_for, 1, frames).astype(np.int32)
    samples = spike_intervals(spikes, white_rate=white_rate, shortest=shortest, bad_pixels=bad)
    return eqx.tree_at(lambda s: s.weight, samples, samples.weight / np.float32(frames))


def _positions(samples: Samples, motion: Motion, scale: int) -> int:
    """How finely exposures are sampled: 1, 3 or 5 positions, by how far the surface moves during a long one."""
    moved = scale * motion.speed[samples.row, samples.column] * (samples.stop - samples.start)
    long = float(np.quantile(moved, 0.9)) if moved.size else 0.0
    return 1 if long < _EXPOSURE_MOTION else 3 if long < 3 * _EXPOSURE_MOTION else 5


# λ = _SMOOTHING · √(noise / frames) · (2 / scale)^¾. The square root is how far noise moves the gradient of f at a
# pixel, which total variation has to hold down; the constant and the exponent were found on stills with known answers,
# three kinds of motion, two lights and two scales (docs/measurements.md), where the best strength lay within a factor
# of 2 of it.
_SMOOTHING = 0.06


def _strength(
    spikes: Shaped[np.ndarray, "T h w"], white_rate: float, scale: int, bad: Bool[np.ndarray, "h w"] | None
) -> float:
    """λ from how much neighbouring intervals of a pixel differ, in a sample of the pixels."""
    few = spikes[:, ::2, ::2]
    samples = spike_intervals(few, white_rate=white_rate, bad_pixels=None if bad is None else bad[::2, ::2])
    follows = (samples.row[1:] == samples.row[:-1]) & (samples.column[1:] == samples.column[:-1])
    difference = (samples.value[1:] - samples.value[:-1])[follows]
    duration = ((samples.weight[1:] + samples.weight[:-1]) / 2)[follows]
    if difference.size:
        noise = difference**2 * duration / 2  # variance of an interval of one frame
        noise = float(np.minimum(noise, np.quantile(noise, 0.9)).mean())  # passing edges are not noise
    else:
        noise = 0.0
    noise = max(noise, 1e-3)  # spikes are counted in whole frames: never free of it
    return _SMOOTHING * (noise / spikes.shape[0]) ** 0.5 * (2 / scale) ** 0.75


def _first_picture(
    spikes: Shaped[np.ndarray, "T h w"],
    key: int,
    white_rate: float,
    bad: Bool[np.ndarray, "h w"] | None,
    shape: tuple[int, int],
) -> Float[Array, "H W"]:
    """X^(0): the rate over 21 frames around the key frame, enlarged."""
    if spikes.shape[0] > 1:
        edges = np.clip(np.array([key - 10.0, key + 10.0]), 0, spikes.shape[0] - 1)
        rate = interval_rates(spikes, edges, white_rate=white_rate)
    else:
        rate = spikes / np.float32(white_rate)
    picture = jnp.asarray(rate, jnp.float32)
    if bad is not None and bad.any():
        picture = filled(picture, ~bad)
    return jax.image.resize(picture[0], shape, "linear")


def _bad_pixels(recording: Recording, extra: ArrayLike | None) -> Bool[np.ndarray, "h w"] | None:
    known = recording.bad_pixels
    if extra is None:
        return known
    mask = np.asarray(extra)
    if mask.shape != (recording.height, recording.width) or mask.dtype != np.bool_:
        raise InputError(
            f"bad_pixels is {mask.dtype} of shape {mask.shape}; it must be bool of shape "
            f"({recording.height}, {recording.width}), true where a pixel is not to be used."
        )
    return mask if known is None else mask | known


def _check_type(value: object, kind: type, name: str, example: str) -> None:
    if value is not None and not isinstance(value, kind):
        raise InputError(f"{name} is {value!r}; it must be a {kind.__name__}, such as {example}.")


def _whole(value: SupportsIndex, name: str, least: int, most: int | None = None) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or number < least or (most is not None and number > most):
        limits = f"at least {least}" if most is None else f"from {least} to {most}"
        raise InputError(f"{name} is {value!r}; it must be a whole number, {limits}.")
    return number


def _number(value: SupportsFloat, name: str, allowed: Callable[[float], bool], limits: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and allowed(number)):
        raise InputError(f"{name} is {value!r}; it must be a finite number {limits}.")
    return number
