"""What a flat `.dat` file does not say: how large its frames are and how long its rows.

The file is nothing but packed frames. The size comes from the caller, else from the file's name (`…_400x250…`), else
from a SpikeCV `config.yaml`. The length of a row in the file follows from the file's length: some recorders of the
400-column sensor store rows of 416 bits, the last 16 of them padding.
"""

import operator
import re
from pathlib import Path
from typing import Any

import numpy as np

from scsr_opt.camera.sources import FlatSource, frame_bytes
from scsr_opt.errors import InputError

CAMERA_SIZES = ((400, 250), (1000, 1000))
"""(width, height) of the spike cameras whose recordings are about."""
PADDED_ROWS = {400: 416}
"""Width of a sensor → bits of a row in the padded variant of its files."""

_SIZE = re.compile(r"\s*(\d+)\s*[xX×]\s*(\d+)\s*")
# Two digits at least, so that names such as `car_2x4` (a scale) are not taken for a size.
_SIZE_IN_NAME = re.compile(r"(?<!\d)(\d{2,5})[xX×](\d{2,5})(?!\d)")


def parse_size(size: Any) -> tuple[int, int]:
    """(width, height) in pixels from `"400x250"`, or from a pair of whole numbers as it stands.

    **Raises:** `InputError` if it is neither, or a side is below 1.
    """
    if isinstance(size, str):
        match = _SIZE.fullmatch(size)
        sides = tuple(int(side) for side in match.groups()) if match else ()
    else:
        try:
            sides = tuple(operator.index(side) for side in size)
        except TypeError:
            sides = ()
    if len(sides) != 2 or min(sides) < 1:
        raise InputError(f"The size {size!r} cannot be read: give it as WIDTHxHEIGHT in pixels, for example 400x250.")
    return (sides[0], sides[1])


def find_size(path: Path, size: Any = None) -> tuple[int, int]:
    """(width, height) of the frames of the flat file `path`: from `size`, else its name, else a `config.yaml`.

    **Raises:** `InputError` if none of them gives a size, or the name gives two.
    """
    if size is not None:
        return parse_size(size)
    known = known_sizes(path)
    if len(known) > 1:
        raise InputError(
            f"The name of {path} holds {len(known)} sizes ({', '.join(show_size(s) for s in sorted(known))}): pass the "
            f"right one as size, for example size='400x250'."
        )
    if not known:
        raise InputError(
            f"The size of the frames in {path} is not known, a .dat file does not hold it: pass size='WIDTHxHEIGHT' "
            f"(the usual sensor is 400x250), or have it in the file's name, or put a SpikeCV config.yaml with spike_w "
            f"and spike_h beside it."
        )
    return known.pop()


def known_sizes(path: Path) -> set[tuple[int, int]]:
    """The (width, height) that go with a file: those written in its name, else its `config.yaml`'s; maybe none."""
    named = {(int(width), int(height)) for width, height in _SIZE_IN_NAME.findall(path.stem)}
    configured = None if named else size_in_config(path)
    return named if configured is None else {configured}


def size_in_config(path: Path) -> tuple[int, int] | None:
    """(width, height) from the `config.yaml` of a SpikeCV data set, beside the file or one folder up.

    SpikeCV keeps one such file at the top of a data set and the recordings beside it or in one folder below. Its form
    is flat `key: value` lines, so two of them are read here and no YAML package is needed.
    """
    for folder in (path.parent, path.resolve().parent.parent):
        config = folder / "config.yaml"
        if not config.is_file():
            continue
        text = config.read_text(encoding="utf-8", errors="replace")
        sides = [
            re.search(rf"^\s*{key}\s*:\s*[\"']?(\d+)[\"']?\s*(?:#.*)?$", text, re.M) for key in ("spike_w", "spike_h")
        ]
        if sides[0] and sides[1]:
            return parse_size((int(sides[0][1]), int(sides[1][1])))
    return None


def find_row_bits(path: Path, size: tuple[int, int]) -> int:
    """Bits of a row in the flat file `path` of frames `size` (width, height): the width, or that of the padded variant.

    The known padded variant is 416 bits for 400 columns. The file's length decides where it is a whole number of frames
    in one of the two layouts only. It may be in both (200 frames of 416 bits are as long as 208 of 400), and in a file
    cut short in neither: then the rows are padded if the supposed padding is empty in frames all over the file and the
    rest is not.
    """
    width, height = size
    padded = PADDED_ROWS.get(width)
    length = path.stat().st_size
    if padded is None or length < frame_bytes(height, padded):
        return width
    fits_plain, fits_padded = length % frame_bytes(height, width) == 0, length % frame_bytes(height, padded) == 0
    if fits_plain != fits_padded:
        return width if fits_plain else padded
    frames = length // frame_bytes(height, padded)
    source = FlatSource(path, (frames, height, padded), padded, False)
    chosen = np.unique(np.linspace(0, frames - 1, 8).astype(int))
    sample = np.concatenate([source.read(int(frame), int(frame) + 1) for frame in chosen])
    return padded if sample[:, :, :width].any() and not sample[:, :, width:].any() else width


def better_layout(path: Path, size: tuple[int, int], row_bits: int) -> str | None:
    """What to pass instead, if the file holds a whole number of frames of another likely layout.

    Likely are the same size with another `row_bits`, a size in the file's name or `config.yaml`, and those of the known
    cameras. Asked where the layout does not fit, to tell a wrong one from a file cut short.
    """
    length = path.stat().st_size
    for other in (size, *sorted(known_sizes(path)), *CAMERA_SIZES):
        for bits in sorted({other[0], PADDED_ROWS.get(other[0], other[0])}):
            if (other, bits) != (size, row_bits) and length % frame_bytes(other[1], bits) == 0:
                return f"row_bits={bits}" if other == size else f"size={show_size(other)}"
    return None


def show_size(size: tuple[int, int]) -> str:
    """(width, height) as `parse_size` reads it."""
    return f"{size[0]}x{size[1]}"
