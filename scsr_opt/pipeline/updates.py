"""Updates between two solves: the light of the pixels, their gains, the motion, and the picture that the prior is
centred at, from the picture so far.

`solve_with_updates` solves, applies an update, and solves again from there. Two more updates happen within a solve, as
they need no more than its picture: corrections for the motion during exposures, and weights of a robust loss
(`scsr_opt.pipeline.outer_loop`).

An update that measures anew lets the measurements before go first (`Measurements.let_go`): at 400×250 pixels they hold
a quarter of a gigabyte, which callers would keep until the end.
"""

import abc
import time
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.ndimage import gaussian_filter

from scsr_opt._kernels.device import on_device
from scsr_opt._kernels.memory import give_memory_back
from scsr_opt.calibration.gain import gain_is_known, spread_of
from scsr_opt.motion.lamps import parts_by, parts_of
from scsr_opt.pipeline.assembly import Assembly
from scsr_opt.pipeline.measurement import Measurements
from scsr_opt.pipeline.motion_refinement import refine
from scsr_opt.pipeline.outer_loop import Majorized
from scsr_opt.pipeline.restoration import Solved, solved
from scsr_opt.priors.centred import Centred
from scsr_opt.solvers.record import Stage, Status

# Standard deviation, sensor pixels, of the mean that takes the place of pixels that are left out.
_NEAR_PX = 2.0


class Updated(NamedTuple):
    """The problem after an update.

    **Fields:** `changed`: it must be solved again; `anew`: from `Assembly.near`, not from where the last solve ended;
    `failed`: the update found a value that is not finite.
    """

    assembly: Assembly
    changed: bool
    anew: bool = False
    failed: bool = False


class Update(abc.ABC):
    """Part of the problem that is found anew from the picture of a solve."""

    @abc.abstractmethod
    def rounds(self, assembly: Assembly) -> int:
        """The number of times that it is applied, at most."""

    @abc.abstractmethod
    def __call__(self, assembly: Assembly, found: Majorized, number: int) -> Updated:
        """The problem after update `number`, counted from 0; `found`: the solve before it."""


@dataclass(frozen=True)
class LightUpdate(Update):
    """The parts of the sensor that different lamps light (`scsr_opt.motion.lamps.parts_by`): first the picture without
    the pixels near their edges, then, as it predicts what these should have measured, the part of each, with the motion
    that is estimated in that light."""

    def rounds(self, assembly: Assembly) -> int:
        light, settings = assembly.task.clip.light, assembly.task.options.settings.motion.light
        return 0 if light is None or parts_of(light, settings) is None else 2 * settings.part_rounds

    def __call__(self, assembly: Assembly, found: Majorized, number: int) -> Updated:
        task, measured, settings = assembly.task, assembly.measured, assembly.task.options.settings.motion.light
        light = task.clip.light
        assert light is not None  # `rounds`
        parts = parts_of(light, settings)
        assert parts is not None
        if number % 2 == 0:
            edge = parts.edge(settings.uncertain_px)
            kept, near = assembly.measurements.without(edge), _without(edge, found.outcome.image, task.scale)
            return Updated(replace(assembly, measurements=kept, near=near, term=None), True, anew=True)
        samples, placed = measured.samples, measured.placed
        seen = assembly.measurements.placed.seen()  # without the pixels near the edge
        seen = jnp.kron(
            seen / jnp.mean(seen), jnp.ones([n // m for n, m in zip(placed.shape, seen.shape, strict=True)])
        )
        of_samples = placed.read(found.blurred), placed.weight, placed.read(seen)
        predicted, weight, coverage = (np.asarray(of)[: samples.row.size] for of in of_samples)
        if assembly.gain is not None:
            predicted = predicted * assembly.gain[samples.row, samples.column]
        measured.let_go()
        parts = parts_by(light, parts, samples, predicted, weight, coverage, settings)
        light = replace(light, share=parts.share[:, parts.number])
        task = replace(task, clip=task.clip._replace(light=light))
        motion, path = assembly.motion, measured.path
        if task.estimator is not None:
            motion = task.estimate_motion(task.motion_frames(task.options.known_gain))
            give_memory_back()
            path = task.trajectory(motion)
        measured = task.measure(motion, assembly.gain, path)
        scene = task.summarise(motion, measured, assembly.noise)
        assembly = replace(assembly, task=task, motion=motion, measured=measured, measurements=measured, scene=scene)
        return Updated(replace(assembly, near=None, term=None), True)


@dataclass(frozen=True)
class GainUpdate(Update):
    """Gains of the pixels that see the scene move by a pixel, as the picture predicts what they should have measured
    (`blind_gain`). Motion is then estimated again over the gains, and the strength validated again, once."""

    def rounds(self, assembly: Assembly) -> int:
        options = assembly.task.options
        return options.settings.gain.rounds if options.finds_gain and assembly.gain_known.any() else 0

    def __call__(self, assembly: Assembly, found: Majorized, number: int) -> Updated:
        options = assembly.task.options
        if number == 0 and options.gain == "auto":
            spread = self._pattern(assembly, found)
            assembly = _with_spread(assembly, spread)
            if spread < options.settings.gain.pattern_spread:
                return Updated(assembly, False)
        task, motion, measured, known = assembly.task, assembly.motion, assembly.measured, assembly.gain_known
        gain = self._gain(assembly, found, measured, at_rest=assembly.gain_at_rest)
        assembly = _with_spread(assembly, spread_of(gain, known))
        if task.estimator is not None:  # motion was estimated with the pattern in, which rests
            measured.let_go()
            motion = task.estimate_motion(task.motion_frames(gain))
            give_memory_back()
            measured = task.measure(motion, None)
            known = gain_is_known(motion.moved(len(task.clip.spikes)), options.settings.gain)
            assembly = replace(assembly, motion=motion)
            gain = self._gain(assembly, found, measured, at_rest=assembly.gain_at_rest)
            scene = task.summarise(motion, measured, assembly.noise)
            assembly = replace(assembly, measured=measured, gain_known=known, scene=scene)
        measurements = measured.with_gain(gain, known, assembly.noise)
        assembly = replace(assembly, measurements=measurements, gain=gain, near=None, term=None)
        if options.selects_strength and number == 0:  # with the pattern in, a stronger prior had predicted best
            assembly = replace(assembly.with_validated_strength(), near=None).with_sums()
        return Updated(assembly, True)

    def _pattern(self, assembly: Assembly, found: Majorized) -> float:
        """Spread of the gains: of some of the pixels first, of all where those show a pattern."""
        known, options, spread = assembly.gain_known, assembly.task.options, 0.0
        settings = options.settings.gain
        sampled = [_some(known, settings.probed_pixels)] if options.shortcuts.sampled_gains else []
        for pixels in [*sampled, known]:
            spread = spread_of(self._gain(assembly, found, assembly.measured, pixels=pixels), pixels)
            if spread < settings.pattern_spread:
                break
        return spread

    def _gain(
        self,
        assembly: Assembly,
        found: Majorized,
        measured: Measurements,
        *,
        pixels: Bool[np.ndarray, "h w"] | None = None,
        at_rest: Float[np.ndarray, "h w"] | None = None,
    ) -> Float[np.ndarray, "h w"]:
        return measured.gain(
            assembly.task.clip,
            assembly.motion,
            found.blurred,
            robust=assembly.method.robust,
            pixels=pixels,
            at_rest=at_rest,
            settings=assembly.task.options.settings.gain,
        )


@dataclass(frozen=True)
class MotionRefinement(Update):
    """The motion, refined against the picture (`scsr_opt.pipeline.motion_refinement`)."""

    def rounds(self, assembly: Assembly) -> int:
        return int(assembly.task.options.refine)

    def __call__(self, assembly: Assembly, found: Majorized, number: int) -> Updated:
        task, motion, before = assembly.task, assembly.motion, assembly.measurements
        settings = task.options.settings.refinement
        refined = refine(motion, found.blurred, before.padded, before.placed, key=task.clip.key, settings=settings)
        before.let_go()
        motion = replace(refined, trust=motion.trust, reach=motion.reach)  # as reliable as the motion that was refined
        gain, finds_gain = assembly.gain, task.options.finds_gain
        measured = task.measure(motion, None if finds_gain else gain)
        measurements = measured
        if finds_gain and gain is not None:
            measurements = measured.with_gain(gain, assembly.gain_known, assembly.noise)
        scene = task.summarise(motion, measurements, assembly.noise)
        assembly = replace(assembly, motion=motion, measured=measured, measurements=measurements, scene=scene)
        return Updated(replace(assembly, near=None, term=None), True)


@dataclass(frozen=True)
class CentreUpdate(Update):
    """The prior, centred at the picture that a network makes of the solution (`Options.quality`,
    `scsr_opt.pipeline.restoration`): Ψ(X − X̂) in the place of Ψ(X)."""

    def rounds(self, assembly: Assembly) -> int:
        return 1 if assembly.restores else 0

    def __call__(self, assembly: Assembly, found: Majorized, number: int) -> Updated:
        began, method = time.perf_counter(), assembly.method
        restoration = assembly.task.options.restoration(assembly.task.scale)
        assert restoration is not None  # `rounds`
        centre = jnp.asarray(restoration(solved_by(assembly, found)))
        if not bool(jnp.isfinite(centre).all()):
            return Updated(assembly, False, failed=True)
        diagnostics = replace(
            assembly.diagnostics,
            strength=assembly.strength,
            seconds={**assembly.diagnostics.seconds, "restoring": time.perf_counter() - began},
        )
        strength = on_device(np.float32(restoration.strength_ratio * assembly.strength))
        method = replace(method, prior=Centred(method.prior, centre), strength=strength)
        assembly = replace(assembly, method=method, near=centre, diagnostics=diagnostics)
        return Updated(assembly, True, anew=True)


class Finished(NamedTuple):
    """The problem after all updates, its solve, and the stages of all solves, of which `first_iterations` were before
    the prior was centred at a restored picture; 0 where it was not."""

    assembly: Assembly
    found: Majorized
    stages: tuple[Stage, ...]
    first_iterations: int


def solve_with_updates(assembly: Assembly, state: Any, updates: tuple[Update, ...]) -> Finished:
    """Solves, and for each of the updates, in this order, applies it and solves again."""
    found = _first(assembly).solve(state)
    stages, first = list(found.outcome.stages), 0
    for update in updates:
        for number in range(update.rounds(assembly)):
            if not found.outcome.status.usable:
                break
            updated = update(assembly, found, number)
            assembly = updated.assembly
            if updated.failed:
                found = found._replace(outcome=found.outcome._replace(status=Status.non_finite))
            if not updated.changed:
                break
            first = len(stages) if isinstance(update, CentreUpdate) else 0
            found = assembly.solve(None if updated.anew else found.outcome.state)
            stages += found.outcome.stages
    numbered = tuple(replace(stage, number=number) for number, stage in enumerate(stages, 1))
    return Finished(assembly, found, numbered, first)


def _first(assembly: Assembly) -> Assembly:
    """The problem as it is solved first: less exactly if the solution is to be restored and its pixels are many."""
    settings, method = assembly.task.options.settings, assembly.method
    if not assembly.restores or assembly.task.scale <= settings.learned_prior_scale:
        return assembly
    solver = replace(method.solver, tolerance=settings.outer_loop.restored_tolerances * method.solver.tolerance)
    return replace(assembly, method=replace(method, solver=solver))


def solved_by(assembly: Assembly, found: Majorized) -> Solved:
    """The solution of the problem, and what its data say of it."""
    return solved(assembly.problem().data, found.outcome.image, assembly.method.strength)


def _with_spread(assembly: Assembly, spread: float) -> Assembly:
    return replace(assembly, diagnostics=replace(assembly.diagnostics, gain_spread=spread))


def _without(pixels: Bool[np.ndarray, "h w"], image: Float[np.ndarray, "H W"], scale: int) -> Float[Array, "H W"]:
    """The picture with the mean of what is near in the place of some pixels of the sensor: a solve from there keeps
    nothing of them."""
    known = 1 - np.kron(pixels, np.ones((scale, scale))).astype(image.dtype)
    near = [gaussian_filter(of, scale * _NEAR_PX) for of in (image * known, known)]
    return on_device(np.where(known, image, near[0] / np.maximum(near[1], np.finfo(image.dtype).tiny)))


def _some(pixels: Bool[np.ndarray, "h w"], most: int) -> Bool[np.ndarray, "h w"]:
    """`most` of these pixels by chance, the same each time; a regular choice could miss a regular pattern."""
    chosen = np.random.default_rng(0).permutation(np.flatnonzero(pixels))[:most]
    some = np.zeros(pixels.shape, bool)
    some.reshape(-1)[chosen] = True
    return some
