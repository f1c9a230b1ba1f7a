"""From spikes and their motion to measurements that have a place on the picture."""

from typing import NamedTuple, SupportsFloat, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from scsr_opt.camera.gain import blind_gain, gain_is_known, share_of_unknown_gain, with_gain
from scsr_opt.camera.measuring import Intervals, Measuring
from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.recording import Recording, checked_white_rate
from scsr_opt.camera.samples import RUN, Samples, padded_length
from scsr_opt.cutting import cut_to_seen
from scsr_opt.inputs import bad_pixels_of, whole
from scsr_opt.motion.estimate import filled
from scsr_opt.motion.trajectory import SPACING, Changes, Motion, Trajectory, trajectory_of
from scsr_opt.operators.robust import Loss, robust_factors
from scsr_opt.operators.sampling import PlacedSamples, place

# How far a surface may move while intervals are merged, in high-resolution pixels: below the aperture's own blur.
_MERGED_MOTION = 0.25
# It is worth it where so large a share of the pixels is still for so many frames: samples that are not merged serve to
# validate the strength, too.
_MERGED_SHARE, _MERGED_LONG = 0.25, 16
# How far the weight of what a pixel sees may change while intervals are merged as it rests.
_MERGED_CHANGE = 0.25
# And during a run of intervals of one frame that is merged, or an exposure with a single position: both have one weight
# while something comes into view or is hidden, and a run that leaves the picture is lost as a whole.
_STEADY = 0.125
# Positions along an exposure, and the motion, sensor pixels, from which on it gets so many: what is read is the picture
# through an aperture of one, and of that they miss no more than 0.0013 (docs/data-term.md, "Exposures"). λ hears it
# where they miss 0.003: 0.09 dB on a still that pans.
_POSITIONS, _REACHES = (5, 3, 2, 1), (0.7, 0.5, 0.1)
# How far what a pixel sees may move during a run of intervals of one frame that is merged: five positions then lie 3/8
# of a sensor pixel apart.
_FARTHEST = 1.875
# Where two positions are asked for by no more than this share of the weight, and more by none, all are taken in the
# middle of their exposure: a few long intervals of dark pixels would put all samples through rounds of corrections.
# What they show is then blurred by up to half a sensor pixel of motion; at this share it is no object: a hundred of a
# million pixels.
_FEW_LONG = 1e-4
# Standard deviation, sensor pixels, over which the light of pixels is averaged to tell their noise.
_NEIGHBOURS = 1.5


class Stream(NamedTuple):
    """The part of a recording that is used.

    **Fields:**
    - `spikes`: (T, h, w), 0 and 1; all 0 in bad pixels.
    - `key`: index of the key frame in `spikes`.
    - `white_rate`: spikes per frame of a pixel at intensity 1.
    - `bad_pixels`: (h, w), true where nothing is known; None if nothing is known of any.
    """

    spikes: Shaped[np.ndarray, "T h w"]
    key: int
    white_rate: float
    bad_pixels: Bool[np.ndarray, "h w"] | None

    def part(self, rows: slice, columns: slice) -> "Stream":
        """The same frames of a part of the sensor."""
        bad = None if self.bad_pixels is None else self.bad_pixels[rows, columns]
        return Stream(self.spikes[:, rows, columns], self.key, self.white_rate, bad)


def stream_around(
    recording: Recording,
    *,
    key: SupportsIndex | None,
    frames: SupportsIndex,
    white_rate: SupportsFloat | None,
    bad_pixels: ArrayLike | None = None,
) -> tuple[int, Stream]:
    """The key frame, as a frame of the recording, and the frames around it.

    **Arguments:** as of `scsr_opt.reconstruct`; None for the middle frame, for the recording's white rate, and for no
    bad pixels but its own.

    **Raises:** `InputError` if one of them cannot be used.
    """
    key = recording.frames // 2 if key is None else whole(key, "key", 0, recording.frames - 1)
    start, stop = recording.around(key, whole(frames, "frames", 1))
    rate = recording.white_rate if white_rate is None else checked_white_rate(white_rate)
    bad = bad_pixels_of(recording, bad_pixels)
    spikes = recording.window(start, stop)
    if bad is not None:
        spikes[:, bad] = 0  # whatever they fired, nothing after this line knows
    return key, Stream(spikes, key - start, rate, bad)


def first_picture(stream: Stream, shape: tuple[int, int], *, sharp: bool = False) -> Float[Array, "H W"]:
    """X^(0): the rate over 21 frames around the key frame, enlarged linearly, as the networks were trained with, or by
    Lanczos' interpolation if it is to be `sharp`: what lies between sensor pixels is found slowly, and such a start has
    some of it (docs/measurements.md)."""
    frames, bad = len(stream.spikes), stream.bad_pixels
    if frames > 1:
        edges = np.clip(np.array([stream.key - 10.0, stream.key + 10.0]), 0, frames - 1)
        rate = interval_rates(stream.spikes, edges, white_rate=stream.white_rate)
    else:
        rate = stream.spikes / np.float32(stream.white_rate)
    picture = jnp.asarray(rate, jnp.float32)
    if bad is not None and bad.any():
        picture = filled(picture, ~bad)
    return jax.image.resize(picture[0], shape, "lanczos3" if sharp else "linear")


class Measurements(NamedTuple):
    """Samples and where they were taken.

    **Fields:**
    - `samples`: (n,), as measured, weighted by their share of the recording; intervals that can be used in part only,
      cut to it (`scsr_opt.cutting`).
    - `light`: (n,), their weights before anything was cut.
    - `padded`: (m,), the same, padded, each value over its pixel's gain. `placed`: (m,), where those were taken.
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
        padded = with_gain(self.samples, gain).padded()
        share = share_of_unknown_gain(self.samples, gain, known, noise)[padded.row, padded.column]
        placed = eqx.tree_at(
            lambda p: (p.value, p.weight), self.placed, (jnp.asarray(padded.value), self.placed.weight * share)
        )
        return self._replace(padded=padded, placed=placed)

    def gain(
        self,
        stream: Stream,
        motion: Motion,
        blurred: Float[Array, "H W"],
        *,
        robust: Loss | None = None,
        of: Bool[np.ndarray, "h w"] | None = None,
        at_rest: Float[np.ndarray, "h w"] | None = None,
    ) -> Float[np.ndarray, "h w"]:
        """The gains that the blurred picture U = B X of these samples speaks for (`blind_gain`), `of` some pixels only
        if given. Where the scene does not move by a pixel, those `at_rest`, or 1. `robust`: the loss that the picture
        was fitted by; what counted little for the picture says little of gains."""
        samples, placed = self.samples, self.placed
        if of is not None:
            chosen = np.flatnonzero(of.reshape(-1)[samples.row * of.shape[1] + samples.column])
            samples = jax.tree.map(lambda values: values[chosen], samples)
            placed = placed.only(jnp.asarray(np.pad(chosen, (0, padded_length(samples.row.size) - chosen.size))))
        used = placed.weight if robust is None else placed.weight * robust_factors(robust, placed, blurred)
        predicted, weight = (np.asarray(v)[: samples.row.size] for v in (placed.read(blurred), used))
        moved = motion.moved(len(stream.spikes))
        gains = blind_gain(samples, predicted, moved=moved, white_rate=stream.white_rate, weight=weight)
        return gains if at_rest is None else np.where(gain_is_known(moved), gains, at_rest)


def measured(
    stream: Stream,
    motion: Motion | Trajectory,
    *,
    scale: int,
    measuring: Measuring,
    gain: Float[np.ndarray, "h w"] | None = None,
    merge: bool = True,
    longest: int | None = None,
    on_sensor: bool = False,
) -> Measurements:
    """The measurements of a recording, placed along a motion.

    **Arguments:**
    - `motion`: of the key frame, or already followed through the stream (`trajectory_of`).
    - `scale`: s, high-resolution pixels to a sensor pixel.
    - `measuring`: how samples are made; what one pixel sees is taken as the same as long as it moves by less than ¼
      high-resolution pixel.
    - `gain`: of each pixel; 1 if not given.
    - `merge`: whether intervals are merged where nothing moves, up to `longest` frames if given, and where a pixel is
      saturated; by squares the picture is the same, but for long intervals that are cut (`scsr_opt.cutting`), which
      merged ones are not. Windows are not merged.
    - `on_sensor`: whether samples of a scene in which nothing moves at all are placed on the sensor's grid alone
      (`PlacedSamples`).
    """
    frames, height, width = stream.spikes.shape
    followed = isinstance(motion, Trajectory)
    path = motion if followed else trajectory_of(motion, key=stream.key, start=0, stop=frames)
    # By all that a pixel sees: what stands still in the key frame may be hidden at other times by what passes.
    speeds, unsteady = path.speeds, path.unsteady
    fastest = speeds.most
    still_for = merged_for = np.ones((height, width), np.int32)
    run = 1
    if merge:
        with np.errstate(divide="ignore", over="ignore"):
            still = _MERGED_MOTION / (scale * fastest)
            steady = _MERGED_CHANGE / unsteady.most
        still_for = np.clip(np.nan_to_num(np.minimum(still, steady)), 1, frames).astype(np.int32)
    if merge and isinstance(measuring, Intervals):
        most = frames if longest is None else min(longest, frames)
        worthwhile = longest is not None or np.mean(still_for >= _MERGED_LONG) >= _MERGED_SHARE
        merged_for = np.minimum(still_for, most) if worthwhile else merged_for
        run = np.asarray(_runs(path))
    samples = measuring(
        stream.spikes, white_rate=stream.white_rate, still_for=merged_for, run=run, bad_pixels=stream.bad_pixels
    )  # fmt: skip
    light = samples.weight
    if isinstance(measuring, Intervals) and measuring.ends > 0:
        samples = cut_to_seen(samples, path, frames=frames, white_rate=stream.white_rate, ends=measuring.ends)
    samples = eqx.tree_at(lambda s: s.weight, samples, samples.weight / np.float32(frames))
    if isinstance(measuring, Intervals) and measuring.noise is not None:
        weight = measuring.noise.weights(samples, _mean_light(stream))
        samples = eqx.tree_at(lambda s: s.weight, samples, weight)
    order, positions = _longest_first(samples, speeds, unsteady, each=merge)
    samples, light = jax.tree.map(lambda values: values[order], (samples, light / np.float32(frames)))
    padded = (samples if gain is None else with_gain(samples, gain)).padded()
    placed = place(
        jax.tree.map(jnp.asarray, padded),
        path,
        scale=scale,
        shape=(scale * height, scale * width),
        positions=jnp.asarray(np.pad(positions, (0, padded.row.size - positions.size))),
        finest=_POSITIONS[0] if positions.max(initial=1) > 1 else 1,
        on_sensor=on_sensor and path.position.shape[0] == 1,
    )
    return Measurements(samples, light, padded, placed, still_for, merged_for, path)


@eqx.filter_jit
def _runs(path: Trajectory) -> Int[Array, "blocks h w"]:
    """Over how many frames intervals of one frame are merged, for every `RUN` frames (`spike_intervals`)."""
    if path.position.shape[0] == 1:
        return jnp.full(path.visible.shape, RUN, jnp.int8)
    assert RUN == SPACING  # each run lies between two moments
    moved, changed = (jnp.diff(of, axis=0) / SPACING for of in (path.position, path.usable))
    down, right = moved[:, 0], moved[:, 1]
    run = jnp.minimum(_FARTHEST / jnp.sqrt(down**2 + right**2), _STEADY / jnp.abs(changed))
    return jnp.clip(jnp.nan_to_num(run, nan=1), 1, RUN).astype(jnp.int8)


def _mean_light(stream: Stream) -> Float[np.ndarray, "h w"]:
    """Mean intensity over the recording and over neighbouring pixels."""
    rate = stream.spikes.mean(0, dtype=np.float32) / np.float32(stream.white_rate)
    good = np.ones_like(rate) if stream.bad_pixels is None else (~stream.bad_pixels).astype(np.float32)
    return gaussian_filter(rate, _NEIGHBOURS) / np.maximum(gaussian_filter(good, _NEIGHBOURS), 1e-3)


def _longest_first(
    samples: Samples, speeds: Changes, unsteady: Changes, *, each: bool
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """The samples' numbers, and how many positions each gets along its exposure, those with most first: `each` as many
    as it needs, or all as many as any of them does. A second one is needed where visibility changes, too."""
    with np.errstate(over="ignore", invalid="ignore"):
        speed = speeds.during(samples.row, samples.column, samples.start, samples.stop)
        moved = speed * (samples.stop - samples.start)
    level = np.zeros(moved.shape, np.int8)
    for reach in _REACHES:
        level += moved >= reach
    single = np.flatnonzero(level == 0)
    where = [of[single] for of in (samples.row, samples.column, samples.start, samples.stop)]
    level[single] = unsteady.during(*where) * (where[3] - where[2]) >= _STEADY
    if level.max(initial=0) == 1 and samples.weight[level == 1].sum() <= _FEW_LONG * samples.weight.sum():
        level = np.zeros_like(level)
    if not each:
        level = np.full_like(level, level.max(initial=0))
    # In this order what has no second position can be passed over in pieces.
    members = [np.flatnonzero(level == which) for which in reversed(range(len(_POSITIONS)))]
    order = np.concatenate(members)
    positions = np.repeat(np.array(_POSITIONS, np.int32), [each.size for each in members])
    return order, positions
