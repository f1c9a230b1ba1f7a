"""What is found anew between two solves: gains of the pixels, and the motion, from the picture so far.

The outer loop (`scsr_opt.pipeline.reconstruct`) solves, applies an update, and solves again from there. Two more
updates happen within a solve, as they need no more than its picture: corrections for the motion during exposures, and
weights of a robust loss (`scsr_opt.pipeline.outer_loop`).
"""

import abc
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scsr_opt.calibration.gain import FIXED_PATTERN, gain_is_known, spread_of
from scsr_opt.pipeline.assembly import Assembly
from scsr_opt.pipeline.measurement import Measurements
from scsr_opt.pipeline.motion_refinement import refine
from scsr_opt.pipeline.outer_loop import Majorized

GAIN_ROUNDS = 2
"""Rounds of picture and gain: the first finds most of a pattern, the second the rest."""
GAIN_PROBES = 400
"""Pixels, at most, whose gains say whether there is a fixed pattern: their spread is known to 3.5 % (1 / √2n)."""


class Updated(NamedTuple):
    """The problem after an update, and whether it has changed so that it must be solved again."""

    assembly: Assembly
    changed: bool


class Update(abc.ABC):
    """Part of the problem that is found anew from the picture of a solve."""

    @abc.abstractmethod
    def rounds(self, assembly: Assembly) -> int:
        """How many times it is applied at most."""

    @abc.abstractmethod
    def __call__(self, assembly: Assembly, found: Majorized, number: int) -> Updated:
        """The problem after update `number`, from 0; `found`: the solve before it."""


@dataclass(frozen=True)
class GainUpdate(Update):
    """Gains of the pixels that see the scene move by a pixel, as the picture predicts what they should have measured
    (`blind_gain`). Motion is then estimated again over the gains, and the strength validated again, once."""

    def rounds(self, assembly: Assembly) -> int:
        return GAIN_ROUNDS if assembly.task.options.finds_gain and assembly.gain_known.any() else 0

    def __call__(self, assembly: Assembly, found: Majorized, number: int) -> Updated:
        options = assembly.task.options
        if number == 0 and options.gain == "auto":
            spread = self._pattern(assembly, found)
            assembly = _with_spread(assembly, spread)
            if spread < FIXED_PATTERN:
                return Updated(assembly, False)
        task, motion, measured, known = assembly.task, assembly.motion, assembly.measured, assembly.gain_known
        gain = self._gain(assembly, found, measured, at_rest=assembly.gain_at_rest)
        assembly = _with_spread(assembly, spread_of(gain, known))
        if task.estimator is not None:  # a pattern, which rests, had been among what moves
            motion = task.estimate_motion(task.motion_frames(gain))
            measured = task.measure(motion, None)
            known = gain_is_known(motion.moved(len(task.clip.spikes)))
            assembly = replace(assembly, motion=motion)
            gain = self._gain(assembly, found, measured, at_rest=assembly.gain_at_rest)
            scene = task.summarise(motion, measured, assembly.noise)
            assembly = replace(assembly, measured=measured, gain_known=known, scene=scene)
        measurements = measured.with_gain(gain, known, assembly.noise)
        assembly = replace(assembly, measurements=measurements, gain=gain, near=None, term=None)
        if options.selects_strength and number == 0:  # a fixed pattern had asked for more
            assembly = replace(assembly.with_validated_strength(), near=None).with_sums()
        return Updated(assembly, True)

    def _pattern(self, assembly: Assembly, found: Majorized) -> float:
        """Spread of the gains: of some of the pixels first, of all where those show a pattern."""
        known, spread = assembly.gain_known, 0.0
        for pixels in [_some(known), known] if assembly.task.options.shortcuts.sampled_gains else [known]:
            spread = spread_of(self._gain(assembly, found, assembly.measured, of=pixels), pixels)
            if spread < FIXED_PATTERN:
                break
        return spread

    def _gain(
        self,
        assembly: Assembly,
        found: Majorized,
        measured: Measurements,
        *,
        of: Bool[np.ndarray, "h w"] | None = None,
        at_rest: Float[np.ndarray, "h w"] | None = None,
    ) -> Float[np.ndarray, "h w"]:
        robust = assembly.method.robust
        return measured.gain(assembly.task.clip, assembly.motion, found.blurred, robust=robust, of=of, at_rest=at_rest)


@dataclass(frozen=True)
class MotionRefinement(Update):
    """The motion, refined against the picture (`scsr_opt.pipeline.motion_refinement`)."""

    def rounds(self, assembly: Assembly) -> int:
        return int(assembly.task.options.refine)

    def __call__(self, assembly: Assembly, found: Majorized, number: int) -> Updated:
        task, motion, before = assembly.task, assembly.motion, assembly.measurements
        refined = refine(motion, found.blurred, before.padded, before.placed, key=task.clip.key)
        motion = replace(refined, trust=motion.trust)  # as reliable as the motion that was refined
        gain, finds_gain = assembly.gain, task.options.finds_gain
        measured = task.measure(motion, None if finds_gain else gain)
        measurements = measured
        if finds_gain and gain is not None:
            measurements = measured.with_gain(gain, assembly.gain_known, assembly.noise)
        scene = task.summarise(motion, measurements, assembly.noise)
        assembly = replace(assembly, motion=motion, measured=measured, measurements=measurements, scene=scene)
        return Updated(replace(assembly, near=None, term=None), True)


def _with_spread(assembly: Assembly, spread: float) -> Assembly:
    return replace(assembly, diagnostics=replace(assembly.diagnostics, gain_spread=spread))


def _some(pixels: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """`GAIN_PROBES` of these pixels by chance, the same each time; a regular choice could miss a regular pattern."""
    chosen = np.random.default_rng(0).permutation(np.flatnonzero(pixels))[:GAIN_PROBES]
    some = np.zeros(pixels.shape, bool)
    some.reshape(-1)[chosen] = True
    return some
