"""`Task`: a clip, a scale and options, and the stages that need nothing else (motion, samples, scene summary)."""

import time
from dataclasses import dataclass, replace
from typing import SupportsIndex

import numpy as np
from jaxtyping import Float, Shaped
from numpy.typing import ArrayLike

from scsr_opt._kernels.programs import ready
from scsr_opt._validation import whole
from scsr_opt.calibration.gain_network import gain_at_rest
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.sampling_rules import Intervals
from scsr_opt.motion.estimators.automatic import Automatic, corrected_frames, motion_in
from scsr_opt.motion.estimators.base import Estimator
from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.light import FoundLight, along_motion, find_light
from scsr_opt.motion.trajectory import Motion, Trajectory, trajectory_of
from scsr_opt.operators.operator import LinearOperator
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.measurement import Measurements, measure
from scsr_opt.pipeline.options import Options
from scsr_opt.pipeline.scene_summary import SampleWeights, SceneSummary, summarise_scene
from scsr_opt.pipeline.strength import StrengthSearch, longest_merged
from scsr_opt.priors.prior import Prior
from scsr_opt.solvers.solver import Solver


@dataclass(frozen=True, eq=False)
class Task:
    """One picture that is to be solved for.

    **Fields:** `recording`; `scale` s; `options`, validated for both; `clip`, the frames around the key frame, which
    took `reading_seconds` to read; `light_unexplained`, share of the sensor whose brightness changes for no reason
    that was found (`FoundLight`).
    """

    recording: Recording
    scale: int
    options: Options
    clip: Clip
    reading_seconds: float = 0.0
    light_unexplained: float = 0.0

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the picture."""
        return self.scale * self.clip.shape[0], self.scale * self.clip.shape[1]

    @property
    def estimator(self) -> Estimator | None:
        """The estimator of the motion; None where the motion is given."""
        motion = self.options.motion
        if isinstance(motion, Motion):
            return None
        if motion is not None:
            return motion
        return Automatic(self.options.shortcuts.simple_motion, settings=self.options.settings.motion)

    def motion_frames(self, gain: Float[np.ndarray, "h w"] | None) -> MotionFrames | None:
        """Short pictures along the clip, over these gains, to estimate motion by; None where no motion can show."""
        clip = self.clip
        return corrected_frames(
            clip.spikes,
            key=clip.key,
            white_rate=clip.white_rate,
            bad_pixels=clip.bad_pixels,
            gain=gain,
            light=clip.light,
            settings=self.options.settings.motion,
        )

    def with_light_along(self, motion: Motion, frames: MotionFrames) -> "Task":
        """This task with the light of each pixel, where lamps differ, as it is found along a motion."""
        assert self.clip.light is not None
        light = along_motion(self.clip.light, frames, motion, self.clip.key, self.options.settings.motion)
        return replace(self, clip=self.clip._replace(light=light))

    def at_wanted_light(self) -> "Task":
        """This task with its light relative to that at which the picture is to show the scene (`Options.light`)."""
        light = self.clip.light
        if light is None or self.options.light != "key":
            return self
        return replace(self, clip=self.clip._replace(light=light.relative_to(self.clip.key)))

    def estimate_motion(self, frames: MotionFrames | None) -> Motion:
        """The motion that these pictures show, or the one that was given."""
        if isinstance(self.options.motion, Motion):
            return self.options.motion
        if frames is None:
            return Motion.none(*self.clip.shape)
        return motion_in(frames, self.estimator, self.options.settings.motion)

    def estimate_gain_at_rest(self) -> Float[np.ndarray, "h w"]:
        """Gains of the pixels of a scene at rest, (h, w), estimated from the picture by a network (`gain_at_rest`)."""
        clip = self.clip
        return gain_at_rest(
            clip.spikes,
            white_rate=clip.white_rate,
            bad_pixels=clip.bad_pixels,
            sampled_gains=self.options.shortcuts.sampled_gains,
            settings=self.options.settings.gain,
        )

    def trajectory(self, motion: Motion) -> Trajectory:
        """The motion followed through all frames of the clip."""
        settings = self.options.settings.motion.trajectory
        return trajectory_of(motion, key=self.clip.key, start=0, stop=len(self.clip.spikes), settings=settings)

    def measure(
        self, motion: Motion, gain: Float[np.ndarray, "h w"] | None, path: Trajectory | None = None
    ) -> Measurements:
        """The samples along a motion; `path`: its trajectory, where that is known already."""
        options = self.options
        # Samples that are held out to find the strength must not be merged with those that are kept.
        longest = None
        if options.selects_strength:
            longest = longest_merged(self.clip, motion, self.scale, options.lens, options.settings.strength)
        return measure(
            self.clip,
            self.trajectory(motion) if path is None else path,
            scale=self.scale,
            sampling=options.samples,  # type: ignore[arg-type]
            gain=gain,
            merged_intervals=options.shortcuts.merged_intervals,
            longest=1 if options.samples_apart else longest,
            on_sensor=options.shortcuts.sensor_grid and not options.refine,
            settings=options.settings.sampling,
        )

    def strength_search(
        self,
        prior: Prior,
        solver: Solver,
        *,
        gain: Float[np.ndarray, "h w"] | None,
        optics: LinearOperator | None,
        noise: float,
    ) -> StrengthSearch:
        """The search for the strength that predicts held-out samples."""
        return StrengthSearch(
            scale=self.scale,
            prior=prior,
            solver=solver,
            sampling=self.options.samples,  # type: ignore[arg-type]
            gain=gain,
            optics=optics,
            noise=noise,
            merged_intervals=self.options.shortcuts.merged_intervals,
            reused_sums=self.options.shortcuts.reused_sums,
            sampling_settings=self.options.settings.sampling,
            settings=self.options.settings.strength,
        )

    def summarise(self, motion: Motion, measurements: Measurements, noise: float) -> SceneSummary | None:
        """Summary of what each part of the scene needed; None where no work may be left out."""
        if not self.options.shortcuts.any:
            return None
        samples, clip = measurements.samples, self.clip
        summary = summarise_scene(
            clip.spikes,
            motion,
            measurements.still_for,
            measurements.merged_for,
            weights=SampleWeights(
                pixel=np.asarray(samples.row * clip.shape[1] + samples.column),
                measured=measurements.light,
                placed=np.asarray(measurements.placed.weight)[: samples.row.size],
            ),
            noise=noise * clip.white_rate,
            bad_pixels=clip.bad_pixels,
            settings=self.options.settings.scene_summary,
        )
        # Only intervals are ever merged.
        return summary if isinstance(self.options.samples, Intervals) else summary.unmerged()


def task_of(spikes: ArrayLike | Recording, scale: SupportsIndex, key: SupportsIndex | None, options: Options) -> Task:
    """The clip around a key frame with its validated options. **Raises:** `InputError` for what cannot be used."""
    ready()
    began = time.perf_counter()
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
    scale = whole(scale, "scale", 1)
    options = options.validated(recording, scale)
    part = recording if options.crop is None else recording.crop(*options.crop)
    clip = Clip.around(part, key, frames=options.frames, white_rate=options.white_rate, bad_pixels=options.bad_pixels)
    found = FoundLight(None, 0.0) if options.light == "constant" else _light_of(clip, part, options)
    clip = clip._replace(light=found.light)
    return Task(recording, scale, options, clip, time.perf_counter() - began, found.unexplained)


def _light_of(clip: Clip, recording: Recording, options: Options) -> FoundLight:
    """The light of a clip of a recording."""

    def read(begin: int, end: int) -> Shaped[np.ndarray, "n h w"]:
        return recording.window(clip.start + begin, clip.start + end)

    after = recording.frames - clip.start - len(clip.spikes)
    return find_light(
        clip.spikes,
        bad_pixels=clip.bad_pixels,
        before=clip.start,
        after=after,
        read=read,
        settings=options.settings.motion,
    )
