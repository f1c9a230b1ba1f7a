"""Remarks on a flat file whose bits do not look like spikes of the size that it is read with.

A flat file says nothing of itself, so bytes of any kind open at any size. What gives them away: records of a fixed
length (another kind of file), pixels that fire without regard to when they last did (another kind of file, or frames of
another length), frames of which each holds two (twice the height), rows that do not agree with each other while
those of another width do, and bytes that hold their pixels in the other order.
"""

import dataclasses
import math

from scsr_opt.camera.flat import likely_layouts, show_size
from scsr_opt.camera.plausibility import (
    better_width,
    bits_reversed,
    narrower_width,
    regularities,
    regularity,
    unsaturated,
)
from scsr_opt.camera.records import record_length
from scsr_opt.camera.sampling import rates_of, trains_of
from scsr_opt.camera.settings import CONTENT
from scsr_opt.camera.sources import FlatLayout, FlatSource


def remark(source: FlatSource) -> str | None:
    """Sentence on bits that do not look like spikes of this size, with one that does; None if nothing is amiss."""
    frames, height, width = source.shape
    layout = source.layout
    record = record_length(source.packed(0, frames), layout.row_bits, layout.frame_bits(height))
    if record is not None:
        why, better = f"it consists of records of {record} bytes, some of whose bits are always set", None
    elif regularity(trains_of(source)).irregular and _fires_at_random(source):
        why, better = (
            "a pixel fires without regard to when it last did, which no spike camera does",
            _better_frames(source),
        )
    elif _holds_two(source):
        why, better = "each frame holds two, one above the other", (width, height // 2)
    elif (better := _better_rows(source)) is not None:
        why = "its rows do not agree with each other"
    elif _bits_reversed(source):
        return (
            f"{source.path.name} does not look like spikes of {show_size((width, height))} as cameras write them: the "
            f"first of eight pixels seems to be in the highest bit, as numpy.packbits has it; pack it with "
            f"bitorder='little'."
        )
    else:
        return None
    advice = f"size {show_size(better)} looks right" if better else "check the size, and whether it is a recording"
    return f"{source.path.name} does not look like spikes of {show_size((width, height))}: {why}; {advice}."


def _fires_at_random(source: FlatSource) -> bool:
    """Test of pixels that are not saturated: they fire without regard to when they last did."""
    found = regularity(unsaturated(trains) for trains in trains_of(source))
    return (
        found.irregular
        and found.ratio < CONTENT.random_below_ratio
        and found.expected > CONTENT.warning_least_coincidences
    )


def _holds_two(source: FlatSource) -> bool:
    """Test of a pixel and the one half a frame below it: they fire in turns, as one and the same pixel does."""
    frames, height, width = source.shape
    if height % 2 or source.layout.frame_bits(height) != height * source.layout.row_bits:
        return False
    packed = dataclasses.replace(source.layout, aligned=False)
    halves = dataclasses.replace(source, shape=(2 * frames, height // 2, width), layout=packed)
    # Two pixels that see opposite parts of a pattern that moves take turns as well, but only in the long run.
    certain = [found for found in regularities(trains_of(halves)) if found.certain]
    return bool(certain) and max(certain).ratio < CONTENT.one_pixel_below_ratio


def _bits_reversed(source: FlatSource) -> bool:
    """Test of bytes that hold eight pixels of a row in the other order."""
    return source.layout.segments == ((0, source.layout.row_bits),) and (
        source.layout.row_bits % 8 == 0 and bits_reversed(rates_of(source))
    )


def _better_rows(source: FlatSource) -> tuple[int, int] | None:
    """(width, height) of as many pixels, with rows that agree, or of which one row here holds several."""
    _, height, width = source.shape
    pixels = height * width
    rates = rates_of(source)
    start = max(0, pixels - CONTENT.compared_px) // 2 // width * width
    middle = rates[start:][: CONTENT.compared_px]
    sides = range(math.isqrt(pixels // CONTENT.longest_side_ratio), math.isqrt(pixels * CONTENT.longest_side_ratio) + 1)
    others = [side for side in sides if side and pixels % side == 0]
    better = better_width(middle, width, others) or narrower_width(middle, width, others)
    return (better, pixels // better) if better else None


def _better_frames(source: FlatSource) -> tuple[int, int] | None:
    """(width, height) of frames in which pixels fire as they should, of rows that agree if there are some."""
    _, height, width = source.shape
    length = source.path.stat().st_size
    taller: list[tuple[tuple[int, int], FlatLayout]] = [
        ((width, height * times), source.layout) for times in CONTENT.tried_heights
    ]
    for size, layout in taller + likely_layouts(source.path, (width, height)):
        frames = layout.frames(length, size[1])
        other = dataclasses.replace(source, shape=(frames, size[1], size[0]), layout=layout)
        if frames and regularity(trains_of(other)).regular:
            return _better_rows(other) or size
    return None
