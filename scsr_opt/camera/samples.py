"""From spikes to intensity measurements Y_i with their exposures (paper, Eq. 2 and 4).

**Spike intervals.** The sensor keeps the residual above its threshold θ, so between two spikes of a pixel, read out in
frames a < b, it has gathered exactly θ, or c·θ where c − 1 further spikes lie between them: the mean intensity over the
exposure was Y = c·θ / (b − a). Each end is known to within the frame it was read out in. The crossing lies, on average,
in the middle of that frame, so the light counted is ½I_a + I_{a+1} + … + I_{b−1} + ½I_b: the exposure is [a, b] on a
time axis on which frame t sits at t. (Taking the frames a+1 … b instead would show everything half a frame late.)

**Ends.** Before its first spike a pixel gathers what its charge then lacked of θ, after its last one what will be left
over: anything from 0 to θ, ½θ in the mean. Either end is a sample of ½θ over the time that it lasted; a pixel that
never fired is one of 0 over the whole recording. They are rough, θ/√12, and get `END_WEIGHT` of the weight of an
interval as long. Dark pixels, however, have little else, and without their ends those few that happened to fire twice
would decide for all. One factor for all ends keeps Σ ω (Y − I) at mean 0 for constant light I of every level
(docs/data-term.md), which no factor that depends on the sample's own duration or number of spikes does.
(`scsr_opt.pipeline.visibility` makes ends, too, where a pixel is seen for a part of the recording only.)

**Windows.** A fixed window of n frames that holds c spikes measures Y = c·θ / n, with an error of up to θ.

All are weighted by duration. Intervals of one pixel share their ends, so their errors cancel from one to the next:
weighted by duration they add up to the exact light between the first and the last spike.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from scsr_opt._arrays import as_array
from scsr_opt._threads import in_threads
from scsr_opt.camera.spike_times import SpikeTimes
from scsr_opt.errors import InputError, shown

END_WEIGHT = 0.1
"""Weight of the time before a pixel's first and after its last spike, beside that of as long an interval (measured)."""

RUN_FRAMES = 4
"""Frames, at most, of a run of intervals of one frame that is merged."""

# Number of samples from which on working through what only pads them costs more than compiling for another length.
_FINELY_PADDED_FROM = 1 << 20

# Pixels whose intervals are found at once: what that takes stays in the cache.
_BAND_PIXELS = 2048


class Samples(eqx.Module):
    """Intensity measurements, one entry a sample, in no particular order.

    **Fields** (all of shape (n,)):
    - `row`, `column`: the sensor pixel.
    - `start`, `stop`: the exposure, in frames; frame t sits at time t.
    - `value`: mean intensity over the exposure, 1 = white (Y_i).
    - `weight`: ω_i, in frames of exposure; 0 for entries that only pad the arrays.
    """

    row: Int[np.ndarray | Array, " n"]
    column: Int[np.ndarray | Array, " n"]
    start: Float[np.ndarray | Array, " n"]
    stop: Float[np.ndarray | Array, " n"]
    value: Float[np.ndarray | Array, " n"]
    weight: Float[np.ndarray | Array, " n"]

    @property
    def count(self) -> int:
        """The number of samples that take part (weight above 0)."""
        return int(np.count_nonzero(self.weight))

    def mean_light(self, shape: tuple[int, int]) -> Float[np.ndarray, "h w"]:
        """Weighted mean of each pixel's values, intensity, on a sensor of this shape; 0 where there is no sample."""
        pixel, size = self.row * shape[1] + self.column, shape[0] * shape[1]
        light, weight = (np.bincount(pixel, of, size) for of in (self.weight * self.value, self.weight))
        return (light / np.where(weight > 0, weight, 1)).reshape(shape)

    def padded(self, least: int = 0) -> "Samples":
        """These samples, padded with weight 0 to one of few lengths, at least `least`.

        Code that was compiled for one number of samples then serves for others.
        """
        extra = padded_length(max(self.row.size, least)) - self.row.size

        def pad(values: Shaped[np.ndarray | Array, " n"]) -> Shaped[np.ndarray, " m"]:
            return np.pad(values, (0, extra))

        return Samples(
            pad(self.row), pad(self.column), pad(self.start), pad(self.stop), pad(self.value), pad(self.weight)
        )


def padded_length(n: int) -> int:
    """The length that n samples are padded to: 2^e or 3·2^e, at least 1024, so that at most half of n is added; from a
    million on also 5·2^e or 7·2^e."""
    step = 1 << max(0, n.bit_length() - (2 if n < _FINELY_PADDED_FROM else 3))
    return max(n + -n % step, 1024)


def spike_intervals(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    white_rate: float = 0.6,
    shortest: int | Int[np.ndarray, "h w"] = 1,
    run: int | Int[np.ndarray, "*blocks h w"] = RUN_FRAMES,
    first_frame: int = 0,
    bad_pixels: Bool[np.ndarray, "h w"] | None = None,
    ends: float | int = END_WEIGHT,
) -> Samples:
    """Samples from the intervals between spikes, pixel by pixel, then those from the ends (see above).

    Neighbouring intervals of a pixel are merged until each merged one lasts about `shortest` frames: the first spike in
    each block of `shortest` frames is an end, whatever lies between is counted. Merging loses nothing where nothing
    moves during `shortest` frames, and leaves fewer samples to handle. So does merging intervals of one frame that
    follow one another, up to `run`: the pixel is saturated, and each measures the same.

    **Arguments:**
    - `spikes`: (T, h, w), 0 or 1.
    - `white_rate`: spikes per frame of a pixel at intensity 1; θ = 1 / white_rate.
    - `shortest`: frames, at least 1; one number or one per pixel. Pixels with T or more come after the others.
    - `run`: frames, at least 1, over which intervals of one frame are merged; 1 leaves each a sample of its own. One
      number, one per pixel, or (n, h, w), one per pixel for every `RUN_FRAMES`, the last of them for all that follow.
    - `first_frame`: time of `spikes[0]`, in frames.
    - `bad_pixels`: (h, w), true where a pixel must not be used.
    - `ends`: weight of the ends per frame, from 0 to 1; with 0 there are none, and no pixel that fired less than twice.

    **Returns:** `Samples`; empty if `ends` is 0 and no pixel fired twice, or all pixels are bad.

    **Raises:** `InputError` if `ends` is not from 0 to 1.
    """
    if not 0 <= ends <= 1:
        raise InputError(
            f"ends is {shown(ends)}, but it must be a number from 0 (left out) to 1 (as good as intervals)."
        )
    spikes = as_array(spikes, "The array of spikes")
    frames, height, width = spikes.shape
    good = np.ones(height * width, bool) if bad_pixels is None else ~as_array(bad_pixels, "bad_pixels").reshape(-1)
    fired = spikes.reshape(frames, -1)
    merged = np.broadcast_to(np.asarray(shortest), (height, width)).reshape(-1)
    runs = np.asarray(run)
    runs = np.broadcast_to(runs, (*runs.shape[:-2], height, width)).reshape(-1, height * width)
    # Of pixels that are still all the time, only the first and the last spike and their number count.
    still = merged >= frames
    others = np.flatnonzero(good & ~still).astype(np.int32)

    def made(parts: tuple[np.ndarray, ...], factor: float | int = 1) -> Samples:
        pixel, begin, end, counted = parts
        duration = (end - begin).astype(np.float32)
        return Samples(
            row=(pixel // width).astype(np.int32),
            column=(pixel % width).astype(np.int32),
            start=(begin + first_frame).astype(np.float32),
            stop=(end + first_frame).astype(np.float32),
            value=counted.astype(np.float32) / np.float32(white_rate) / duration,
            weight=duration * np.float32(factor),
        )

    bands = np.array_split(others, max(1, others.size // _BAND_PIXELS))
    parts = in_threads(lambda pixels: made(_between(fired, pixels, merged, runs)), bands)
    if ends > 0 or still.any():
        times = SpikeTimes.of(fired)
        parts.append(made(_throughout(times, np.flatnonzero(good & still))))
        if ends > 0:
            parts.append(made(_ends(times, frames, good), ends))
    return jax.tree.map(lambda *each: np.concatenate(each), *parts)


def mean_light(
    times: SpikeTimes, begin: int, end: int, *, white_rate: float | int, ends: float | int = END_WEIGHT
) -> Float[np.ndarray, "*pixels"]:
    """Mean intensity of pixels from frame `begin` to `end` (exclusive), of which these are the spike times: that of all
    samples of `spike_intervals` with `shortest=end - begin`, which are not made for it; 0 where there is none. `ends`,
    `white_rate` as there."""
    fired = times.count > 0
    between = np.where(fired, times.last - times.first, 0).astype(np.float32)
    at_ends = np.float32(ends) * (np.float32(end - begin) - between)
    light = np.where(fired, times.count - 1 + np.float32(ends), 0)
    duration = between + at_ends
    return (light / np.where(duration > 0, duration, 1) / np.float32(white_rate)).astype(np.float32)


def _between(
    fired: Shaped[np.ndarray, "T hw"],
    pixels: Int[np.ndarray, " pixels"],
    shortest: Int[np.ndarray, " hw"],
    runs: Int[np.ndarray, "blocks hw"],
) -> tuple[np.ndarray, ...]:
    """Pixel, start, stop and spikes counted of the intervals of some pixels, merged as by `spike_intervals`."""
    frames = len(fired)
    by_pixel = np.ascontiguousarray(fired[:, pixels].T).astype(bool, copy=False)
    order = np.flatnonzero(by_pixel).astype(np.int32)  # by pixel, then by time
    pixel = np.repeat(np.arange(pixels.size, dtype=np.int32), np.count_nonzero(by_pixel, axis=1))
    time = order - pixel * np.int32(frames)
    # Runs of spikes in frame after frame: the pixel is saturated, and all of them measure the same.
    follows = (order[1:] - order[:-1] == 1) & (pixel[1:] == pixel[:-1])
    within = np.flatnonzero(follows[1:] & follows[:-1]) + 1
    at = time[within]
    block = np.minimum(at // RUN_FRAMES, len(runs) - 1)
    left_out = within[at % runs[block, pixels[pixel[within]]] != 0]
    order = np.arange(order.size, dtype=np.int32)
    if left_out.size:
        order = np.delete(order, left_out)
        pixel, time = pixel.take(order), time.take(order)
    if np.any(shortest[pixels] > 1):
        block = time // shortest[pixels][pixel]
        first = np.ones(time.size, bool)
        first[1:] = pixel[1:] != pixel[:-1]
        is_end = first.copy()
        is_end[1:] |= block[1:] != block[:-1]
        is_end[:-1] |= first[1:]  # the last spike of a pixel ends its last interval, however short
        is_end[-1:] = True
        kept = np.flatnonzero(is_end)  # a mask takes several times as long as numbers
        pixel, time, order = pixel.take(kept), time.take(kept), order.take(kept)
    begin = np.flatnonzero(pixel[1:] == pixel[:-1])
    end = begin + 1
    return pixels[pixel[begin]], time[begin], time[end], order[end] - order[begin]


def _throughout(times: SpikeTimes, pixels: Int[np.ndarray, " pixels"]) -> tuple[np.ndarray, ...]:
    """From the first to the last spike of some pixels: pixel, start, stop and thresholds gathered."""
    some = pixels[times.count[pixels] >= 2]
    return some, times.first[some], times.last[some], times.count[some] - 1


def _ends(times: SpikeTimes, frames: int, good: Bool[np.ndarray, " pixels"]) -> tuple[np.ndarray, ...]:
    """Pixel, start, stop and thresholds gathered of all ends; frame t covers [t − ½, t + ½]."""
    lit, dark = np.flatnonzero(good & (times.count > 0)), np.flatnonzero(good & (times.count == 0))
    opening, closing = np.full(lit.size, -0.5), np.full(lit.size, frames - 0.5)
    return (
        np.concatenate([lit, lit, dark]),
        np.concatenate([opening, times.last[lit], np.full(dark.size, -0.5)]),
        np.concatenate([times.first[lit], closing, np.full(dark.size, frames - 0.5)]),
        np.concatenate([np.full(2 * lit.size, 0.5), np.zeros(dark.size)]),
    )


def windows(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    length: int,
    white_rate: float = 0.6,
    first_frame: int = 0,
    bad_pixels: Bool[np.ndarray, "h w"] | None = None,
) -> Samples:
    """Samples from counting spikes in consecutive windows of `length` frames (a last, shorter window is left out).

    **Arguments:** as `spike_intervals`; `length` in frames, from 1 to T.

    **Raises:** `InputError` if no whole window fits.
    """
    spikes = as_array(spikes, "The array of spikes")
    frames, height, width = spikes.shape
    if not 1 <= length <= frames:
        raise InputError(
            f"windows of {length} frames do not fit a recording of {frames}: use a length from 1 to {frames}."
        )
    number = frames // length
    counts = spikes[: number * length].reshape(number, length, height, width).sum(1, dtype=np.float32)
    begin = np.arange(number, dtype=np.float32) * length + first_frame - 0.5  # frame t covers [t − ½, t + ½]
    rows, columns = np.mgrid[0:height, 0:width].astype(np.int32)
    shape = (number, height, width)
    good = True if bad_pixels is None else ~as_array(bad_pixels, "bad_pixels")
    used = np.broadcast_to(good, shape).astype(np.float32)
    return Samples(
        row=np.broadcast_to(rows, shape).ravel(),
        column=np.broadcast_to(columns, shape).ravel(),
        start=np.broadcast_to(begin[:, None, None], shape).ravel(),
        stop=np.broadcast_to(begin[:, None, None] + length, shape).ravel(),
        value=counts.ravel() / np.float32(length * white_rate),
        weight=used.ravel() * np.float32(length),
    )
