"""`Task`: a clip, a scale and options, and the stages that need nothing else (motion, samples, scene summary)."""

import time
from dataclasses import dataclass, replace
from typing import SupportsIndex

import numpy as np
from jaxtyping import Float, Shaped
from numpy.typing import ArrayLike

from scsr_opt._kernels.programs import ready
from scsr_opt._validation import whole
from scsr_opt.calibration.bad_pixels import BadPixels, isolated_pixels, resting_pixels
from scsr_opt.calibration.gain_network import gain_at_rest
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.sampling_rules import Intervals
from scsr_opt.camera.saturation import spike_counts
from scsr_opt.camera.white import White, find_white
from scsr_opt.motion.estimators.automatic import Automatic, corrected_frames, motion_in
from scsr_opt.motion.estimators.base import Estimator
from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.lamps import along_motion
from scsr_opt.motion.light import FoundLight, find_light, unexplained_share
from scsr_opt.motion.trajectory import Motion, Trajectory, trajectory_of
from scsr_opt.operators.operator import LinearOperator
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.measurement import Measurements, measure
from scsr_opt.pipeline.options import Options
from scsr_opt.pipeline.scene_summary import SampleWeights, SceneSummary, summarise_scene
from scsr_opt.pipeline.strength import StrengthSearch, longest_merged
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser
from scsr_opt.solvers.solver import Solver


@dataclass(frozen=True, eq=False)
class Task:
    """One picture that is to be solved for.

    **Fields:** `recording`; `scale` s; `options`, validated for both; `clip`, the frames around the key frame, which
    took `reading_seconds` to read; `bad`, all pixels that are not used, None if nothing is known of any;
    `found_light`, the light of the clip and where more changes than that (`FoundLight`).
    """

    recording: Recording
    scale: int
    options: Options
    clip: Clip
    reading_seconds: float = 0.0
    bad: BadPixels | None = None
    found_light: FoundLight = FoundLight(None)

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

    def light_unexplained(self, motion: Motion, frames: MotionFrames | None) -> float:
        """Share of the examined tiles whose brightness changes for no reason that was found (`unexplained_share`)."""
        if not self.found_light.suspected.any():
            return 0.0
        frames = self.motion_frames(self.options.known_gain) if frames is None else frames
        settings = self.options.settings.motion
        return 0.0 if frames is None else unexplained_share(self.found_light, frames, motion, settings)

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

    def find_white(self) -> White:
        """White of 8-bit pictures and figures, from the light of the clip."""
        clip = self.clip
        return find_white(
            lambda start, stop: clip.spikes[start:stop],
            len(clip.spikes),
            white_rate=clip.white_rate,
            bad_pixels=clip.bad_pixels,
            settings=self.options.settings.white,
        )

    def without(self, found: BadPixels) -> "Task":
        """The task in which these pixels are not used either; it looks for no others."""
        bad = found if self.bad is None else self.bad.also(found)
        options = replace(self.options, bad_pixels=bad)
        clip = self.clip.without(found.mask) if found.mask.any() else self.clip
        return replace(self, clip=clip, bad=bad if bad.mask.any() else self.bad, options=options)

    def find_isolated(self) -> BadPixels:
        """Pixels that stand out from their neighbours as nothing around does, by the spikes around the key frame."""
        clip, settings, gain = self.clip, self.options.settings.bad_pixels, self.options.known_gain
        crop = self.options.crop
        part = self.recording if crop is None else self.recording.crop(*crop)
        start, stop = part.around(clip.key_frame, settings.evidence_frames)
        if stop - start <= len(clip.spikes):
            spikes = clip.spikes
        else:
            spikes = part.window(start, stop)
        count = spike_counts(spikes)
        return isolated_pixels(
            count if gain is None else count / gain, len(spikes), bad=clip.bad_pixels, settings=settings
        )

    def find_resting(self, frames: MotionFrames | None, motion: Motion) -> BadPixels:
        """Pixels that rest on the sensor while the scene moves, and those that stand out once these are left out;
        `frames`: its short pictures, where they are known."""
        clip, settings = self.clip, self.options.settings.bad_pixels
        if float(motion.speed.max()) * len(clip.spikes) >= settings.least_motion_px:
            frames = self.motion_frames(self.options.known_gain) if frames is None else frames
            if frames is not None:
                found = resting_pixels(
                    np.asarray(frames.picture),
                    np.asarray(frames.after),
                    np.asarray(motion.velocity),
                    np.asarray(motion.acceleration),
                    spikes=clip.white_rate * len(clip.spikes),
                    surface=None if motion.layers is None else np.asarray(motion.layers.label),
                    bad=clip.bad_pixels,
                    settings=settings,
                )
                # The end of a hair, which its other pixels hid: it stands out without them.
                return found.also(self.without(found).find_isolated()) if found.mask.any() else found
        return BadPixels.none(clip.shape)

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
        options, learned = self.options, isinstance(prior, RidgeRegulariser)
        return StrengthSearch(
            scale=self.scale,
            prior=prior,
            solver=solver,
            sampling=options.samples,  # type: ignore[arg-type]
            gain=gain,
            optics=optics,
            restoration=options.restoration(self.scale),
            by_stand_in=learned and self.scale > options.settings.learned_prior_scale,
            noise=noise,
            merged_intervals=options.shortcuts.merged_intervals,
            reused_sums=options.shortcuts.reused_sums,
            sampling_settings=options.settings.sampling,
            settings=options.settings.strength,
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
    given = options.bad_pixels if isinstance(options.bad_pixels, BadPixels) else None
    mask = None if given is None or not given.mask.any() else given.mask
    clip = Clip.around(part, key, frames=options.frames, white_rate=options.white_rate, bad_pixels=mask)
    if options.dark is not None:
        clip = clip._replace(dark=np.asarray(options.dark) / np.float32(clip.white_rate))
    bad = None if clip.bad_pixels is None else BadPixels.given(clip.bad_pixels)
    if bad is not None and given is not None:
        bad = given.also(bad)
    task = Task(recording, scale, options, clip, bad=bad)
    if options.finds_bad_pixels:
        task = replace(task.without(task.find_isolated()), options=options)
    if options.light != "constant":
        light = _light_of(task.clip, part, options)
        task = replace(task, clip=task.clip._replace(light=light.light), found_light=light)
    return replace(task, reading_seconds=time.perf_counter() - began)


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
