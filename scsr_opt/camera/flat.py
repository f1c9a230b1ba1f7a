"""Size of the frames and length of the rows of a flat `.dat` file, which holds neither.

The file is nothing but packed frames. The size comes from the caller, else from the file's name (`…_400x250…`) or a
SpikeCV `config.yaml`. Where the pixels of a row lie in it is a `FlatLayout`: some recorders of the 400-column sensor
store rows of 416 bits, the last 16 of them padding, and the 1000-column sensor hands out rows of 1,024 bits, two halves
of 500 pixels with 12 bits after each that say which line it is. Which of the known layouts a file has follows from its
length and from its bits.
"""

import codecs
import dataclasses
import operator
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from scsr_opt.camera.plausibility import Regularity, regularity
from scsr_opt.camera.sampling import trains_of
from scsr_opt.camera.settings import CONTENT
from scsr_opt.camera.sources import FlatLayout, FlatSource
from scsr_opt.errors import InputError, shown

CAMERA_SIZES = ((400, 250), (1000, 1000))
"""(width, height) of the spike cameras whose recordings are about."""
ROWS_WITH_GAPS = {400: FlatLayout(416, ((0, 400),)), 1000: FlatLayout(1024, ((0, 500), (512, 1012)))}
"""Width of a sensor → the layout of its files in which not every bit of a row is a pixel."""


_SIZE = re.compile(r"\s*(\d{1,9})\s*[xX×]\s*(\d{1,9})\s*")
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
        raise InputError(
            f"The size {shown(size)} cannot be read: give it as WIDTHxHEIGHT in pixels, for example 400x250."
        )
    return (sides[0], sides[1])


_NAME, _CONFIG = "its name", "its config.yaml"


def find_size(path: Path, size: Any = None) -> tuple[int, int]:
    """(width, height) of the frames of the flat file `path`: from `size`, else its name or a `config.yaml`.

    **Raises:** `InputError` if none of them gives a size, or name and config give more than one.
    """
    if size is not None:
        return parse_size(size)
    known = known_sizes(path)
    if len(known) > 1:
        where = "The name" if set(known.values()) == {_NAME} else "The name with the config.yaml"
        raise InputError(
            f"{where} of {path} holds {len(known)} sizes ({', '.join(show_size(other) for other in sorted(known))}): "
            f"pass the right one as size, for example size='400x250'."
        )
    if not known:
        raise InputError(
            f"The size of the frames in {path} is not known, a .dat file does not hold it: give it (on the command "
            f"line --size WIDTHxHEIGHT, in Python size='WIDTHxHEIGHT'; the usual sensor is 400x250), or have it in the "
            f"file's name, or put a SpikeCV config.yaml with spike_w and spike_h beside it."
        )
    return next(iter(known))


def contradicted_size(path: Path, size: tuple[int, int]) -> str | None:
    """Remark on a given `size` that is none of those that go with the file; None if it is, or none goes with it."""
    known = known_sizes(path)
    if not known or size in known:
        return None
    turned = "; the size is WIDTHxHEIGHT" if size[::-1] in known else ""
    others = " and ".join(f"{source} says {show_size(other)}" for other, source in known.items())
    return f"{path.name}: size {show_size(size)} was given and is taken, but {others}{turned}."


def known_sizes(path: Path) -> dict[tuple[int, int], str]:
    """The (width, height) that go with a file, and what says so: its name, or a `config.yaml`; maybe none."""
    named = ((int(width), int(height)) for width, height in _SIZE_IN_NAME.findall(path.stem))
    sizes = {size: _NAME for size in named if min(size) > 0}
    configured = size_in_config(path)
    if configured is not None:
        sizes.setdefault(configured, _CONFIG)
    return sizes


def size_in_config(path: Path) -> tuple[int, int] | None:
    """(width, height) from the `config.yaml` of a SpikeCV data set, beside the file or one folder up.

    SpikeCV keeps one such file at the top of a data set and the recordings beside it or in one folder below. Its form
    is flat `key: value` lines, so two of them are read here and no YAML package is needed.
    """
    for folder in (path.parent, path.resolve().parent.parent):
        config = folder / "config.yaml"
        if not config.is_file():
            continue
        content = config.read_bytes()
        # Editors of Windows put a byte-order mark before the first key.
        encoding = "utf-16" if content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"
        text = content.decode(encoding, errors="replace")
        sides = [
            re.search(rf"^\s*{key}\s*:\s*[\"']?(\d{{1,9}})[\"']?\s*(?:#.*)?$", text, re.M)
            for key in ("spike_w", "spike_h")
        ]
        if sides[0] and sides[1]:
            return parse_size((int(sides[0][1]), int(sides[1][1])))
    return None


def find_layout(path: Path, size: tuple[int, int], row_bits: int | None = None) -> FlatLayout:
    """Layout of the flat file `path` of frames `size` (width, height), with rows of `row_bits` if that is known.

    The file's length decides where it is a whole number of frames in one of the known layouts only. It may be in more
    (200 frames with rows of 416 bits are as long as 208 with rows of 400), and in a file cut short in none: then some
    bits of a row are no pixels if they stay the same in frames all over the file while the others change, or if pixels
    fire as pixels do with them and do not without.

    **Raises:** `InputError` if `row_bits` is less than the width.
    """
    width, height = size
    if row_bits is not None and row_bits < width:
        raise InputError(
            f"row_bits={row_bits} is less than the {width} columns of {path.name}: it is the length of a row in the "
            f"file, padding included, 416 for instance."
        )
    if row_bits is not None:
        return _alignment(path, height, row_layout(width, row_bits))
    plain, gapped = row_layout(width, width), ROWS_WITH_GAPS.get(width)
    length = path.stat().st_size
    if gapped is None or gapped.frames(length, height) == 0:
        return _alignment(path, height, plain)
    fits = [layout for layout in (plain, gapped) if layout.rest(length, height) == 0]
    if len(fits) == 1:
        return fits[0]
    return gapped if _has_gaps(path, height, gapped) or _fires(path, height, gapped, plain) else plain


def row_layout(width: int, row_bits: int) -> FlatLayout:
    """Layout of rows of `row_bits` bits for `width` pixels: a known one, else padded at the right."""
    known = ROWS_WITH_GAPS.get(width)
    return known if known and known.row_bits == row_bits else FlatLayout(row_bits, ((0, width),))


def better_layout(path: Path, size: tuple[int, int], layout: FlatLayout) -> str | None:
    """Argument to pass instead, if the file holds a whole number of frames of another likely layout.

    Likely are the same size with another `row_bits`, a size in the file's name or `config.yaml`, and those of the known
    cameras. Asked where the layout does not fit, to tell a wrong one from a file cut short.
    """
    length = path.stat().st_size
    for other, each in likely_layouts(path, size):
        if (other, each.row_bits) != (size, layout.row_bits) and each.rest(length, other[1]) == 0:
            return f"row_bits={each.row_bits}" if other == size else f"size={show_size(other)}"
    return None


def likely_layouts(path: Path, size: tuple[int, int]) -> list[tuple[tuple[int, int], FlatLayout]]:
    """(width, height) and layout of what the flat file `path` may be, other than frames of `size`."""
    sizes = dict.fromkeys((size, *sorted(known_sizes(path)), *CAMERA_SIZES))
    layouts = [(other, row_layout(other[0], other[0])) for other in sizes]
    return layouts + [(other, ROWS_WITH_GAPS[other[0]]) for other in sizes if other[0] in ROWS_WITH_GAPS]


def _sampled(path: Path, height: int, layout: FlatLayout) -> UInt8[np.ndarray, "n bits"]:
    """All bits of some frames all over the file."""
    frames = layout.frames(path.stat().st_size, height)
    source = FlatSource(path, (frames, height, layout.width), layout, False)
    least, most = CONTENT.layout_frames
    count = max(least, min(most, CONTENT.layout_bits // layout.frame_bits(height)))
    chosen = np.unique(np.linspace(0, frames - 1, count).astype(int))
    return np.concatenate([source.bits(int(frame), int(frame) + 1) for frame in chosen])


def _has_gaps(path: Path, height: int, layout: FlatLayout) -> bool:
    """Test of the bits that are no pixels in this layout: they stay the same while the pixels change."""
    rows = _sampled(path, height, layout)[:, : height * layout.row_bits].reshape(-1, height, layout.row_bits)
    changes = np.count_nonzero(rows != rows[0], axis=(0, 1))
    pixel = np.zeros(layout.row_bits, bool)
    for start, stop in layout.segments:
        pixel[start:stop] = True
    most = CONTENT.gap_changes_share * changes[pixel].mean()
    return bool(changes[~pixel].mean() <= most) and bool(changes[pixel].any())


def _fires(path: Path, height: int, layout: FlatLayout, other: FlatLayout) -> bool:
    """Test of pixels: they fire as those of a camera do in one layout, and not in the other."""
    return _pace(path, height, layout).regular and _pace(path, height, other).irregular


def _pace(path: Path, height: int, layout: FlatLayout) -> Regularity:
    frames = layout.frames(path.stat().st_size, height)
    return regularity(trains_of(FlatSource(path, (frames, height, layout.width), layout, False)))


def _alignment(path: Path, height: int, layout: FlatLayout) -> FlatLayout:
    """`layout` with frames that begin on whole bytes, or, if it is clear that they do not, one after another.

    **Raises:** `InputError` if the bits that should fill up the last byte of a frame are set, and it is not clear.
    """
    bits, length = height * layout.row_bits, path.stat().st_size
    if bits % 8 == 0 or layout.frames(length, height) == 0:
        return layout
    packed = dataclasses.replace(layout, aligned=False)
    if not _sampled(path, height, layout)[:, bits:].any():
        if not _may_be_packed(path, height, layout):
            return layout
        # Where the length fits both, only content that is clear speaks against the frames that are filled up.
        return packed if layout.rest(length, height) or _fires(path, height, packed, layout) else layout
    if length * 8 % bits < 8 and not (
        _pace(path, height, packed).irregular and not _pace(path, height, layout).irregular
    ):
        return packed
    raise InputError(
        f"{path} holds set bits where a frame of {show_size((layout.width, height))}, which is no whole number of "
        f"bytes, is filled up with zeros to the next byte: check the size."
    )


def uncertain_alignment(path: Path, height: int, layout: FlatLayout) -> str | None:
    """Remark on a short file whose frames may as well follow each other without zero bits between them."""
    if not layout.aligned or layout.rest(path.stat().st_size, height) or not _may_be_packed(path, height, layout):
        return None
    if _pace(path, height, layout).regular:
        return None
    # The first frame is the same either way, and so are frames without a spike.
    if not _sampled(path, height, layout)[1:].any():
        return None
    return (
        f"{path.name}: frames of {show_size((layout.width, height))} are taken to be filled up with zero bits to whole "
        f"bytes, but they may follow each other without, and the content does not tell: write it as .npy, .npz or .h5."
    )


def _may_be_packed(path: Path, height: int, layout: FlatLayout) -> bool:
    """Test of a file that is a whole number of frames without bits that fill up a frame, those of `layout` being zero,
    maybe by chance."""
    bits, length = height * layout.row_bits, path.stat().st_size
    left = length * 8 % bits
    if bits % 8 == 0 or left >= 8:
        return False
    sampled = _sampled(path, height, layout)
    filling = sampled[:, bits:]
    if filling.any() or (1 - sampled[:, :bits].mean()) ** filling.size < CONTENT.filling_chance:
        return False
    with path.open("rb") as stream:
        stream.seek(-1, os.SEEK_END)
        return stream.read(1)[0] >> (8 - left) == 0


def show_size(size: tuple[int, int]) -> str:
    """(width, height) as `parse_size` reads it."""
    return f"{size[0]}x{size[1]}"
