"""Mean intensity of every pixel over stretches of time, from the exact times of its spikes."""

from itertools import accumulate
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from scsr_opt._arrays import as_array
from scsr_opt.camera.light import Light
from scsr_opt.camera.spike_times import SpikeTimes, second_spikes


def interval_rates(
    spikes: Shaped[np.ndarray, "T h w"],
    edges: Float[np.ndarray, " edges"],
    *,
    white_rate: float | int = 0.6,
    light: Light | None = None,
) -> Float[np.ndarray, "n h w"]:
    """Mean intensity between neighbouring `edges` (frames; frame t sits at time t), 1 = white.

    The light that a pixel has gathered is known at its spikes (a multiple of θ) and taken to grow evenly between them;
    a stretch is the difference of two readings. Its error is a fraction of one frame's light where a spike count over
    the same stretch is wrong by up to θ. Before a pixel's first and after its last spike the nearest interval is
    continued, at a rate that is no higher than the missing spike allows; a pixel with fewer than two spikes shows its
    mean rate. With the `light` of each moment, intensities are those at the mean light, and time is counted in it.
    """
    spikes = as_array(spikes, "The array of spikes")
    frames, *sides = spikes.shape
    fired = spikes.reshape(frames, -1)
    at = [int(np.clip(np.floor(edge), 0, frames - 2)) if frames > 1 else 0 for edge in edges]
    # Up to the first edge, between each two, and after the last one.
    ends = sorted({t + 1 for t in at} | {frames})
    parts = [SpikeTimes.of(fired, begin, end) for begin, end in zip([0, *ends[:-1]], ends, strict=True)]
    lasts = list(accumulate((part.last for part in parts), np.maximum))
    counts = list(accumulate(part.count for part in parts))
    firsts = list(accumulate((part.first for part in reversed(parts)), np.minimum))[::-1]
    following = [*firsts[1:], np.full_like(firsts[0], frames)]
    times = {end: found for end, *found in zip(ends, lasts, counts, following, strict=True)}
    first, last, count = firsts[0], lasts[-1], counts[-1]
    unknown = np.flatnonzero(count < 2)
    everyone = np.arange(first.size)

    def clock(time: Any, pixels: Int[np.ndarray, "*m"] = everyone) -> np.ndarray:
        """These times on the clocks of these pixels: frames, or light."""
        if light is None:
            return np.asarray(time, np.float32)
        return light.gathered(np.broadcast_to(time, pixels.shape), pixels)

    opened, closed = clock(-0.5, unknown), clock(frames - 0.5, unknown)
    mean = count[unknown] / (closed - opened)
    # Before a first and after a last spike: no faster than the missing one allows.
    opens, closes = (first > min(at)) & (count >= 2), (last <= max(at)) & (count >= 2)
    opening, closing = np.flatnonzero(opens), np.flatnonzero(closes)
    begin, begin_again = first[opening], second_spikes(fired, opens)[opening]
    end, end_before = last[closing], frames - 1 - second_spikes(fired[::-1], closes)[closing]
    # The least time between two spikes; a frame may have little light.
    least = np.float32(1 if light is None else 1e-3)
    begun, ended = clock(begin, opening), clock(end, closing)
    early = 1 / np.maximum(clock(begin_again, opening) - begun, np.maximum(begun - clock(0, opening), least))
    late = 1 / np.maximum(ended - clock(end_before, closing), np.maximum(clock(frames - 1, closing) - ended, least))

    gathered = np.empty((len(edges), first.size), np.float32)
    lasted = []
    for reading, t, edge in zip(gathered, at, np.asarray(edges, np.float32), strict=True):
        before, counted, after = times[t + 1]
        now, since = clock(edge), clock(before)
        lasted.append(now)
        # Numbers of one kind each time: mixed ones take five times as long.
        np.subtract(now, since, out=reading)
        reading /= np.maximum(clock(after) - since, least)
        reading += counted.astype(np.float32)
        yet, over = np.flatnonzero(begin > t), np.flatnonzero(end <= t)
        reading[opening[yet]] = 1 - (begun[yet] - clock(edge, opening[yet])) * early[yet]
        reading[closing[over]] = count[closing[over]] + (clock(edge, closing[over]) - ended[over]) * late[over]
        reading[unknown] = mean * (clock(edge, unknown) - opened)
    rates = np.diff(gathered, axis=0)
    rates /= np.diff(np.stack(lasted).reshape(len(edges), -1), axis=0)
    rates /= np.float32(white_rate)
    return rates.reshape(-1, *sides)
