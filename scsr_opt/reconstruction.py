"""From spikes to a super-resolved picture: the one function that most users call."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, SupportsFloat, SupportsIndex

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from scsr_opt.camera.gain import FIXED_PATTERN, gain_is_known, spread_of
from scsr_opt.camera.gain_network import gain_at_rest
from scsr_opt.camera.measuring import Intervals, Measuring
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.saturation import share_saturated, spike_counts
from scsr_opt.errors import InputError
from scsr_opt.inputs import check_type, picture_shape, pixel_gain, prior_strength, whole
from scsr_opt.motion.estimate import Automatic, Estimator, estimate_motion
from scsr_opt.motion.handed_in import checked, given
from scsr_opt.motion.refine import refine as refined
from scsr_opt.motion.trajectory import Motion
from scsr_opt.operators.blur import Blur
from scsr_opt.operators.optics import estimate_gaussian_optics
from scsr_opt.operators.robust import Loss
from scsr_opt.operators.sampling import DataTerm
from scsr_opt.placing import Measurements, Stream, first_picture, measured, stream_around
from scsr_opt.priors.default import default_prior
from scsr_opt.priors.prior import Prior
from scsr_opt.progress import Progress
from scsr_opt.rounds import Rounds
from scsr_opt.skip import Plan, plan_of
from scsr_opt.solvers.iterate import Solver, run
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA
from scsr_opt.solvers.solution import Result, Solution
from scsr_opt.strength import (
    Validated,
    longest_merged,
    noise_of_mean,
    relative_strength,
    strength_of_noise,
    validated_strength,
)

# Spike frames used around the key frame (2.5 ms at 40 kHz): enough to see every sensor pixel through many apertures,
# short enough for motion to be smooth.
FRAMES = 101
# Turns of picture and gain: one gets most, two all.
_TURNS = 2
# Pixels, about, whose gains say whether there is a fixed pattern: their spread is known to 6 % of itself (1.17 / √n, as
# it is taken from the median of absolute deviations).
_LOOKED_AT = 400


def reconstruct(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    frames: SupportsIndex = FRAMES,
    white_rate: SupportsFloat | None = None,
    velocity: ArrayLike | Sequence[float | int] | Estimator | Motion | None = None,
    bad_pixels: ArrayLike | None = None,
    samples: Measuring | None = None,
    gain: ArrayLike | Literal["auto", "blind"] | None = "auto",
    optics: Blur | Literal["estimate"] | None = None,
    prior: Prior | None = None,
    strength: SupportsFloat | None = None,
    robust: Loss | None = None,
    solver: Solver | None = None,
    refine: SupportsIndex = 0,
    skip: bool = True,
    state: Any = None,
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
      right); a `Motion`, with its layers; or an `Estimator` (`Still`, `Global`, `Dense`, `Automatic`). Estimated by
      `Automatic` if not given. Numbers are taken as they are, for straight paths and without edges: what one thing
      hides of another is not left out, as it is with the layers of a `Motion`.
    - `bad_pixels`: (h, w), true or 1 where a pixel must not be used (added to those of the recording).
    - `samples`: what the Y_i are: `Intervals()` if not given, or `Windows(length)` of so many frames.
    - `gain`: of each pixel, (h, w); None for 1; or "blind" to take it from the recording: where the scene moves by a
      pixel from a first picture, solving again, twice (`blind_gain`), elsewhere by what is known of pictures
      (`gain_at_rest`). "auto", the default, solves again only where the gains found spread by more than they do by
      chance (`FIXED_PATTERN`). Where it is solved again the motion is estimated anew, as it is over gains handed in: a
      pattern rests, whatever moves. `Solution.stats` has their standard deviations, `gain_spread` where the scene moves
      by a pixel and `gain_spread_at_rest` elsewhere.
    - `optics`: the lens, as a `Blur` of the high-resolution picture; or "estimate" for the Gaussian one that predicts
      pixels which were held out, at the cost of seven solves (`estimate_gaussian_optics`). Perfect if not given.
    - `prior`: Ψ; if not given, the learned `RidgeRegulariser` up to a scale of 3, above it `HuberTotalVariation`.
    - `strength`: λ; if not given, the one that predicts intervals which were held out
      (`validated_strength`), or, with a robust loss, by their noise. `PlugAndPlay` needs one.
    - `robust`: ρ(e) in the place of e²/2: `Huber()` or `Welsch()`, by reweighting.
    - `solver`: `FISTA` if not given. Its limit of iterations holds for the first solve and, where exposures are long
      enough to need them or `robust` is given, for each of up to ten corrections after it.
    - `refine`: how many times the motion is refined against the picture, and the picture solved for again.
    - `skip`: leave out the work that this scene does not need (`scsr_opt.skip`). False does all of it: motion of every
      kind over the whole sensor, and every interval as a sample of its own; for comparison.
    - `state`: `Solution.state` of a similar problem (other strength, data, or more iterations), solved by the same
      solver and prior at the same size: where to start.
    - `progress`: told of the progress. `keep_images`: every stage keeps its pictures.

    **Returns:** `Solution`; `.image` is (s·h, s·w) float32, intensity 1 = white. `.stats["saturated"]` is the share of
    the pixels that fired in 90 % of the frames or more: where they lie the picture is a lower bound.

    **Raises:** `InputError` if something handed in cannot be used. A solve that fails is not raised, but said by
    `Solution.result`.
    """
    clock = _Clock()
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
    height, width = recording.height, recording.width
    scale = whole(scale, "scale", 1)
    shape = picture_shape(recording, scale)
    check_type(samples, Measuring, "samples", "Intervals()")
    check_type(prior, Prior, "prior", "HuberTotalVariation()")
    prior = default_prior(scale) if prior is None else prior
    check_type(solver, Solver, "solver", "FISTA()")
    solver = FISTA() if solver is None else solver
    solver.check(prior)
    check_type(robust, Loss, "robust", "Huber()")
    lens = None if isinstance(optics, str) and optics == "estimate" else optics
    check_type(lens, Blur, "optics", "Blur.gaussian(shape, sigma), or 'estimate'")
    blind = isinstance(gain, str) and gain in ("auto", "blind")
    gains = None if gain is None or blind else pixel_gain(gain, height, width)
    rounds_of_motion = whole(refine, "refine", 0)
    if strength is not None:
        strength = prior_strength(strength)
    else:
        relative_strength(prior)  # one without is refused before anything is computed
    _, stream = stream_around(recording, key=key, frames=frames, white_rate=white_rate, bad_pixels=bad_pixels)
    clock.lap("reading")

    velocity = Automatic(skip=skip) if velocity is None else velocity

    def estimated(by: Estimator, gain: Float[np.ndarray, "h w"] | None) -> Motion:
        return estimate_motion(
            stream.spikes,
            key=stream.key,
            white_rate=stream.white_rate,
            estimator=by,
            bad_pixels=stream.bad_pixels,
            gain=gain,
        )

    if isinstance(velocity, Estimator):
        motion = estimated(velocity, gains)
    elif isinstance(velocity, Motion):
        motion = checked(velocity, height, width)
    else:
        motion = given(velocity, height, width)
    clock.lap("motion")

    learned: dict[str, float] = {}
    known = gain_is_known(motion.moved(len(stream.spikes)))
    resting = None
    if blind and not known.all():
        resting = gain_at_rest(stream.spikes, white_rate=stream.white_rate, bad_pixels=stream.bad_pixels, skip=skip)
        gains = np.where(known, 1, resting)
        learned["gain_spread_at_rest"] = spread_of(resting, ~known)
    measuring = Intervals() if samples is None else samples
    # Outliers that were held out would decide.
    validate = strength is None and robust is None

    def measured_along(motion: Motion, gain: Float[np.ndarray, "h w"] | None) -> Measurements:
        return measured(
            stream,
            motion,
            scale=scale,
            measuring=measuring,
            gain=gain,
            merge=skip,
            longest=longest_merged(stream, motion, scale, lens),
            on_sensor=skip and not rounds_of_motion,
        )

    taken = measured_along(motion, gains)
    used = int(jnp.count_nonzero(taken.placed.weight))
    if used == 0 or not stream.spikes.any():
        stats = {"iterations": 0, "samples": 0, "seconds": clock.laps}
        return Solution(np.zeros(shape, np.float32), (), Result.no_samples, stats, motion)
    noise = noise_of_mean(stream)
    plan = _plan(stream, motion, taken, noise, measuring) if skip else None
    clock.lap("samples")

    by_noise = strength_of_noise(noise, scale, prior) if strength is None else strength
    rounds = Rounds(
        solver=solver,
        prior=prior,
        strength=jnp.asarray(by_noise, jnp.float32),
        optics=lens,
        robust=robust,
        progress=progress,
        keep_images=keep_images,
    )
    image, near = first_picture(stream, shape), None
    if lens is not optics:
        σ = learned["optics_sigma"] = _sigma_of_optics(taken, motion, stream, rounds, image)
        rounds = replace(rounds, optics=Blur.gaussian(shape, σ * scale))

    def validated(taken: Measurements) -> Validated:
        return validated_strength(
            stream,
            motion,
            taken,
            image,
            scale=scale,
            prior=rounds.prior,
            solver=rounds.solver,
            measuring=measuring,
            gain=gains,
            optics=rounds.optics,
            noise=noise,
            skip=skip,
        )

    if validate:
        λ, near = validated(taken)
        rounds = replace(rounds, strength=jnp.asarray(λ, jnp.float32))
    clock.lap("strength")
    found = rounds(taken.placed, image, state, near=near)
    stages = found.outcome.stages
    measured_as = taken
    turns = _TURNS if blind and known.any() else 0
    if turns and gain == "auto" and found.outcome.result.good:
        few = np.zeros(known.size, bool)
        few[np.flatnonzero(known)[:: max(1, np.count_nonzero(known) // _LOOKED_AT) if skip else 1]] = True
        few = few.reshape(known.shape)
        looked = measured_as.gain(stream, motion, found.blurred, robust=robust, of=few)
        learned["gain_spread"] = spread_of(looked, few)
        turns = _TURNS if learned["gain_spread"] >= FIXED_PATTERN else 0
    for turn in range(turns):
        if not found.outcome.result.good:
            break
        gains = measured_as.gain(stream, motion, found.blurred, robust=robust, at_rest=resting)
        learned["gain_spread"] = spread_of(gains, known)
        if isinstance(velocity, Estimator):  # a pattern, which rests, had been among what moves
            motion = estimated(velocity, gains)
            measured_as = measured_along(motion, None)
            plan = _plan(stream, motion, measured_as, noise, measuring) if skip else None
            known = gain_is_known(motion.moved(len(stream.spikes)))
            gains = measured_as.gain(stream, motion, found.blurred, robust=robust, at_rest=resting)
        taken = measured_as.with_gain(gains, known, noise)
        if validate and turn == 0:  # a fixed pattern asked for more
            rounds = replace(rounds, strength=jnp.asarray(validated(taken).strength, jnp.float32))
        found = rounds(taken.placed, image, found.outcome.state)
        stages += found.outcome.stages
    for _ in range(rounds_of_motion):
        if not found.outcome.result.good:
            break
        better = refined(motion, found.blurred, taken.padded, taken.placed, key=stream.key)
        motion = replace(better, trust=motion.trust)  # no more than what it was refined from
        taken = measured_along(motion, None if blind else gains)
        if blind and gains is not None:
            taken = taken.with_gain(gains, known, noise)
        found = rounds(taken.placed, image, found.outcome.state)
        stages += found.outcome.stages
    clock.lap("solving")
    outcome = found.outcome
    stats = {
        "iterations": len(stages),
        "samples": int(jnp.count_nonzero(taken.placed.weight)),
        "positions": taken.placed.finest,
        "strength": float(rounds.strength),
        "objective": stages[-1].objective,
        "speed_max": float(motion.speed.max()),
        "saturated": share_saturated(spike_counts(stream.spikes), len(stream.spikes), stream.bad_pixels),
        **learned,
        **({} if plan is None else {"plan": plan.numbers}),
        "seconds": clock.laps,
    }
    stages = tuple(replace(stage, number=n) for n, stage in enumerate(stages, 1))
    return Solution(outcome.image, stages, outcome.result, stats, motion, outcome.state, plan)


def _plan(stream: Stream, motion: Motion, taken: Measurements, noise: float, measuring: Measuring) -> Plan:
    samples = taken.samples
    plan = plan_of(
        stream.spikes,
        motion,
        taken.merged_for,
        pixel=samples.row * stream.spikes.shape[2] + samples.column,
        light=taken.light,
        used=np.asarray(taken.placed.weight)[: samples.row.size],
        noise=noise * stream.white_rate,
    )
    # Nothing else is ever merged.
    return plan if isinstance(measuring, Intervals) else replace(plan, intervals=plan.samples)


class _Clock:
    """Seconds by part of the work."""

    def __init__(self):
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now


# Sensor pixels that it takes, at least, to predict a tenth of them from the others.
_ENOUGH = 100


def _sigma_of_optics(
    taken: Measurements, motion: Motion, stream: Stream, rounds: Rounds, image: Float[Array, "H W"]
) -> float:
    """Standard deviation of the lens's blur, sensor pixels, by solves without corrections."""
    moved = float(motion.speed.max()) * len(stream.spikes)
    if motion.speed.size < _ENOUGH or moved < 1:
        raise InputError(
            f"optics is 'estimate', but this recording has {motion.speed.size} pixels and moves by {moved:.2g} of "
            f"them; it takes {_ENOUGH} pixels and a motion by 1 to tell a lens from a soft picture: hand in the Blur."
        )

    def solved(term: DataTerm) -> Float[Array, "H W"]:
        return jnp.asarray(run(rounds.solver, Problem(term, rounds.prior, rounds.strength), image).image)

    pixel = taken.padded.row * motion.speed.shape[1] + taken.padded.column
    return estimate_gaussian_optics(taken.placed, jnp.asarray(pixel), solved).sigma
