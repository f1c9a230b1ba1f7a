"""From spikes and their motion to measurements that have a place on the picture."""

from typing import NamedTuple, SupportsFloat, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped
from numpy.typing import ArrayLike

from scsr_opt.camera.gain import blind_gain, share_of_unknown_gain, with_gain
from scsr_opt.camera.measuring import Intervals, Measuring
from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.samples import Samples
from scsr_opt.inputs import bad_pixels_of, number, whole
from scsr_opt.motion.estimate import filled
from scsr_opt.motion.trajectory import SPACING, Motion, Trajectory, trajectory_of
from scsr_opt.operators.sampling import PlacedSamples, place

# How far a surface may move while intervals are merged, in high-resolution pixels: below the aperture's own blur.
_MERGED_MOTION = 0.25
# It is worth it where so large a share of the pixels is still for so many frames: samples that are not merged serve to
# validate the strength, too.
_MERGED_SHARE, _MERGED_LONG = 0.25, 16
# How far the weight of what a pixel sees may change while intervals are merged.
_MERGED_CHANGE = 0.25
# The share of what its light is worth at most at which a pixel counts as seen.
_SEEN = 0.5
# Positions along an exposure, and how far apart they may be, in sensor pixels: what is read is the picture through an
# aperture of one.
_POSITIONS, _SPACING = (5, 3, 1), 0.375
# Where three positions are asked for by no more than this share of the weight, and five by none, all are taken in the
# middle of their exposure: a few long intervals of dark pixels would put all samples through rounds of corrections.
# What they show is then blurred by up to a sensor pixel of motion; at this share it is no object: a hundred pixels of a
# million.
_FEW_LONG = 1e-4


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
    - `path`: where in the key frame lies what the pixels see.
    """

    samples: Samples
    padded: Samples
    placed: PlacedSamples
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
        self, stream: Stream, motion: Motion, blurred: Float[Array, "H W"], *, every: int = 1
    ) -> Float[np.ndarray, "h w"]:
        """The gains that the blurred picture U = B X of these samples speaks for (`blind_gain`), of one row and column
        in `every`; 1 elsewhere."""
        samples, n = self.samples, self.samples.row.size
        predicted, weight = (np.asarray(v)[:n] for v in (self.placed.read(blurred), self.placed.weight))
        if every > 1:
            chosen = np.flatnonzero((samples.row % every == 0) & (samples.column % every == 0))
            samples, predicted, weight = jax.tree.map(lambda v: v[chosen], (samples, predicted, weight))
        return blind_gain(
            samples,
            predicted,
            moved=motion.speed * np.float32(len(stream.spikes)),
            white_rate=stream.white_rate,
            weight=weight,
        )


def measured(
    stream: Stream,
    motion: Motion | Trajectory,
    *,
    scale: int,
    measuring: Measuring,
    gain: Float[np.ndarray, "h w"] | None = None,
    merge: bool = True,
) -> Measurements:
    """The measurements of a recording, placed along a motion.

    **Arguments:**
    - `motion`: of the key frame, or already followed through the stream (`trajectory_of`).
    - `scale`: s, high-resolution pixels to a sensor pixel.
    - `measuring`: how samples are made; what one pixel sees is taken as the same as long as it moves by less than ¼
      high-resolution pixel.
    - `gain`: of each pixel; 1 if not given.
    - `merge`: whether intervals are merged where nothing moves; the picture is the same. Windows are not.
    """
    frames, height, width = stream.spikes.shape
    followed = isinstance(motion, Trajectory)
    path = motion if followed else trajectory_of(motion, key=stream.key, start=0, stop=frames)
    # By all that a pixel sees: what stands still in the key frame may be hidden at other times by what passes.
    fastest = path.fastest
    still_for = np.ones((height, width), np.int32)
    if merge and isinstance(measuring, Intervals):
        with np.errstate(divide="ignore", over="ignore"):
            still = _MERGED_MOTION / (scale * fastest)
            # A merged interval has one weight.
            steady = _MERGED_CHANGE / path.unsteady
        possible = np.clip(np.nan_to_num(np.minimum(still, steady)), 1, frames).astype(np.int32)
        still_for = possible if np.mean(possible >= _MERGED_LONG) >= _MERGED_SHARE else still_for
    samples = measuring(stream.spikes, white_rate=stream.white_rate, still_for=still_for, bad_pixels=stream.bad_pixels)
    if isinstance(measuring, Intervals) and measuring.ends > 0:
        samples = _cut_to_seen(samples, path, frames, white_rate=stream.white_rate, ends=measuring.ends)
    samples = eqx.tree_at(lambda s: s.weight, samples, samples.weight / np.float32(frames))
    samples, positions = _longest_first(samples, fastest)
    padded = (samples if gain is None else with_gain(samples, gain)).padded()
    placed = place(
        jax.tree.map(jnp.asarray, padded),
        path,
        scale=scale,
        shape=(scale * height, scale * width),
        positions=jnp.asarray(np.pad(positions, (0, padded.row.size - positions.size))),
        finest=_POSITIONS[0] if positions.max(initial=1) > 1 else 1,
    )
    return Measurements(samples, padded, placed, still_for, path)


def _cut_to_seen(samples: Samples, path: Trajectory, frames: int, *, white_rate: float, ends: float) -> Samples:
    """The samples, those cut that can be used for a part of their exposure only, where that part says more.

    What a pixel sees may come into view, be hidden or leave the picture during an exposure. The stretch of time in
    which it can be used is a recording of its own, and an interval that reaches beyond it one of its ends
    (`scsr_opt.camera.samples`): ½θ, or nothing if no spike begins or ends it. Dark surfaces, whose intervals are long,
    would be known by their brightest moments only without them.
    """
    usable, partly = (np.asarray(v) for v in _usable(path))
    long = (samples.stop - samples.start >= 2 * SPACING) & partly[samples.row, samples.column]
    # What was merged is not pulled apart: pixels whose light is used in part only are not merged as far.
    chosen = np.flatnonzero(long & (samples.value * (samples.stop - samples.start) < 1.5 / white_rate))
    if chosen.size == 0:
        return samples
    first, last = np.float32(path.first), len(usable) - 1
    from_first = (np.stack([samples.start[chosen], samples.stop[chosen]]) - first) / SPACING
    begin, end = np.clip([np.floor(from_first[0]), np.ceil(from_first[1])], 0, last).astype(np.int32)
    order = np.argsort(begin - end, kind="stable")  # those with most moments first
    chosen, begin, end = chosen[order], begin[order], end[order]
    pixel = samples.row[chosen] * usable.shape[2] + samples.column[chosen]
    usable = usable.reshape(last + 1, -1)
    enough = _SEEN * usable.max(0)[pixel]
    least = np.full(chosen.size, np.inf, np.float32)
    run, longest, until = (np.zeros(chosen.size, np.int32) for _ in range(3))
    for k in range(int((end - begin)[0]) + 1):
        some = slice(np.searchsorted(begin - end, -k, side="right"))  # those that have so many
        moment = begin[some] + k
        seen = usable[moment, pixel[some]]
        least[some] = np.minimum(least[some], seen)
        run[some] = (run[some] + 1) * (seen >= enough[some])
        until[some] = np.where(run[some] > longest[some], moment, until[some])
        longest[some] = np.maximum(longest[some], run[some])
    start, stop, weight = samples.start[chosen], samples.stop[chosen], samples.weight[chosen]
    start_seen = np.maximum(start, first + SPACING * (until - longest + 1).astype(np.float32))
    stop_seen = np.minimum(stop, first + SPACING * until.astype(np.float32))
    left = stop_seen - start_seen
    better = (longest > 0) & (left >= SPACING) & (enough * left * np.float32(ends) > least * weight)
    spike = ((start_seen == start) & (start >= 0)) ^ ((stop_seen == stop) & (stop <= frames - 1))
    fields = (
        start_seen,
        stop_seen,
        spike * np.float32(0.5 / white_rate) / np.maximum(left, np.float32(SPACING)),
        left * np.float32(ends),
    )
    changed = [np.array(v) for v in (samples.start, samples.stop, samples.value, samples.weight)]
    for values, cut in zip(changed, fields, strict=True):
        values[chosen[better]] = cut[better]
    return eqx.tree_at(lambda s: (s.start, s.stop, s.value, s.weight), samples, tuple(changed))


@jax.jit
def _usable(path: Trajectory) -> tuple[Float[Array, "n h w"], Bool[Array, "h w"]]:
    """How far what each pixel sees at the trajectory's moments can be used, which it cannot be out of the picture; and
    of which pixels much more at one time than at another."""
    height, width = path.position.shape[2:]
    down, right = path.position[:, 0], path.position[:, 1]
    # A tolerance, so that rounding does not take the border row of a scene at rest out of the picture.
    inside = (down >= -1e-4) & (right >= -1e-4) & (down <= height - 1 + 1e-4) & (right <= width - 1 + 1e-4)
    usable = jnp.where(inside, path.visible, 0)
    return usable, usable.min(0) < _SEEN * usable.max(0)


def _longest_first(samples: Samples, speed: Float[np.ndarray, "h w"]) -> tuple[Samples, Int[np.ndarray, " n"]]:
    """The samples and how many positions each gets along its exposure, those with most first; `speed` in sensor pixels
    per frame."""
    with np.errstate(over="ignore", invalid="ignore"):
        moved = speed[samples.row, samples.column] * (samples.stop - samples.start)
    level = np.zeros(moved.shape, np.int8)
    for k in _POSITIONS[1:]:
        level += k * _SPACING <= moved
    if level.max(initial=0) == 1 and samples.weight[level == 1].sum() <= _FEW_LONG * samples.weight.sum():
        level = np.zeros_like(level)
    # In this order what has no second position can be passed over in pieces.
    members = [np.flatnonzero(level == which) for which in reversed(range(len(_POSITIONS)))]
    order = np.concatenate(members)
    positions = np.repeat(np.array(_POSITIONS, np.int32), [each.size for each in members])
    return jax.tree.map(lambda values: values[order], samples), positions
