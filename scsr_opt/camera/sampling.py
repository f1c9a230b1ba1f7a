"""A bounded part of a flat file, for statistics: opening a recording of gigabytes takes no longer than a small one."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Int

from scsr_opt._settings import Settings
from scsr_opt.camera.settings import CONTENT
from scsr_opt.camera.sources import FlatSource


@dataclasses.dataclass(frozen=True, kw_only=True)
class FileSamplingSettings(Settings):
    """Amount of a flat file that is read for statistics."""

    places: int = 1 << 14
    """Places of the frame whose bits are taken: evidence enough in the dark, milliseconds of work."""
    moments: int = 8
    """Moments of a file at which bits are taken, evenly over it: it may be dark or saturated at one of them."""
    group_bytes: int = 64
    """Bytes beside each other that are taken from a large frame: 512 pixels, a row or two."""
    rate_bits: int = 1 << 23
    """Bits that are added up to the spikes of each pixel: 64 frames of 250x400, 8 of 1000x1000."""
    rate_frames: tuple[int, int] = (8, 64)
    """Frames that are added up, at least and at most: enough to tell rows by, and few enough for what moves to stay
    where it is."""


def trains_of(
    source: FlatSource, settings: FileSamplingSettings = FileSamplingSettings()
) -> Iterator[Bool[np.ndarray, "n m"]]:
    """Bits at some places of 32 frames one after another (more of small ones), at some moments of a file."""
    frames = source.shape[0]
    several = max(1, settings.places // source.layout.frame_bits(source.shape[1]))
    count = min(frames, max(CONTENT.piece_frames) * several)
    for start in np.unique(np.linspace(0, frames - count, min(settings.moments, frames // count)).astype(int)):
        yield _some_bits(source, int(start), count, settings)


def rates_of(source: FlatSource, settings: FileSamplingSettings = FileSamplingSettings()) -> Int[np.ndarray, "n"]:
    """Spikes of each pixel, row after row, in some frames in the middle of the file."""
    frames, height, width = source.shape
    least, most = settings.rate_frames
    count = min(frames, max(least, min(most, settings.rate_bits // source.layout.frame_bits(height))))
    start = (frames - count) // 2
    rates = np.zeros(height * width, np.int64)
    # In the order of the file: rows of a wrong size that are turned upside down are in none.
    stored = dataclasses.replace(source, flipped=False)
    for frame in range(start, start + count):
        rates += stored.read(frame, frame + 1).reshape(-1)
    return rates


def _some_bits(source: FlatSource, start: int, count: int, settings: FileSamplingSettings) -> Bool[np.ndarray, "n m"]:
    bits, places, size = source.layout.frame_bits(source.shape[1]), settings.places, settings.group_bytes
    if bits <= places or not source.layout.aligned:
        return source.bits(start, start + count)[:, :: max(1, bits // places)].view(bool)
    groups = np.linspace(0, bits // 8 - size, places // 8 // size).astype(int)
    chosen = (groups[:, None] + np.arange(size)).reshape(-1)
    packed = source.packed(start, start + count).reshape(count, bits // 8)
    return np.unpackbits(packed[:, chosen], axis=1, bitorder="little").view(bool)
