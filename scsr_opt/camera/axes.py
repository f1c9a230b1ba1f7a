"""Axis of time of an array: (frames, rows, columns) and (rows, columns, frames) are both about.

Nothing is chosen on the quiet. What decides is, in this order: the size, where it was given; the content, where it is
clear (see `plausibility`); the size of a known camera; and the convention of the name, if the content speaks for it or
the other reading is not one of a sensor (`_of_a_sensor`). Where these do not tell, or contradict each other, the error
names both readings.
"""

import warnings
from typing import Any

from scsr_opt.camera.flat import CAMERA_SIZES, parse_size, show_size
from scsr_opt.camera.plausibility import Regularity, axis_regularity, contradiction
from scsr_opt.camera.settings import CONTENT
from scsr_opt.errors import InputError

FIRST, LAST = 0, 2


def time_axis(stored: Any, where: str, *, size: Any, convention: int | None, written: bool = False) -> int:
    """Axis of time of `stored`, FIRST or LAST.

    **Arguments:**
    - `stored`: array or dataset of three dimensions, 0 and 1; a block of it is read.
    - `where`: names it in errors.
    - `size`: (width, height) as `parse_size` reads it, or None.
    - `convention`: the axis that is time where nothing speaks against it; None for `arr_0`, which is time last by
      convention, and time first where `np.savez(path, spikes)` wrote it.
    - `written`: whether `write_recording` wrote it, so that the convention holds where the content does not tell.

    **Raises:** `InputError` if the size fits no reading, or it is not certain which one is right.
    """
    shape = tuple(stored.shape)
    fitting = [axis for axis in (FIRST, LAST) if size is None or _size(shape, axis) == parse_size(size)]
    if not fitting:
        usual = FIRST if convention is None else convention
        raise InputError(
            f"{where} has {shape[usual]} frames of {show_size(_size(shape, usual))}, not of the given size "
            f"{show_size(parse_size(size))}: leave the size out, or transpose the array to (frames, rows, columns)."
        )
    found = axis_regularity(stored)
    if len(fitting) == 1:
        if (other := contradiction(found, fitting[0])) is not None:
            warnings.warn(
                f"{where} is read as {_reading(shape, fitting[0])}, as the given size says, but its content looks as "
                f"if axis {other} of {shape} were time.",
                stacklevel=2,
            )
        return fitting[0]
    known = [axis for axis in (FIRST, LAST) if _size(shape, axis) in CAMERA_SIZES]
    sensor = known[0] if len(known) == 1 else None
    if convention is None:
        content = _by_content(found)
        if content is not None:
            return content
        if sensor == LAST:
            return LAST
    elif (other := contradiction(found, convention)) is None:
        if sensor == convention or found[convention].regular:
            return convention
        unlikely = not found[LAST].regular and not _of_a_sensor(shape, LAST)
        if sensor is None and (written or unlikely or _speaks_for_time_first(found)):
            return convention
    elif other == sensor:
        return other
    spoken = None if convention is None else contradiction(found, convention)
    raise InputError(_question(shape, where, spoken))


def _by_content(found: tuple[Regularity, ...]) -> int | None:
    regular = [axis for axis in (FIRST, LAST) if found[axis].regular]
    # With few frames, or in the dark, there is nothing to count along time, but along the other axis there is.
    possible = regular or [axis for axis in (FIRST, LAST) if not found[axis].irregular]
    return possible[0] if len(possible) == 1 and not found[1].regular else None


def _speaks_for_time_first(found: tuple[Regularity, ...]) -> bool:
    """Test of content that lets time last look less likely than time first."""
    first, last = found[FIRST], found[LAST]
    return last.irregular or (first.certain and not first.irregular and not last.regular)


def _of_a_sensor(shape: tuple[int, ...], axis: int) -> bool:
    """Test of a reading with as many frames, rows and columns as a recording has at least."""
    sides = _size(shape, axis)
    return min(shape) >= CONTENT.least_side and max(sides) <= CONTENT.longest_side_ratio * min(sides)


def _size(shape: tuple[int, ...], axis: int) -> tuple[int, int]:
    return (shape[2], shape[1]) if axis == FIRST else (shape[1], shape[0])


def _reading(shape: tuple[int, ...], axis: int) -> str:
    order = "(frames, rows, columns)" if axis == FIRST else "(rows, columns, frames)"
    return f"{shape[axis]} frames of {show_size(_size(shape, axis))} {order}"


def _question(shape: tuple[int, ...], where: str, spoken: int | None) -> str:
    first, last = (show_size(_size(shape, axis)) for axis in (FIRST, LAST))
    content = "does not tell which" if spoken is None else f"looks as if axis {spoken} were time"
    found = (
        f"{where} has the shape {shape}, which is {_reading(shape, FIRST)} or {_reading(shape, LAST)}, and its content "
        f"{content}"
    )
    if first == last:
        return f"{found}: save it as (frames, rows, columns) under the name 'spikes'."
    return f"{found}: pass size='{first}' or size='{last}', on the command line --size."
