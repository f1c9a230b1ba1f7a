"""Mean intensity of every pixel over stretches of time, from the exact times of its spikes."""

import numpy as np
from jaxtyping import Float, Shaped


def interval_rates(
    spikes: Shaped[np.ndarray, "T h w"], edges: Float[np.ndarray, " edges"], *, white_rate: float | int = 0.6
) -> Float[np.ndarray, "n h w"]:
    """Mean intensity between neighbouring `edges` (frames; frame t sits at time t), 1 = white.

    The light that a pixel has gathered is known at its spikes (a multiple of θ) and taken to grow evenly between them;
    a stretch is the difference of two readings. Its error is a fraction of one frame's light where a spike count over
    the same stretch is wrong by up to θ. Before a pixel's first and after its last spike the nearest interval is
    continued, at a rate that is no higher than the missing spike allows; a pixel with fewer than two spikes shows its
    mean rate.
    """
    frames = spikes.shape[0]
    fired = np.asarray(spikes).astype(bool, copy=False)
    time = np.arange(frames, dtype=np.int16 if frames < 2**15 - 2 else np.int32)[:, None, None]
    before = np.maximum.accumulate(np.where(fired, time, time.dtype.type(-1)), axis=0)  # latest spike ≤ t
    after = np.minimum.accumulate(np.where(fired, time, time.dtype.type(frames))[::-1], axis=0)[::-1]  # next spike ≥ t
    count = np.cumsum(fired, axis=0, dtype=time.dtype)
    total, first, last = count[-1].astype(np.float32), after[0].astype(np.float32), before[-1].astype(np.float32)

    second = np.take_along_axis(after, np.minimum(after[0] + 1, frames - 1)[None].astype(np.intp), axis=0)[0]
    last_but_one = np.take_along_axis(before, np.maximum(before[-1] - 1, 0)[None].astype(np.intp), axis=0)[0]
    known = total >= 2
    with np.errstate(divide="ignore", invalid="ignore"):
        early = np.minimum(1 / (second - first), 1 / np.maximum(first, 1))
        late = np.minimum(1 / (last - last_but_one), 1 / np.maximum(frames - 1 - last, 1))
    early, late, mean = np.where(known, early, 0), np.where(known, late, 0), total / np.float32(frames)

    gathered = np.empty((len(edges), *spikes.shape[1:]), np.float32)
    for number, edge in enumerate(edges):
        t = int(np.clip(np.floor(edge), 0, frames - 2)) if frames > 1 else 0
        a, b = before[t], after[min(t + 1, frames - 1)]
        inside = (a >= 0) & (b < frames) & (b > a)
        share = np.where(inside, (edge - a) / np.maximum(b - a, 1), 0)
        reading = np.where(inside, count[t] + share, 0)
        reading = np.where(known & (a < 0), 1 - (first - edge) * early, reading)
        reading = np.where(known & (a >= 0) & ~inside, total + (edge - last) * late, reading)
        gathered[number] = np.where(known, reading, mean * (edge + 0.5))
    lengths = np.diff(np.asarray(edges, np.float32))[:, None, None]
    return np.diff(gathered, axis=0) / lengths / np.float32(white_rate)
