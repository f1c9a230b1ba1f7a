"""From spikes to a super-resolved picture: the one function that most users call."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, SupportsFloat, SupportsIndex

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool
from numpy.typing import ArrayLike

from scsr_opt.camera.gain import FIXED_PATTERN, gain_is_known, spread_of
from scsr_opt.camera.measuring import Measuring
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.saturation import share_saturated, spike_counts
from scsr_opt.motion.estimate import Estimator
from scsr_opt.motion.refine import refine as refined
from scsr_opt.motion.trajectory import Motion
from scsr_opt.operators.blur import Blur
from scsr_opt.operators.robust import Loss
from scsr_opt.preparation import FRAMES, Prepared, prepare
from scsr_opt.priors.prior import Prior
from scsr_opt.progress import Progress
from scsr_opt.solvers.iterate import Solver
from scsr_opt.solvers.solution import Result, Solution

# Turns of picture and gain: one gets most, two all.
_TURNS = 2
# Pixels, at most, whose gains say whether there is a fixed pattern: their spread is known to 3.5 % of itself (1 / √2n).
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
    - `robust`: ρ(e) in the place of e²/2: `Huber()` or `Welsch()`, by reweighting. No intervals are merged then.
    - `solver`: if not given, `FISTA`, or where nothing moves `DataProximal` (`default_solver`). Its limit of iterations
      holds for the whole solve, corrections of exposures included; with `robust`, for each of up to eleven rounds.
    - `refine`: how many times the motion is refined against the picture, and the picture solved for again.
    - `skip`: leave out the work that this scene does not need (`scsr_opt.skip`). False does all of it, for comparison:
      motion of every kind over the whole sensor, every interval as a sample of its own with as many positions along
      it as any of them needs, gains of all pixels, iterations of the whole picture until its last tile is finished.
      Where two motions explain a recording about equally well, each way may settle on another (2 of 48 recordings).
    - `state`: `Solution.state` of a similar problem (other strength, data, or more iterations), solved by the same
      solver and prior at the same size: where to start.
    - `progress`: told of the progress. `keep_images`: every stage keeps its pictures.

    Arrays that are handed in are read or copied before it returns, and never written to; those of the `Solution` are
    the caller's own, and may be.

    **Returns:** `Solution`; `.image` is (s·h, s·w) float32, intensity 1 = white. `.stats["saturated"]` is the share of
    the pixels that fired in 90 % of the frames or more: where they lie the picture is a lower bound.

    **Raises:** `InputError` if something handed in cannot be used. A solve that fails is not raised, but said by
    `Solution.result`.
    """
    prepared = prepare(
        spikes,
        scale=scale,
        key=key,
        frames=frames,
        white_rate=white_rate,
        velocity=velocity,
        bad_pixels=bad_pixels,
        samples=samples,
        gain=gain,
        optics=optics,
        prior=prior,
        strength=strength,
        robust=robust,
        solver=solver,
        refine=refine,
        skip=skip,
        progress=progress,
        keep_images=keep_images,
    )
    return solve(prepared, state).handed_out()


def solve(prepared: Prepared, state: Any = None) -> Solution:
    """All of `reconstruct` from the first iteration on; `state` as there."""
    asked, clock, learned = prepared.asked, prepared.clock, prepared.learned
    stream, image, robust = asked.stream, prepared.image, prepared.rounds.robust
    if not prepared.usable:
        stats = {"iterations": 0, "samples": 0, **_planned(prepared), "seconds": clock.laps}
        nothing = np.zeros(image.shape, np.float32)
        return Solution(nothing, (), Result.no_samples, stats, prepared.motion, plan=prepared.plan)
    clock.resume()
    found = prepared.rounds(prepared.taken.placed, image, state, near=prepared.near, term=prepared.term)
    stages = found.outcome.stages
    motion, measured_as = prepared.motion, prepared.taken
    known = gain_is_known(motion.moved(len(stream.spikes)))
    turns = _TURNS if asked.gain is not None and known.any() else 0
    if turns and asked.gain == "auto" and found.outcome.result.good:
        # Some of the pixels, and all where those show a pattern.
        for pixels in [_some(known), known] if asked.skip else [known]:
            looked = measured_as.gain(stream, motion, found.blurred, robust=robust, of=pixels)
            learned["gain_spread"] = spread_of(looked, pixels)
            if learned["gain_spread"] < FIXED_PATTERN:
                turns = 0
                break
    for turn in range(turns):
        if not found.outcome.result.good:
            break
        gains = measured_as.gain(stream, motion, found.blurred, robust=robust, at_rest=prepared.resting)
        learned["gain_spread"] = spread_of(gains, known)
        if asked.estimator is not None:  # a pattern, which rests, had been among what moves
            motion = asked.estimated(asked.compared(gains))
            measured_as = asked.measured(motion, None)
            known = gain_is_known(motion.moved(len(stream.spikes)))
            gains = measured_as.gain(stream, motion, found.blurred, robust=robust, at_rest=prepared.resting)
            prepared = replace(prepared, motion=motion, plan=asked.plan(motion, measured_as, prepared.noise))
        taken = measured_as.with_gain(gains, known, prepared.noise)
        prepared = replace(prepared, taken=taken, gains=gains)
        term = None
        if asked.validates and turn == 0:  # a fixed pattern asked for more
            λ, _, sums = prepared.validated()
            prepared = replace(prepared, rounds=replace(prepared.rounds, strength=jnp.asarray(λ, jnp.float32)))
            term = prepared.rounds.term(taken.placed, sums=sums)
        found = prepared.rounds(taken.placed, image, found.outcome.state, term=term)
        stages += found.outcome.stages
    for _ in range(asked.refine):
        if not found.outcome.result.good:
            break
        better = refined(motion, found.blurred, prepared.taken.padded, prepared.taken.placed, key=stream.key)
        motion = replace(better, trust=motion.trust)  # no more than what it was refined from
        taken = asked.measured(motion, None if asked.gain is not None else prepared.gains)
        if asked.gain is not None and prepared.gains is not None:
            taken = taken.with_gain(prepared.gains, known, prepared.noise)
        prepared = replace(prepared, motion=motion, taken=taken, plan=asked.plan(motion, taken, prepared.noise))
        found = prepared.rounds(taken.placed, image, found.outcome.state)
        stages += found.outcome.stages
    clock.lap("solving")
    outcome, placed = found.outcome, prepared.taken.placed
    stats = {
        "iterations": len(stages),
        "solver": type(prepared.rounds.solver).__name__,
        "samples": int(jnp.count_nonzero(placed.weight)),
        "positions": placed.finest,
        "strength": float(prepared.rounds.strength),
        "objective": stages[-1].objective,
        "speed_max": float(motion.speed.max()),
        "saturated": share_saturated(spike_counts(stream.spikes), len(stream.spikes), stream.bad_pixels),
        **learned,
        **_planned(prepared),
        **({} if outcome.active is None else {"active": outcome.active.numbers}),
        "seconds": clock.laps,
    }
    stages = tuple(replace(stage, number=n) for n, stage in enumerate(stages, 1))
    return Solution(
        image=outcome.image,
        stages=stages,
        result=outcome.result,
        stats=stats,
        motion=motion,
        state=outcome.state,
        plan=prepared.plan,
        gain=prepared.gains,
        active=outcome.active,
    )


def _some(pixels: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Some of these pixels, by chance, the same each time: a pattern that repeats would be missed by every so many."""
    chosen = np.random.default_rng(0).permutation(np.flatnonzero(pixels))[:_LOOKED_AT]
    some = np.zeros(pixels.shape, bool)
    some.reshape(-1)[chosen] = True
    return some


def _planned(prepared: Prepared) -> dict[str, Any]:
    return {} if prepared.plan is None else {"plan": prepared.plan.numbers}
