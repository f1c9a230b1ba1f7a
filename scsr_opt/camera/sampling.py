"""A bounded part of a flat file, for statistics: opening a recording of gigabytes takes no longer than a small one."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Int

from scsr_opt.camera.plausibility import PIECES_FRAMES
from scsr_opt.camera.sources import FlatSource

_PLACES = 1 << 14
"""Places of the frame whose bits are taken: evidence enough in the dark, milliseconds of work."""
_MOMENTS = 8
"""Moments of a file at which bits are taken, evenly over it: it may be dark or saturated at one of them."""
_GROUP_BYTES = 64
"""Bytes beside each other that are taken from a frame, of which there are many: 512 pixels, a row or two."""
_RATE_BITS = 1 << 23
"""Bits that are added up to the spikes of each pixel: 64 frames of 250x400, 8 of 1000x1000."""
_RATE_FRAMES = (8, 64)
"""Frames that are added up: enough to tell rows by, and few enough for what moves to stay where it is."""


def trains_of(source: FlatSource) -> Iterator[Bool[np.ndarray, "n m"]]:
    """Bits at some places of 32 frames one after another (more of small ones), at some moments of a file."""
    frames = source.shape[0]
    several = max(1, _PLACES // source.layout.frame_bits(source.shape[1]))
    count = min(frames, max(PIECES_FRAMES) * several)
    for start in np.unique(np.linspace(0, frames - count, min(_MOMENTS, frames // count)).astype(int)):
        yield _some_bits(source, int(start), count)


def rates_of(source: FlatSource) -> Int[np.ndarray, "n"]:
    """Spikes of each pixel, row after row, in some frames in the middle of the file."""
    frames, height, width = source.shape
    least, most = _RATE_FRAMES
    count = min(frames, max(least, min(most, _RATE_BITS // source.layout.frame_bits(height))))
    start = (frames - count) // 2
    rates = np.zeros(height * width, np.int64)
    # In the order of the file: rows of a wrong size that are turned upside down are in none.
    stored = dataclasses.replace(source, flipped=False)
    for frame in range(start, start + count):
        rates += stored.read(frame, frame + 1).reshape(-1)
    return rates


def _some_bits(source: FlatSource, start: int, count: int) -> Bool[np.ndarray, "n m"]:
    bits = source.layout.frame_bits(source.shape[1])
    if bits <= _PLACES or not source.layout.aligned:
        return source.bits(start, start + count)[:, :: max(1, bits // _PLACES)].view(bool)
    groups = np.linspace(0, bits // 8 - _GROUP_BYTES, _PLACES // 8 // _GROUP_BYTES).astype(int)
    places = (groups[:, None] + np.arange(_GROUP_BYTES)).reshape(-1)
    packed = source.packed(start, start + count).reshape(count, bits // 8)
    return np.unpackbits(packed[:, places], axis=1, bitorder="little").view(bool)
