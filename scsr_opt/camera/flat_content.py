"""Remarks on a flat file whose bits do not look like spikes of the size that it is read with.

A flat file says nothing of itself, so bytes of any kind open at any size. What gives them away: pixels that fire
without regard to when they last did (another kind of file, or frames of another length), frames of which each holds two
(twice the height), and rows that do not agree with each other while those of another width do.
"""

import dataclasses

from scsr_opt.camera.flat import likely_layouts, show_size
from scsr_opt.camera.plausibility import CHANGING_ABOVE, better_width
from scsr_opt.camera.sampling import pace, rates_of
from scsr_opt.camera.sources import FlatLayout, FlatSource

_MULTIPLES = (2, 3, 4)
"""Times the height that frames may really have, where they were taken for a part of one."""
_WARNED_FROM = 2000.0
"""Coincidences that chance must make for a file to be called none of spikes: a standard deviation of 0.02."""
_SHORTEST_SIDE = 8
"""Pixels of the shorter side of a size that is proposed."""
_COMPARED_PIXELS = 1 << 17
"""Pixels in the middle of a frame whose rows are compared: all of 250x400."""


def remark(source: FlatSource) -> str | None:
    """Sentence on bits that do not look like spikes of this size, with one that does; None if nothing is amiss."""
    _, height, width = source.shape
    found = pace(source)
    better = _better_frames(source) if found.irregular else None
    if better or (found.irregular and found.ratio < CHANGING_ABOVE and found.expected > _WARNED_FROM):
        why = "a pixel fires without regard to when it last did, which no spike camera does"
    elif _holds_two(source):
        why, better = "each frame holds two, one above the other", (width, height // 2)
    else:
        why, better = "its rows do not agree with each other", _better_rows(source)
        if better is None:
            return None
    advice = f"size {show_size(better)} looks right" if better else "check the size, and whether it is a recording"
    return f"{source.path.name} does not look like spikes of {show_size((width, height))}: {why}; {advice}."


def _holds_two(source: FlatSource) -> bool:
    """Test of a pixel and the one half a frame below it: they fire in turns, as one and the same pixel does."""
    frames, height, width = source.shape
    if height % 2 or source.layout.frame_bits(height) != height * source.layout.row_bits:
        return False
    packed = dataclasses.replace(source.layout, aligned=False)
    return pace(dataclasses.replace(source, shape=(2 * frames, height // 2, width), layout=packed)).regular


def _better_rows(source: FlatSource) -> tuple[int, int] | None:
    """(width, height) of as many pixels, with rows that agree."""
    pixels = source.shape[1] * source.shape[2]
    rates = rates_of(source)
    middle = rates[max(0, len(rates) - _COMPARED_PIXELS) // 2 :][:_COMPARED_PIXELS]
    sides = range(_SHORTEST_SIDE, pixels // _SHORTEST_SIDE + 1)
    better = better_width(middle, source.shape[2], [side for side in sides if pixels % side == 0])
    return (better, pixels // better) if better else None


def _better_frames(source: FlatSource) -> tuple[int, int] | None:
    """(width, height) of frames in which pixels fire as they should, of rows that agree if there are some."""
    _, height, width = source.shape
    length = source.path.stat().st_size
    taller: list[tuple[tuple[int, int], FlatLayout]] = [
        ((width, height * times), source.layout) for times in _MULTIPLES
    ]
    for size, layout in taller + likely_layouts(source.path, (width, height)):
        frames = layout.frames(length, size[1])
        other = dataclasses.replace(source, shape=(frames, size[1], size[0]), layout=layout)
        if frames and pace(other).regular:
            return _better_rows(other) or size
    return None
