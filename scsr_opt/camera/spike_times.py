"""First and last spike of each pixel of a recording, and their number: intervals and rates are made from them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Shaped, UInt8

from scsr_opt._arrays import as_array

# Frames that are looked at before what was found in bytes goes to wider numbers: as far as a byte counts. Bytes take a
# fifth of the time of anything wider.
BYTE_FRAMES = 255


class SpikeTimes(NamedTuple):
    """The `first` and the `last` spike of every pixel among some frames, and the `count` of its spikes there.

    Frames are counted from the start of the recording; where a pixel did not fire, the first is the recording's length
    and the last is −1.
    """

    first: Int[np.ndarray, "*pixels"]
    last: Int[np.ndarray, "*pixels"]
    count: Int[np.ndarray, "*pixels"]

    @classmethod
    def of(cls, spikes: Shaped[np.ndarray, "T *pixels"], begin: int = 0, end: int | None = None) -> "SpikeTimes":
        """Spike times of frames `begin` to `end` (exclusive) of a recording of 0 and 1, or of all."""
        frames, end = len(spikes), len(spikes) if end is None else end
        kind = np.int16 if frames < 2**15 else np.int32
        # Both from the far end inwards, so that the larger number is the one that counts, and 0 is none. Choosing by
        # masks takes forty times as long as a maximum.
        since_end, last, count = (np.zeros(spikes.shape[1:], kind) for _ in range(3))
        for start in range(begin, end, BYTE_FRAMES):
            stop = min(start + BYTE_FRAMES, end)
            until_last, from_first, times = _within(as_bytes(spikes[start:stop]))
            some = times > 0
            np.maximum(last, until_last + kind(start) * some, out=last)
            np.maximum(since_end, from_first + kind(frames - stop) * some, out=since_end)
            count += times
        return cls(np.subtract(kind(frames), since_end, out=since_end), np.subtract(last, 1, out=last), count)

    def then(self, following: "SpikeTimes") -> "SpikeTimes":
        """Spike times of these frames and of the `following` ones of the recording together."""
        first, last = np.minimum(self.first, following.first), np.maximum(self.last, following.last)
        return SpikeTimes(first, last, self.count + following.count)


def as_bytes(spikes: Shaped[np.ndarray, "T *pixels"]) -> UInt8[np.ndarray, "T *pixels"]:
    """A recording of 0 and 1 of any type as bytes."""
    fired = as_array(spikes, "The array of spikes")
    return fired if fired.dtype == np.uint8 else fired.astype(bool, copy=False).view(np.uint8)


def second_spikes(
    spikes: Shaped[np.ndarray, "T pixels"], wanted: Bool[np.ndarray, " pixels"]
) -> Int[np.ndarray, " pixels"]:
    """The frame of the second spike of the pixels that are `wanted`, which fired at least twice; 0 of the others."""
    # Those are done before it begins.
    seen = np.where(wanted, np.uint8(0), np.uint8(2))
    hit, found = (np.zeros(spikes.shape[1:], np.uint8) for _ in range(2))
    frame = np.zeros(spikes.shape[1:], np.int32)
    for start in range(0, len(spikes), BYTE_FRAMES):
        for t, now in enumerate(as_bytes(spikes[start : start + BYTE_FRAMES])):
            if t % 8 == 0 and seen.min(initial=2) == 2:
                break
            np.equal(seen, 1, out=hit.view(bool))
            hit &= now
            hit *= np.uint8(t + 1)
            found += hit
            seen += now
            np.minimum(seen, 2, out=seen)
        frame += found + np.int32(start - 1) * (found > 0)
        found[:] = 0
    return frame


def _within(fired: UInt8[np.ndarray, "t *pixels"]) -> tuple[UInt8[np.ndarray, "*pixels"], ...]:
    """Frames up to the last spike, frames from the first spike on (both 0 where there is none), and spikes, of at most
    255 frames."""
    frames = len(fired)
    last, first, count, product = (np.zeros(fired.shape[1:], np.uint8) for _ in range(4))
    for t, now in enumerate(fired):
        np.multiply(now, np.uint8(t + 1), out=product)
        np.maximum(last, product, out=last)
        np.multiply(now, np.uint8(frames - t), out=product)
        np.maximum(first, product, out=first)
        count += now
    return last, first, count
