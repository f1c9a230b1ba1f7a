"""Recordings into files.

Everything is written under a temporary name in the same folder and renamed when it is complete, so a file with the
final name is a whole one, whatever happens in between. Frames are read and written a chunk at a time.
"""

import dataclasses
import os
import secrets
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedIOBase
from pathlib import Path
from typing import IO, Any, SupportsFloat

import h5py
import numpy as np
from jaxtyping import UInt8

from scsr_opt.camera.flat import known_sizes, row_layout, show_size
from scsr_opt.camera.recording import Recording, checked_settings
from scsr_opt.camera.sources import FlatLayout, pack
from scsr_opt.errors import InputError

ENDINGS = (".dat", ".npy", ".npz", ".h5", ".hdf5")

_CHUNK_BYTES = 32 << 20


def write_recording(
    path: str | os.PathLike[str],
    recording: Any,
    *,
    flip: bool | None = None,
    row_bits: int | None = None,
    white_rate: SupportsFloat | None = None,
    readout_rate: SupportsFloat | None = None,
    bad_pixels: Any = None,
) -> Path:
    """Writes a recording; the ending says how. What it writes, `read_recording` reads back exactly, by its defaults.

    `.npz` and HDF5 files hold the rates and the bad pixels as well; a `.dat` or `.npy` has room for the spikes only,
    and a `.dat` not even for their size, which belongs in its name (`…_400x250.dat`).

    **Arguments:**
    - `path`: ends in `.dat`, `.npy`, `.npz`, `.h5` or `.hdf5`; a file of that name is replaced.
    - `recording`: a `Recording`, or an array (T, h, w) of 0 and 1, upright.
    - `flip`: `.dat` only: store the rows bottom-up as cameras do (the default), or top-down.
    - `row_bits`: `.dat` only: length of a row in the file, at least the width; the bits that are no pixels are zero. By
      default the width.
    - `white_rate`, `readout_rate`, `bad_pixels`: if given, instead of the recording's.

    **Returns:** the path.

    **Raises:** `InputError` if the ending is not known, the folder is missing, the recording is not one, or `path` is a
    `.dat` that would be read back with another size.
    """
    file = Path(path)
    ending = file.suffix.lower()
    if ending not in ENDINGS:
        raise InputError(
            f"{file.name} ends in {file.suffix or 'nothing'!r}, which is no known format of recordings: choose one of "
            f"{', '.join(ENDINGS)}."
        )
    if ending != ".dat" and (flip is not None or row_bits is not None):
        raise InputError(
            f"flip or row_bits was given for {file.name}, but only flat .dat files have them: leave them out (other "
            f"files are upright)."
        )
    if file.is_dir() or not file.parent.is_dir():
        found = "is a folder" if file.is_dir() else "is in a folder that does not exist"
        raise InputError(f"{file} cannot be written, it {found}: give the name of a file in a folder that is there.")
    if not isinstance(recording, Recording):
        recording = Recording.from_array(recording)
    settings = checked_settings(
        recording.shape,
        recording.readout_rate if readout_rate is None else readout_rate,
        recording.white_rate if white_rate is None else white_rate,
        recording.bad_pixels if bad_pixels is None else bad_pixels,
    )
    recording = dataclasses.replace(recording, **settings)
    if ending == ".dat":
        bits = recording.width if row_bits is None else row_bits
        _check_flat(file, recording, bits)
    with _replacing(file) as part:
        if ending == ".dat":
            _write_flat(part, recording, row_layout(recording.width, bits), flip is None or bool(flip))
        elif ending == ".npy":
            with part.open("wb") as stream:
                _write_spikes(stream, recording)
        elif ending == ".npz":
            _write_npz(part, recording)
        else:
            _write_hdf5(part, recording)
    return file


@contextmanager
def _replacing(file: Path) -> Iterator[Path]:
    """A temporary name beside `file`, renamed to it at the end, or removed if anything went wrong."""
    part = file.with_name(f".{file.name}.{secrets.token_hex(4)}.part")
    try:
        yield part
        os.replace(part, file)
    finally:
        part.unlink(missing_ok=True)


def _check_flat(file: Path, recording: Recording, row_bits: int) -> None:
    size = (recording.width, recording.height)
    if row_bits < recording.width:
        raise InputError(
            f"row_bits={row_bits} is less than the {recording.width} columns of the recording: it is the length of a "
            f"row in the file, padding included."
        )
    known = known_sizes(file)
    if known and set(known) != {size}:
        raise InputError(
            f"{file} would be read back as frames of {' or '.join(show_size(other) for other in sorted(known))}, by "
            f"its name or config.yaml, but the recording is {show_size(size)}: put that into the name."
        )


def _chunks(recording: Recording) -> Iterator[UInt8[np.ndarray, "n h w"]]:
    step = max(1, _CHUNK_BYTES // (recording.height * recording.width))
    for start in range(0, recording.frames, step):
        yield recording.window(start, min(start + step, recording.frames))


def _write_flat(part: Path, recording: Recording, layout: FlatLayout, flipped: bool) -> None:
    with part.open("wb") as stream:
        for frames in _chunks(recording):
            stream.write(pack(frames, layout, flipped).tobytes())


def _write_spikes(stream: IO[bytes] | BufferedIOBase, recording: Recording) -> None:
    """The spikes as a `.npy` stream."""
    header = {"descr": "|u1", "fortran_order": False, "shape": recording.shape}
    np.lib.format.write_array_header_1_0(stream, header)
    for frames in _chunks(recording):
        stream.write(frames.tobytes())


def _write_npz(part: Path, recording: Recording) -> None:
    # By hand because np.savez_compressed takes ten times as long for a file a third smaller (level 6), and needs all
    # spikes at once. One byte a pixel and not packed bits, so that np.load(path)["spikes"] is all anyone needs to read
    # it.
    with zipfile.ZipFile(part, "x", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("spikes.npy", "w", force_zip64=True) as member:
            _write_spikes(member, recording)
        for name, value in _extras(recording).items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)


def _write_hdf5(part: Path, recording: Recording) -> None:
    frames, height, width = recording.shape
    with h5py.File(part, "x") as file:
        # Chunks of a few frames, so that a window reads little more than itself.
        stored = file.create_dataset(
            "raw_spike",
            recording.shape,
            np.uint8,
            chunks=(min(frames, 8), height, width),
            compression="gzip",
            compression_opts=1,
        )
        start = 0
        for window in _chunks(recording):
            stored[start : start + len(window)] = window
            start += len(window)
        extras = _extras(recording)
        mask = extras.pop("bad_pixels", None)
        stored.attrs.update(extras)
        if mask is not None:
            file.create_dataset("bad_pixels", data=mask)


def _extras(recording: Recording) -> dict[str, Any]:
    extras = {name: getattr(recording, name) for name in ("white_rate", "readout_rate", "bad_pixels")}
    return {name: value for name, value in extras.items() if value is not None}
