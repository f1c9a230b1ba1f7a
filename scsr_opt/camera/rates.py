"""Mean intensity of every pixel over stretches of time, from the exact times of its spikes."""

import numpy as np
from jaxtyping import Bool, Float, Shaped

from scsr_opt.camera.threads import in_threads

Readings = Float[np.ndarray, "h w"]

# Large recordings are worked through in bands of rows side by side: two take 0.7 of the time of one on two cores, more
# than two gain nothing.
_BANDS, _LARGE = 2, 1_000_000


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
    rows = spikes.shape[1]
    bands = np.array_split(np.arange(rows), min(_BANDS, rows) if spikes.size >= _LARGE else 1)
    rates = in_threads(lambda band: _rates(spikes[:, band[0] : band[-1] + 1], edges), bands)
    return np.concatenate(rates, axis=1) / np.float32(white_rate)


def _rates(spikes: Shaped[np.ndarray, "T h w"], edges: Float[np.ndarray, " edges"]) -> Float[np.ndarray, "n h w"]:
    """The same in spikes per frame."""
    frames = spikes.shape[0]
    fired = np.asarray(spikes).astype(bool, copy=False)
    at = [int(np.clip(np.floor(edge), 0, frames - 2)) if frames > 1 else 0 for edge in edges]
    following = [min(t + 1, frames - 1) for t in at]
    forward, last, last_but_one = _latest(fired, set(at))
    backward, *ends = _latest(fired[::-1], {frames - 1 - t for t in following})
    first, second = (frames - 1 - end for end in ends)
    total = np.add.reduce(fired.view(np.int8), axis=0, dtype=np.int32).astype(np.float32)
    known = total >= 2
    with np.errstate(divide="ignore", invalid="ignore"):
        early = np.minimum(1 / (second - first), 1 / np.maximum(first, 1))
        late = np.minimum(1 / (last - last_but_one), 1 / np.maximum(frames - 1 - last, 1))
    early, late, mean = np.where(known, early, 0), np.where(known, late, 0), total / np.float32(frames)

    gathered = np.empty((len(edges), *spikes.shape[1:]), np.float32)
    for number, edge in enumerate(edges):
        a, count = forward[at[number]]
        b = frames - 1 - backward[frames - 1 - following[number]][0]
        inside = (a >= 0) & (b < frames) & (b > a)
        share = np.where(inside, (edge - a) / np.maximum(b - a, 1), 0)
        reading = np.where(inside, count + share, 0)
        reading = np.where(known & (a < 0), 1 - (first - edge) * early, reading)
        reading = np.where(known & (a >= 0) & ~inside, total + (edge - last) * late, reading)
        gathered[number] = np.where(known, reading, mean * (edge + 0.5))
    lengths = np.diff(np.asarray(edges, np.float32))[:, None, None]
    return np.diff(gathered, axis=0) / lengths


def _latest(
    fired: Bool[np.ndarray, "T h w"], wanted: set[int]
) -> tuple[dict[int, tuple[Readings, Readings]], Readings, Readings]:
    """For each frame `wanted`, every pixel's latest spike up to it and the number of its spikes; the last spike of all
    and the last but one. −1 where there is none."""
    kind = np.int16 if len(fired) < 2**15 else np.int32
    latest = np.zeros(fired.shape[1:], kind)  # counted from 1 here
    previous, count, kept = latest.copy(), latest.copy(), {}
    for t, now in enumerate(fired.view(np.int8)):
        # By masks of bits: an eighth of the time of masked copies.
        mask = np.negative(now, dtype=kind)
        previous ^= (previous ^ latest) & mask
        latest ^= (latest ^ kind(t + 1)) & mask
        count += now
        if t in wanted:
            kept[t] = latest.astype(np.float32) - 1, count.astype(np.float32)
    return kept, latest.astype(np.float32) - 1, previous.astype(np.float32) - 1
