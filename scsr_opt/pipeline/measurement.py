"""From spikes and their motion to measurements that have a place on the picture."""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import gaussian_filter

from scsr_opt._kernels.device import on_device
from scsr_opt.calibration.gain import blind_gain, gain_is_known, share_of_unknown_gain, with_gain
from scsr_opt.calibration.settings import GainSettings
from scsr_opt.camera.samples import RUN_FRAMES, Samples
from scsr_opt.camera.sampling_rules import Intervals, SamplingRule
from scsr_opt.motion.trajectory import SPACING, Changes, Motion, Trajectory, trajectory_of
from scsr_opt.operators.losses import Loss, robust_factors
from scsr_opt.operators.sampling import PlacedSamples, place
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.settings import SamplingSettings
from scsr_opt.pipeline.visibility import cut_to_seen

# Numbers of positions that an exposure may have, most motion first (`SamplingSettings.positions_motion_px`).
_POSITIONS = (5, 3, 2, 1)
# What moves at a round velocity moves by just one of those distances within a round number of frames: as much is taken
# off them, sensor pixels, so that rounding, which is another of a mirrored recording, does not decide.
_TIE = 1e-3


class Measurements(NamedTuple):
    """Samples and where they were taken.

    **Fields:**
    - `samples`: (n,), as measured, weighted by their share of the recording; intervals that can be used in part only,
      cut to it (`scsr_opt.pipeline.visibility`).
    - `light`: (n,), their weights before anything was cut.
    - `padded`: (m,), `samples`, padded, each value over its pixel's gain. `placed`: (m,), where those were taken.
    - `still_for`: (h, w), frames over which what a pixel sees hardly moves; `merged_for`: those over which its
      intervals were merged, which may be fewer.
    - `path`: where in the key frame lies what the pixels see.
    """

    samples: Samples
    light: Float[np.ndarray, " n"]
    padded: Samples
    placed: PlacedSamples
    still_for: Int[np.ndarray, "h w"]
    merged_for: Int[np.ndarray, "h w"]
    path: Trajectory

    def with_gain(self, gain: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], noise: float) -> "Measurements":
        """The samples as measured over these gains, at the same places; pixels whose gain is not known count less.

        `noise`: standard deviation of a pixel's mean without fixed pattern, intensity.
        """
        value = with_gain(self.samples, gain).value
        padded = eqx.tree_at(lambda s: s.value, self.padded, np.pad(value, (0, self.padded.row.size - value.size)))
        share = share_of_unknown_gain(self.samples, gain, known, noise)[padded.row, padded.column]
        placed = eqx.tree_at(
            lambda p: (p.value, p.weight),
            self.placed,
            (on_device(np.asarray(padded.value)), self.placed.weight * share),
        )
        return self._replace(padded=padded, placed=placed)

    def without(self, pixels: Bool[np.ndarray, "h w"]) -> "Measurements":
        """These measurements without those of some pixels, (h, w)."""
        padded = self.padded
        used = on_device((~pixels[padded.row, padded.column]).astype(np.float32))
        placed = eqx.tree_at(lambda placed: placed.weight, self.placed, self.placed.weight * used)
        return self._replace(placed=placed)

    def let_go(self) -> None:
        """Gives back the memory of the places, two thirds of that of these measurements, whoever else holds them: they,
        and measurements made of them, cannot be read any more. For measurements that others take the place of."""
        for field in jax.tree.leaves(self.placed.taps):
            field.delete()

    def used_frames(self, key: int) -> Float[np.ndarray, "h w"]:
        """How far in time each pixel's samples were used, frames before and after the `key` frame of the clip: twice
        their mean distance from it by weight, which is T where all from −T to T count alike. 0 where none was used."""
        samples, (height, width) = self.samples, self.still_for.shape
        weight = np.asarray(self.placed.weight)[: samples.row.size]
        start, stop = samples.start - np.float32(key), samples.stop - np.float32(key)
        # ∫|t|dt = t·|t|/2.
        distance = (stop * np.abs(stop) - start * np.abs(start)) / (2 * np.maximum(stop - start, np.float32(1e-3)))
        pixel, size = samples.row * np.int32(width) + samples.column, height * width
        total, seen = np.bincount(pixel, weight * distance, size), np.bincount(pixel, weight, size)
        return (2 * total / np.where(seen > 0, seen, 1)).reshape(height, width).astype(np.float32)

    def gain(
        self,
        clip: Clip,
        motion: Motion,
        blurred: Float[Array, "H W"],
        *,
        robust: Loss | None = None,
        pixels: Bool[np.ndarray, "h w"] | None = None,
        at_rest: Float[np.ndarray, "h w"] | None = None,
        settings: GainSettings = GainSettings(),
    ) -> Float[np.ndarray, "h w"]:
        """Gains of the pixels, (h, w), as a picture predicts what they should have measured (`blind_gain`).

        **Arguments:**
        - `blurred`: U = B X, the blurred picture of these samples.
        - `robust`: the loss that the picture was fitted by: what counted little for the picture counts little here.
        - `pixels`: (h, w), true for the pixels whose gains are wanted; all if None.
        - `at_rest`: (h, w), gains where the scene does not move far enough to tell; 1 if None.
        """
        samples, placed = self.samples, self.placed
        used = placed.weight if robust is None else placed.weight * robust_factors(robust, placed, blurred)
        # Of all samples, as one program serves any pixels.
        predicted, weight = (np.asarray(v)[: samples.row.size] for v in (placed.read(blurred), used))
        if pixels is not None:
            chosen = np.flatnonzero(pixels[samples.row, samples.column])
            samples, predicted, weight = jax.tree.map(lambda values: values[chosen], (samples, predicted, weight))
        moved = motion.moved(len(clip.spikes))
        gains = blind_gain(
            samples, predicted, moved=moved, white_rate=clip.white_rate, weight=weight, settings=settings
        )
        return gains if at_rest is None else np.where(gain_is_known(moved, settings), gains, at_rest)


def measure(
    clip: Clip,
    motion: Motion | Trajectory,
    *,
    scale: int,
    sampling: SamplingRule,
    gain: Float[np.ndarray, "h w"] | None = None,
    merged_intervals: bool = True,
    longest: int | None = None,
    on_sensor: bool = False,
    least_padded: int = 0,
    settings: SamplingSettings = SamplingSettings(),
) -> Measurements:
    """The measurements of a recording, placed along a motion.

    **Arguments:**
    - `motion`: of the key frame, or already followed through the clip (`trajectory_of`).
    - `scale`: s, high-resolution pixels to a sensor pixel.
    - `sampling`: how samples are made; what one pixel sees is taken as the same as long as it moves by less than
      `settings.merged_motion_px`.
    - `gain`: of each pixel; 1 if not given.
    - `merged_intervals`: whether intervals are merged where nothing moves, up to `longest` frames if given, and where a
      pixel is saturated (`Shortcuts`); by squares the picture is the same, but for long intervals that are cut
      (`scsr_opt.pipeline.visibility`), which merged ones are not. Windows are not merged.
    - `on_sensor`: whether samples of a scene in which nothing moves at all are placed on the sensor's grid alone
      (`PlacedSamples`).
    - `least_padded`: number of samples that they are padded to, at least.
    - `settings`: how far what a pixel sees may move while its intervals are merged, and how many positions it gets.
    """
    frames, height, width = clip.spikes.shape
    followed = isinstance(motion, Trajectory)
    path = motion if followed else trajectory_of(motion, key=clip.key, start=0, stop=frames)
    # By all that a pixel sees: what stands still in the key frame may be hidden at other times by what passes.
    speeds, unsteady = path.speeds, path.unsteady
    fastest = speeds.most
    still_for = merged_for = np.ones((height, width), np.int32)
    run = 1
    if merged_intervals:
        with np.errstate(divide="ignore", over="ignore"):
            still = settings.merged_motion_px / (scale * fastest)
            steady = settings.merged_weight_change / unsteady.most
        still_for = np.clip(np.nan_to_num(np.minimum(still, steady)), 1, frames).astype(np.int32)
    if merged_intervals and isinstance(sampling, Intervals):
        most = frames if longest is None else min(longest, frames)
        still = np.mean(still_for >= settings.merged_least_frames)
        worthwhile = longest is not None or still >= settings.merged_least_share
        merged_for = np.minimum(still_for, most) if worthwhile else merged_for
        run = _runs(path, settings.run_motion_px, settings.steady_weight_change)
    samples = sampling(
        clip.spikes, white_rate=clip.white_rate, still_for=merged_for, run=run, bad_pixels=clip.bad_pixels
    )  # fmt: skip
    light = samples.weight
    if isinstance(sampling, Intervals) and sampling.ends > 0:
        samples = cut_to_seen(
            samples, path, frames=frames, white_rate=clip.white_rate, ends=sampling.ends, settings=settings
        )
    if clip.light is not None:
        samples = clip.light.corrected(samples, width)
    samples = eqx.tree_at(lambda s: s.weight, samples, samples.weight / np.float32(frames))
    if clip.dark is not None:
        samples = eqx.tree_at(lambda s: s.value, samples, samples.value - clip.dark[samples.row, samples.column])
    if isinstance(sampling, Intervals) and sampling.noise is not None:
        weight = sampling.noise.weights(samples, _mean_light(clip, settings.light_smoothing_px))
        samples = eqx.tree_at(lambda s: s.weight, samples, weight)
    order, positions = _longest_first(samples, speeds, unsteady, settings, each=merged_intervals)
    samples, light = jax.tree.map(lambda values: values[order], (samples, light / np.float32(frames)))
    measured = samples.value
    padded = (samples if gain is None else with_gain(samples, gain)).padded(least_padded)
    # The same arrays again, which take half a gigabyte for a sensor of 1000×1000 pixels.
    samples = jax.tree.map(lambda values: values[: measured.size], padded)
    if gain is not None:
        samples = eqx.tree_at(lambda s: s.value, samples, measured)
    placed = place(
        jax.tree.map(on_device, padded),
        path,
        scale=scale,
        shape=(scale * height, scale * width),
        positions=on_device(np.pad(positions, (0, padded.row.size - positions.size))),
        finest=_POSITIONS[0] if positions.max(initial=1) > 1 else 1,
        on_sensor=on_sensor and path.position.shape[0] == 1,
    )
    return Measurements(samples, light, padded, placed, still_for, merged_for, path)


def _runs(path: Trajectory, motion_px: float, weight_change: float) -> Int[np.ndarray, "blocks h w"]:
    """Over how many frames intervals of one frame are merged, for every `RUN_FRAMES` frames (`spike_intervals`)."""
    if path.position.shape[0] == 1:
        return np.full(path.visible.shape, RUN_FRAMES, np.int8)
    assert RUN_FRAMES == SPACING  # each run lies between two moments
    position, usable = np.asarray(path.position), path.usable
    found = np.empty((len(usable) - 1, *usable.shape[1:]), np.int8)
    motion, change = np.float32(motion_px * SPACING), np.float32(weight_change * SPACING)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for k in range(len(found)):
            down, right = position[k + 1] - position[k]
            run = np.minimum(motion / np.sqrt(down**2 + right**2), change / np.abs(usable[k + 1] - usable[k]))
            found[k] = np.clip(np.nan_to_num(run, nan=1), 1, RUN_FRAMES)
    return found


def _mean_light(clip: Clip, smoothing_px: float) -> Float[np.ndarray, "h w"]:
    """Mean intensity over the recording and over neighbouring pixels."""
    rate = clip.spikes.mean(0, dtype=np.float32) / np.float32(clip.white_rate)
    good = np.ones_like(rate) if clip.bad_pixels is None else (~clip.bad_pixels).astype(np.float32)
    return gaussian_filter(rate, smoothing_px) / np.maximum(gaussian_filter(good, smoothing_px), 1e-3)


def _longest_first(
    samples: Samples,
    speeds: Changes,
    unsteady: Changes,
    settings: SamplingSettings = SamplingSettings(),
    *,
    each: bool,
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Indices of the samples, those with most positions first, and the number of positions of each, (n,) both.

    `each`: each sample gets the positions that its own motion needs; otherwise all get the most that any needs. A
    second one is needed where visibility changes, too.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        speed = speeds.during(samples.row, samples.column, samples.start, samples.stop)
        moved = speed * (samples.stop - samples.start)
    level = np.zeros(moved.shape, np.int8)
    for reach in settings.positions_motion_px:
        level += moved >= reach - _TIE
    single = np.flatnonzero(level == 0)
    where = [of[single] for of in (samples.row, samples.column, samples.start, samples.stop)]
    level[single] = unsteady.during(*where) * (where[3] - where[2]) >= settings.steady_weight_change
    few = settings.two_positions_least_share * samples.weight.sum()
    if level.max(initial=0) == 1 and samples.weight[level == 1].sum() <= few:
        level = np.zeros_like(level)
    if not each:
        level = np.full_like(level, level.max(initial=0))
    # In this order what has no second position can be passed over in pieces.
    members = [np.flatnonzero(level == which) for which in reversed(range(len(_POSITIONS)))]
    order = np.concatenate(members)
    positions = np.repeat(np.array(_POSITIONS, np.int32), [each.size for each in members])
    return order, positions
