"""Recordings in files: one function reads them all, one writes them, the ending of the name says which format.

- `.dat`: flat, packed frames without a header, LSB first; rows bottom-up as the camera stores them, or top-down.
  Mapped.
- `.npy`: (T, h, w) of 0 and 1, upright. Mapped.
- `.npz`: `spikes`, `spk` or `raw_spike` (T, h, w), or `arr_0` (h, w, T), upright; with `white_rate`, `readout_rate` and
  `bad_pixels` if they are there; or `seq` (T / 8, h, w), packed along time, with `length`. Read whole; written as
  `spikes` with the rest.
- `.h5`, `.hdf5`: dataset `raw_spike` (T, h, w) of 0 and 1, upright; the rates are attributes of it, `bad_pixels` a
  dataset beside it. Read by windows. Links are followed.

`raw_spike` is what Spike2Flow and its relatives write (`f['raw_spike'] = spikes`), one byte a pixel. Flat files follow
SpikeCV's `SpikeToRaw` and the files of the cameras. Those only know frames of a whole number of bytes; here a frame
whose h·w is not a multiple of 8 is filled up with zero bits to the next byte, so every size can be written and read
back; files whose frames follow each other without that are read as well.

None of them says for sure what it holds. Before a file is read, its kind is recognised by the first bytes (`magic`),
its axis of time by where spikes are regular (`axes`), its layout by what rows and frames look like (`flat_content`):
docs/formats.md has the table.
"""

import math
import operator
import os
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, SupportsFloat, cast

import h5py
import numpy as np

from scsr_opt._files import as_path, is_url
from scsr_opt._validation import flag, whole
from scsr_opt.camera.axes import FIRST, LAST, time_axis
from scsr_opt.camera.flat import (
    better_layout,
    contradicted_size,
    find_layout,
    find_size,
    parse_size,
    show_size,
    uncertain_alignment,
)
from scsr_opt.camera.flat_content import remark
from scsr_opt.camera.magic import HDF5, NPY, ZIP, kind_of
from scsr_opt.camera.plausibility import axis_regularity
from scsr_opt.camera.recording import READOUT_RATE, WHITE_RATE, Recording, checked_settings
from scsr_opt.camera.remote import file_name, read_url
from scsr_opt.camera.settings import CONTENT
from scsr_opt.camera.sources import (
    DAMAGED,
    ArraySource,
    FlatSource,
    Hdf5Source,
    NpySource,
    SpikeSource,
    as_spikes,
    checked_shape,
    hdf5_fault,
)
from scsr_opt.camera.writing import write_recording
from scsr_opt.errors import InputError, shown

__all__ = ["parse_size", "read_recording", "write_recording"]

NPZ_KEYS = ("spikes", "spk", "raw_spike", "arr_0")
"""Arrays of an `.npz` that are taken for the spikes, the first one that is there."""
HDF5_KEY = "raw_spike"

_RATES = ("white_rate", "readout_rate")
_MASK = "bad_pixels"
_PACKED, _LENGTH = "seq", "length"
"""Array of frames packed along time, eight to a byte, and the number of frames."""
_KINDS = {".npy": NPY, ".npz": ZIP, ".h5": HDF5, ".hdf5": HDF5}


class _Request(NamedTuple):
    path: Path
    size: Any
    flip: bool | None
    row_bits: int | None
    key: str | None


_Read = tuple[SpikeSource, bool, dict[str, Any]]


def read_recording(
    path: str | os.PathLike[str],
    *,
    size: Any = None,
    flip: bool | None = None,
    row_bits: int | None = None,
    white_rate: SupportsFloat | None = None,
    readout_rate: SupportsFloat | None = None,
    key: str | None = None,
    bad_pixels: Any = None,
) -> Recording:
    """Opens a recording of a spike camera; the module's docstring lists the formats.

    Flat, `.npy` and HDF5 files of any length open at once: frames are read when a window of them is asked for.

    **Arguments:**
    - `path`: of a file, or a URL that fsspec knows (`s3://…`, `https://…`), as a str. What is behind a URL is copied to
      a temporary file, which is kept as long as the recording is in use; no `config.yaml` is looked for there.
    - `size`: `"400x250"` or (width, height), pixels. A `.dat` file needs it unless its name holds it (`…_400x250.dat`)
      or a SpikeCV `config.yaml` (`spike_w`, `spike_h`) lies beside it or one folder up. For the other formats it is
      checked, and tells (T, h, w) from (h, w, T).
    - `flip`: whether the file has the rows bottom-up; they are handed out upright. By default True for `.dat`, as
      cameras and SpikeCV write it, and False for the others.
    - `row_bits`: bits of a row in a `.dat`, if some of them are no pixels. By default found: 416 for 400 columns (the
      last 16 are padding) and 1,024 for 1,000 (12 after each half are markers) where the file's length or, if that fits
      both or neither, its content says so; the width for all others.
    - `white_rate`: spikes per frame of intensity 1. By default the file's, else 0.6.
    - `readout_rate`: spike frames per second, Hz. By default the file's, else 40,000.
    - `key`: the array of an `.npz` or HDF5 file that holds the spikes, if it has an unusual name.
    - `bad_pixels`: (h, w) mask, upright, True where a pixel must not be used, or the path of a `.npy` that holds it. By
      default the file's, else None.

    **Returns:** the `Recording`. A part of a frame at the end of a `.dat` is dropped, with a warning; there is one too
    if its bits do not look like spikes of that size, or the size is not the one in its name or `config.yaml`.

    **Raises:** `InputError`, one sentence on what was found and what to do, if there is no such file, it is empty,
    damaged, another kind of file or shorter than a frame, its ending or layout is not known, its size is not known or
    does not fit, it is not certain which axis is time, or it holds other values than 0 and 1 (in a mapped file: in its
    first frame; in later ones when they are read).
    """
    if is_url(path):
        url = cast(str, path)
        _by_ending(file_name(url))  # before it is fetched
        given: dict[str, Any] = {"size": size, "flip": flip, "row_bits": row_bits, "key": key}
        given |= {"white_rate": white_rate, "readout_rate": readout_rate, "bad_pixels": bad_pixels}
        return read_url(url, lambda file: read_recording(file, **given))
    file = as_path(path)
    if file.is_dir():
        raise InputError(f"{file} is a folder, not a recording: name one file in it.")
    reader = _by_ending(file)
    if not file.is_file():
        if file.exists():
            raise InputError(f"{file} is a pipe or a device, not a file: scsr sequence - reads frames from a pipe.")
        raise InputError(f"There is no file {file.absolute()}: check the path.")
    if file.stat().st_size == 0:
        raise InputError(f"{file} is empty (0 bytes): record or copy it again.")
    ending = file.suffix.lower()
    flip = None if flip is None else flag(flip, "flip")
    row_bits = None if row_bits is None else whole(row_bits, "row_bits", 1)
    if not isinstance(key, str | None):
        raise InputError(f"key is {shown(key)}, but it must be the name of an array in the file.")
    if row_bits is not None and ending != ".dat":
        raise InputError(
            f"row_bits={row_bits} was given for {file.name}, but only flat .dat files have it: leave it out."
        )
    if key is not None and ending in (".dat", ".npy"):
        raise InputError(
            f"key={key!r} was given for {file.name}, but a {ending} file holds one array without a name: leave it out."
        )
    _check_kind(file)
    source, flipped, extras = reader(_Request(file, size, flip, row_bits, key))
    given = {"white_rate": white_rate, "readout_rate": readout_rate, "bad_pixels": _read_mask(bad_pixels)}
    known: dict[str, Any] = {"white_rate": WHITE_RATE, "readout_rate": READOUT_RATE, "bad_pixels": None, **extras}
    known.update({name: value for name, value in given.items() if value is not None})
    return Recording(source, flipped=flipped, name=file.stem, **checked_settings(source.shape, **known))


def _read_flat(request: _Request) -> _Read:
    path = request.path
    size = find_size(path, request.size)
    width, height = size
    layout = find_layout(path, size, request.row_bits)
    length, frame = path.stat().st_size, layout.frame_bits(height) // 8
    frames, rest = layout.frames(length, height), layout.rest(length, height)
    other = better_layout(path, size, layout) if rest else None
    if frames == 0 or other is not None:
        hint = f"{other} would fit" if other else "check the size, or copy the file again"
        raise InputError(
            f"{path} holds {length:,} bytes, which is "
            f"{'less than one frame' if frames == 0 else 'no whole number of frames'} of {show_size(size)} ({frame:,} "
            f"bytes each): {hint}."
        )
    if rest:
        warnings.warn(
            f"{path.name}: the last {rest:,} bytes are not a whole frame of {show_size(size)} ({frame:,} bytes) and "
            f"are dropped; if the picture looks sheared, the size is another one.",
            stacklevel=3,
        )
    for doubt in (contradicted_size(path, size), uncertain_alignment(path, height, layout)):
        if doubt:
            warnings.warn(doubt, stacklevel=3)
    flipped = request.flip is None or bool(request.flip)
    source = FlatSource(path, (frames, height, width), layout, flipped)
    amiss = remark(source)
    if amiss:
        warnings.warn(amiss, stacklevel=3)
    return source, flipped, {}


def _read_npy(request: _Request) -> _Read:
    path = request.path
    stored = _open_npy(path)
    shape = checked_shape(stored.shape, path.name)
    as_spikes(np.asarray(stored[:1]), path.name)  # intensities have no axis of time to be asked for
    last = time_axis(stored, path.name, size=request.size, convention=FIRST) == LAST
    source = NpySource(path, _time_first(shape, last), bool(request.flip), last)
    source.read(0, 1)
    return source, bool(request.flip), {}


def _read_npz(request: _Request) -> _Read:
    path = request.path
    # The stream is opened here because np.load leaves its own open when the archive turns out to be damaged.
    with path.open("rb") as stream:
        try:
            archive = np.load(stream, allow_pickle=False)
        except DAMAGED as error:
            raise _damaged(path, "numpy archive", error) from error
        if isinstance(archive, np.ndarray):
            raise InputError(f"{path} holds a single array without a name: it is an .npy file, give it that ending.")
        names = archive.files
        packed = _PACKED in names and _LENGTH in names
        key = _find_key(path, request.key, names, (*NPZ_KEYS, _PACKED) if packed else NPZ_KEYS)
        try:
            array = np.asarray(archive[key])
            frames = np.asarray(archive[_LENGTH]) if packed and key == _PACKED else None
            extras = {name: _scalar(archive[name]) for name in _RATES if name in names}
            if _MASK in names:
                extras[_MASK] = archive[_MASK]
        except DAMAGED as error:
            raise _damaged(path, "numpy archive", error) from error
    where = f"{path.name}, array {key!r},"
    checked_shape(array.shape, where)
    if frames is not None:
        array = _unpacked(array, frames, where)
    array = as_spikes(array, where)
    convention = None if key == "arr_0" else FIRST
    if time_axis(array, where, size=request.size, convention=convention, written=_written(extras)) == LAST:
        array = np.moveaxis(array, -1, 0)
    upright = array[:, ::-1] if request.flip else array
    return ArraySource.of(upright), bool(request.flip), extras


def _written(extras: dict[str, Any]) -> bool:
    """Test of a file by `write_recording`, which stores both rates with the spikes."""
    return all(name in extras for name in _RATES)


def _unpacked(array: np.ndarray, frames: np.ndarray, where: str) -> np.ndarray:
    """Frames of bits that are packed along time, eight to a byte, unless they are not packed."""
    try:
        count = operator.index(frames.item())
    except (TypeError, ValueError):
        count = 0
    if array.dtype.kind in "bui" and len(array) == count:
        return array
    if array.dtype != np.uint8 or len(array) != math.ceil(count / 8):
        raise InputError(
            f"{where} has the shape {array.shape} and type {array.dtype}, which is not 'length' = {frames} frames "
            f"packed eight to a byte (ceil(length / 8), rows, columns) of uint8: unpack it, and save it as 'spikes'."
        )
    # numpy packs the first frame into the highest bit by default. In the wrong order, frames of one byte
    # still lie beside each other; it shows where one byte ends and the next begins, in the middle of pieces from 4 on.
    orders = [np.unpackbits(array, axis=0, count=count, bitorder=order) for order in ("big", "little")]
    found = [axis_regularity(order[min(4, count - 1) :])[0] for order in orders]
    if abs(found[0].ratio - found[1].ratio) > CONTENT.bit_order_ratio_difference and (
        found[0].regular or found[1].regular
    ):
        return orders[0] if found[0].ratio < found[1].ratio else orders[1]
    warnings.warn(
        f"{where} is packed along time, and its content does not tell in which order: the first of eight frames is "
        f"taken from the highest bit, as numpy.packbits has it; else unpack it, and save it as 'spikes'.",
        stacklevel=2,
    )
    return orders[0]


def _read_hdf5(request: _Request) -> _Read:
    path = request.path
    try:
        with h5py.File(path, "r") as file:
            named = (request.key or HDF5_KEY).strip("/")
            names, dead = _dataset_names(file)
            for name, link in dead.items():
                if named not in names and (named == name or named.startswith(f"{name}/") or not names):
                    raise _dead_link(path, name, link)
            key = _find_key(path, request.key and named, names, (HDF5_KEY,))
            dataset = cast(h5py.Dataset, file[key])
            where = f"{path.name}, dataset {key!r},"
            shape = checked_shape(tuple(dataset.shape or ()), where)
            _check_type(dataset.dtype, where)
            _check_parts(path, dataset)
            as_spikes(np.asarray(dataset[:1]), where)  # intensities have no axis of time to be asked for
            attributes = {**file.attrs, **dataset.attrs}
            extras = {name: _scalar(np.asarray(attributes[name])) for name in _RATES if name in attributes}
            if _MASK in file:
                extras[_MASK] = np.asarray(file[_MASK])
            axis = time_axis(dataset, where, size=request.size, convention=FIRST, written=_written(extras))
    except InputError:
        raise
    except DAMAGED as error:
        raise hdf5_fault(path, error) or _damaged(path, "HDF5 file", error) from error
    last = axis == LAST
    source = Hdf5Source(path, key, _time_first(shape, last), bool(request.flip), last)
    source.read(0, 1)
    return source, bool(request.flip), extras


def _check_type(kind: np.dtype, where: str) -> None:
    """**Raises:** `InputError` if values of this type are no spikes, before they are counted."""
    as_spikes(np.empty(0, kind), where)


def _check_parts(path: Path, dataset: h5py.Dataset) -> None:
    """Looks for the other files that a virtual dataset is put together from, as HDF5 has zeros for missing ones.

    **Raises:** `InputError` if one is not there.
    """
    if not dataset.is_virtual:
        return
    for part in dataset.virtual_sources():
        name = part.file_name
        # "." is this file; names with % are patterns of as many files as there are.
        if name != "." and "%" not in name and not (path.parent / name).is_file() and not Path(name).is_file():
            raise InputError(
                f"{path} holds {(dataset.name or '').strip('/')!r} as a view of {name}, which is not there: put it "
                f"beside it, or name another dataset by key, on the command line by --array."
            )


def _time_first(shape: tuple[int, int, int], last: bool) -> tuple[int, int, int]:
    return (shape[2], shape[0], shape[1]) if last else shape


_READERS: dict[str, Callable[[_Request], _Read]] = {
    ".dat": _read_flat,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".h5": _read_hdf5,
    ".hdf5": _read_hdf5,
}


def _check_kind(path: Path) -> None:
    """Refuses what is another kind of file than its ending says."""
    ending = path.suffix.lower()
    # Both may begin with something else: an HDF5 file with a block of the user, an archive with a program.
    if (ending in (".h5", ".hdf5") and h5py.is_hdf5(path)) or (ending == ".npz" and zipfile.is_zipfile(path)):
        return
    kind = kind_of(path)
    if kind is None or kind == _KINDS.get(ending) or (ending in (".npy", ".npz") and kind in (NPY, ZIP)):
        return  # which arrays the last two hold is said where they are opened
    fitting = next((other for other, own in _KINDS.items() if own == kind), None)
    advice = f"give it the ending {fitting}" if fitting else "get the recording itself, or convert it"
    raise InputError(f"{path} is {kind}, not what its ending {path.suffix} says: {advice}.")


def _by_ending(path: Path) -> Callable[[_Request], _Read]:
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(
            f"{path.name} ends in {path.suffix or 'nothing'!r}, which is no known format of recordings: rename or "
            f"convert it to one of {', '.join(_READERS)}."
        )
    return reader


def _find_key(path: Path, key: str | None, found: list[str], usual: tuple[str, ...]) -> str:
    if key is not None:
        usual = (key,)
    for name in usual:
        if name in found:
            return name
    raise InputError(
        f"{path} holds no array {' or '.join(repr(name) for name in usual)}, but "
        f"{', '.join(found) or 'nothing at all'}: say which of them are the spikes, "
        f"by key, on the command line by --array."
    )


def _dataset_names(file: h5py.File) -> tuple[list[str], dict[str, Any]]:
    """Paths of all datasets, those behind soft and external links included; and the links that lead to nothing."""
    names: list[str] = []
    dead: dict[str, Any] = {}

    def walk(group: h5py.Group, above: tuple[h5py.Group, ...], prefix: str) -> None:
        for name in group:
            try:
                item = group[name]
            except (KeyError, OSError, RuntimeError):  # the last for links that lead to themselves
                dead[f"{prefix}{name}"] = group.get(name, getlink=True)
                continue
            if isinstance(item, h5py.Dataset):
                names.append(f"{prefix}{name}")
            elif isinstance(item, h5py.Group) and item not in above:
                walk(item, (*above, item), f"{prefix}{name}/")

    walk(file, (file,), "")
    return names, dead


def _dead_link(path: Path, name: str, link: Any) -> InputError:
    """Why a link cannot be followed: the file that it leads to may be locked or damaged rather than missing."""
    where = ""
    if isinstance(link, h5py.ExternalLink):
        where = f" of {link.filename}"
        target = next((each for each in (path.parent / link.filename, Path(link.filename)) if each.is_file()), None)
        if target is not None:
            try:
                h5py.File(target, "r").close()
            except DAMAGED as error:
                return hdf5_fault(target, error) or _damaged(target, "HDF5 file", error)
    missing = getattr(link, "path", name)
    return InputError(
        f"{path} holds {name!r} as a link that leads nowhere: there is no {missing}{where}; put the file it leads to "
        f"beside it, or name another dataset by key, on the command line by --array."
    )


def _read_mask(mask: Any) -> Any:
    if not isinstance(mask, (str, os.PathLike)):
        return mask
    path = Path(mask)
    if not path.is_file():
        raise InputError(f"There is no file {path.absolute()} with bad pixels: check the path.")
    return np.array(_open_npy(path))


def _open_npy(path: Path) -> np.ndarray:
    try:
        return np.lib.format.open_memmap(path, mode="r")
    except DAMAGED as error:
        if zipfile.is_zipfile(path):
            raise InputError(
                f"{path} holds named arrays, not one: it is an .npz file; save the one with np.save."
            ) from error
        raise _damaged(path, "numpy array", error) from error


def _scalar(value: np.ndarray) -> Any:
    return value.item() if value.size == 1 else value


def _damaged(path: Path, kind: str, error: Exception) -> InputError:
    # NumPy takes what it does not know for its pickles, and says how to open them.
    why = "" if "pickle" in str(error) else f" ({error})"
    return InputError(f"{path} is no readable {kind}{why}: it may be damaged or something else; get it anew.")
