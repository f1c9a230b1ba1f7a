"""From spikes and their motion to measurements that have a place on the picture."""

from typing import NamedTuple, SupportsFloat, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped
from numpy.typing import ArrayLike

from scsr_opt.camera.gain import blind_gain, share_of_unknown_gain, with_gain
from scsr_opt.camera.measuring import Measuring
from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.samples import Samples
from scsr_opt.inputs import bad_pixels_of, number, whole
from scsr_opt.motion.estimate import filled
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators.sampling import PlacedSamples, place

# How far a surface may move while intervals are merged, in high-resolution pixels: below the aperture's own blur.
_MERGED_MOTION = 0.25
# How far the weight of what a pixel sees may change while intervals are merged.
_MERGED_CHANGE = 0.25
# Length of an exposure, in high-resolution pixels, from which on it is sampled at several positions.
_EXPOSURE_MOTION = 0.75


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
    rate = recording.white_rate if white_rate is None else white_rate
    rate = number(rate, "white_rate", lambda v: v > 0, "above 0, in spikes per frame")
    bad = bad_pixels_of(recording, bad_pixels)
    stream = Stream(recording.window(start, stop), key - start, rate, bad)
    if bad is not None:
        stream.spikes[:, bad] = 0  # whatever they fired, nothing after this line knows
    return key, stream


def first_picture(stream: Stream, shape: tuple[int, int]) -> Float[Array, "H W"]:
    """X^(0): the rate over 21 frames around the key frame, enlarged."""
    frames, bad = len(stream.spikes), stream.bad_pixels
    if frames > 1:
        edges = np.clip(np.array([stream.key - 10.0, stream.key + 10.0]), 0, frames - 1)
        rate = interval_rates(stream.spikes, edges, white_rate=stream.white_rate)
    else:
        rate = stream.spikes / np.float32(stream.white_rate)
    picture = jnp.asarray(rate, jnp.float32)
    if bad is not None and bad.any():
        picture = filled(picture, ~bad)
    return jax.image.resize(picture[0], shape, "linear")


class Measurements(NamedTuple):
    """Samples and where they were taken.

    **Fields:**
    - `samples`: (n,), as measured, weighted by their share of the recording.
    - `padded`: (m,), the same, padded, each value over its pixel's gain. `placed`: (m,), where those were taken.
    - `merged_for`: (h, w), frames over which the intervals of a pixel were merged.
    """

    samples: Samples
    padded: Samples
    placed: PlacedSamples
    merged_for: Int[np.ndarray, "h w"]

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

    def gain(self, stream: Stream, motion: Motion, blurred: Float[Array, "H W"]) -> Float[np.ndarray, "h w"]:
        """The gains that the blurred picture U = B X of these samples speaks for (`blind_gain`)."""
        n = self.samples.row.size
        return blind_gain(
            self.samples,
            np.asarray(self.placed.read(blurred))[:n],
            moved=motion.speed * np.float32(len(stream.spikes)),
            white_rate=stream.white_rate,
            weight=np.asarray(self.placed.weight)[:n],
        )


def measured(
    stream: Stream,
    motion: Motion,
    *,
    scale: int,
    measuring: Measuring,
    gain: Float[np.ndarray, "h w"] | None = None,
    merge: bool = True,
) -> Measurements:
    """The measurements of a recording, placed along a motion.

    **Arguments:**
    - `scale`: s, high-resolution pixels to a sensor pixel.
    - `measuring`: how samples are made; what one pixel sees is taken as the same as long as it moves by less than ¼
      high-resolution pixel.
    - `gain`: of each pixel; 1 if not given.
    - `merge`: whether intervals are merged where nothing moves; the picture is the same.
    """
    frames, height, width = stream.spikes.shape
    path = trajectory_of(motion, key=stream.key, start=0, stop=frames)
    still_for = np.ones((height, width), np.int32)
    if merge:
        with np.errstate(divide="ignore", over="ignore"):
            # By all that a pixel sees: what stands still in the key frame may be hidden at other times by what passes.
            still = _MERGED_MOTION / (scale * path.fastest)
            # A merged interval has one weight.
            steady = _MERGED_CHANGE / path.unsteady
        still_for = np.clip(np.nan_to_num(np.minimum(still, steady)), 1, frames).astype(np.int32)
    samples = measuring(stream.spikes, white_rate=stream.white_rate, still_for=still_for, bad_pixels=stream.bad_pixels)
    samples = eqx.tree_at(lambda s: s.weight, samples, samples.weight / np.float32(frames))
    padded = (samples if gain is None else with_gain(samples, gain)).padded()
    placed = place(
        jax.tree.map(jnp.asarray, padded),
        path,
        scale=scale,
        positions=_positions(samples, motion, scale),
        shape=(scale * height, scale * width),
    )
    return Measurements(samples, padded, placed, still_for)


def _positions(samples: Samples, motion: Motion, scale: int) -> int:
    """How finely exposures are sampled: 1, 3 or 5 positions, by how far the surface moves during a long one."""
    with np.errstate(over="ignore"):
        moved = scale * motion.speed[samples.row, samples.column] * (samples.stop - samples.start)
    long = float(np.quantile(np.minimum(moved, 1e6), 0.9)) if moved.size else 0.0  # no infinity to interpolate
    return 1 if long < _EXPOSURE_MOTION else 3 if long < 3 * _EXPOSURE_MOTION else 5
