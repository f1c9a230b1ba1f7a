"""Recordings in files: one function reads them all, one writes them, the ending of the name says which format.

- `.dat`: flat, packed frames without a header, LSB first; rows bottom-up as the camera stores them, or top-down.
  Mapped.
- `.npy`: (T, h, w) of 0 and 1, upright. Mapped.
- `.npz`: `spikes` or `spk` (T, h, w), or `arr_0` (h, w, T), upright; with `white_rate`, `readout_rate` and `bad_pixels`
  if they are there. Read whole; written as `spikes` with the rest.
- `.h5`, `.hdf5`: dataset `raw_spike` (T, h, w) of 0 and 1, upright; the rates are attributes of it, `bad_pixels` a
  dataset beside it. Read by windows.

`raw_spike` is what Spike2Flow and its relatives write (`f['raw_spike'] = spikes`), one byte a pixel. Flat files follow
SpikeCV's `SpikeToRaw` and the files of the cameras. Those only know frames of a whole number of bytes; here a frame
whose h·w is not a multiple of 8 is filled up with zero bits to the next byte, so every size can be written and read
back. Not read: the 1024-bit rows of the 1000x1000 camera with markers between the frames.
"""

import os
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, SupportsFloat, cast

import h5py
import numpy as np

from scsr_opt.camera.flat import (
    CAMERA_SIZES,
    better_layout,
    find_row_bits,
    find_size,
    known_sizes,
    parse_size,
    show_size,
)
from scsr_opt.camera.recording import READOUT_RATE, WHITE_RATE, Recording, checked_settings
from scsr_opt.camera.sources import (
    DAMAGED,
    ArraySource,
    FlatSource,
    Hdf5Source,
    NpySource,
    SpikeSource,
    as_spikes,
    checked_shape,
    frame_bytes,
)
from scsr_opt.camera.writing import write_recording
from scsr_opt.errors import InputError

__all__ = ["parse_size", "read_recording", "write_recording"]

NPZ_KEYS = ("spikes", "spk", "raw_spike", "arr_0")
"""Arrays of an `.npz` that are taken for the spikes, the first one that is there."""
HDF5_KEY = "raw_spike"

_RATES = ("white_rate", "readout_rate")
_MASK = "bad_pixels"


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
    - `size`: `"400x250"` or (width, height), pixels. A `.dat` file needs it unless its name holds it (`…_400x250.dat`)
      or a SpikeCV `config.yaml` (`spike_w`, `spike_h`) lies beside it or one folder up. For the other formats it is
      checked, and tells (T, h, w) from (h, w, T) for `arr_0`.
    - `flip`: whether the file has the rows bottom-up; they are handed out upright. By default True for `.dat`, as
      cameras and SpikeCV write it, and False for the others.
    - `row_bits`: bits of a row in a `.dat`, if rows are padded at the right. By default found: 416 for 400 columns
      where the file's length or, if that fits both or neither, empty padding says so; the width for all others.
    - `white_rate`: spikes per frame of intensity 1. By default the file's, else 0.6.
    - `readout_rate`: spike frames per second, Hz. By default the file's, else 40,000.
    - `key`: the array of an `.npz` or HDF5 file that holds the spikes, if it has an unusual name.
    - `bad_pixels`: (h, w) mask, upright, True where a pixel must not be used, or the path of a `.npy` that holds it. By
      default the file's, else None.

    **Returns:** the `Recording`. A part of a frame at the end of a `.dat` is dropped, with a warning.

    **Raises:** `InputError`, one sentence on what was found and what to do, if there is no such file, it is empty,
    damaged or shorter than a frame, its ending or layout is not known, its size is not known or does not fit, or it
    holds other values than 0 and 1 (in a mapped file: in its first frame; in later ones when they are read).
    """
    file = Path(path)
    if file.is_dir():
        raise InputError(f"{file} is a folder, not a recording: name one file in it.")
    reader = _by_ending(file)
    if not file.is_file():
        raise InputError(f"There is no file {file.absolute()}: check the path.")
    if file.stat().st_size == 0:
        raise InputError(f"{file} is empty (0 bytes): record or copy it again.")
    ending = file.suffix.lower()
    if row_bits is not None and ending != ".dat":
        raise InputError(
            f"row_bits={row_bits} was given for {file.name}, but only flat .dat files have it: leave it out."
        )
    if key is not None and ending in (".dat", ".npy"):
        raise InputError(
            f"key={key!r} was given for {file.name}, but a {ending} file holds one array without a name: leave it out."
        )
    source, flipped, extras = reader(_Request(file, size, flip, row_bits, key))
    given = {"white_rate": white_rate, "readout_rate": readout_rate, "bad_pixels": _read_mask(bad_pixels)}
    known: dict[str, Any] = {"white_rate": WHITE_RATE, "readout_rate": READOUT_RATE, "bad_pixels": None, **extras}
    known.update({name: value for name, value in given.items() if value is not None})
    return Recording(source, flipped=flipped, name=file.stem, **checked_settings(source.shape, **known))


def _read_flat(request: _Request) -> _Read:
    path = request.path
    size = find_size(path, request.size)
    width, height = size
    row_bits = find_row_bits(path, size) if request.row_bits is None else int(request.row_bits)
    if row_bits < width:
        raise InputError(
            f"row_bits={row_bits} is less than the {width} columns of {path.name}: it is the length of a row in the "
            f"file, padding included, 416 for instance."
        )
    length, frame = path.stat().st_size, frame_bytes(height, row_bits)
    frames, rest = divmod(length, frame)
    other = better_layout(path, size, row_bits) if rest else None
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
    if size not in (known := known_sizes(path)) and (height, width) in known:
        warnings.warn(
            f"{path.name}: size {show_size(size)} was given, but its name or config.yaml says "
            f"{show_size((height, width))}; the size is WIDTHxHEIGHT.",
            stacklevel=3,
        )
    flipped = request.flip is None or bool(request.flip)
    return FlatSource(path, (frames, height, width), row_bits, flipped), flipped, {}


def _read_npy(request: _Request) -> _Read:
    path = request.path
    stored = _open_npy(path)
    shape = _fitting(checked_shape(stored.shape, path.name), request.size, path.name)
    source = NpySource(path, shape, bool(request.flip))
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
        key = _find_key(path, request.key, archive.files, NPZ_KEYS)
        try:
            array = np.asarray(archive[key])
            extras = {name: _scalar(archive[name]) for name in _RATES if name in archive.files}
            if _MASK in archive.files:
                extras[_MASK] = archive[_MASK]
        except DAMAGED as error:
            raise _damaged(path, "numpy archive", error) from error
    where = f"{path.name}, array {key!r},"
    shape = checked_shape(array.shape, where)
    if key == "arr_0" and _rows_first(shape, request.size, where):
        array = np.moveaxis(array, -1, 0)
    _fitting(checked_shape(array.shape, where), request.size, where)
    upright = array[:, ::-1] if request.flip else array
    return ArraySource.of(as_spikes(upright, where)), bool(request.flip), extras


def _read_hdf5(request: _Request) -> _Read:
    path = request.path
    try:
        with h5py.File(path, "r") as file:
            key = _find_key(path, request.key and request.key.strip("/"), _dataset_names(file), (HDF5_KEY,))
            dataset = cast(h5py.Dataset, file[key])
            shape = tuple(dataset.shape or ())
            attributes = {**file.attrs, **dataset.attrs}
            extras = {name: _scalar(np.asarray(attributes[name])) for name in _RATES if name in attributes}
            if _MASK in file:
                extras[_MASK] = np.asarray(file[_MASK])
    except InputError:
        raise
    except DAMAGED as error:
        raise _damaged(path, "HDF5 file", error) from error
    where = f"{path.name}, dataset {key!r},"
    source = Hdf5Source(path, key, _fitting(checked_shape(shape, where), request.size, where), bool(request.flip))
    source.read(0, 1)
    return source, bool(request.flip), extras


_READERS: dict[str, Callable[[_Request], _Read]] = {
    ".dat": _read_flat,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".h5": _read_hdf5,
    ".hdf5": _read_hdf5,
}


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


def _dataset_names(file: h5py.File) -> list[str]:
    names: list[str] = []
    file.visititems(lambda name, item: names.append(str(name)) if isinstance(item, h5py.Dataset) else None)
    return names


def _rows_first(shape: tuple[int, int, int], size: Any, where: str) -> bool:
    """Whether `arr_0` is (h, w, T), its convention, and not (T, h, w), which `np.savez(path, spikes)` also calls so."""
    if size is not None:
        width, height = parse_size(size)
        return shape[:2] == (height, width) or shape[1:] != (height, width)
    for width, height in CAMERA_SIZES:
        if shape[1:] == (height, width) != shape[:2]:
            raise InputError(
                f"{where} has the shape {shape}: by convention that is (rows, columns, frames), but it looks like "
                f"(frames, rows, columns); pass size='{show_size((width, height))}' or "
                f"size='{show_size((shape[1], shape[0]))}'."
            )
    return True


def _fitting(shape: tuple[int, int, int], size: Any, where: str) -> tuple[int, int, int]:
    if size is not None:
        width, height = parse_size(size)
        if shape[1:] != (height, width):
            raise InputError(
                f"{where} has {shape[0]} frames of {show_size((shape[2], shape[1]))}, not of the given size "
                f"{show_size((width, height))}: leave the size out, or transpose the array to (frames, rows, columns)."
            )
    return shape


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
