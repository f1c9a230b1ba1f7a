"""Recordings into files.

Everything is written under a temporary name in the same folder and renamed when it is complete, so a file with the
final name is a whole one, whatever happens in between. Frames are read and written a chunk at a time.
"""

import dataclasses
import io
import os
import zipfile
from collections.abc import Iterator
from io import BufferedIOBase
from pathlib import Path
from typing import IO, Any, SupportsFloat

import h5py
import numpy as np
from jaxtyping import UInt8

from scsr_opt._files import as_path, check_writable, read_meanwhile, whole_file
from scsr_opt._validation import flag, whole
from scsr_opt.camera.flat import known_sizes, row_layout, show_size
from scsr_opt.camera.recording import Recording, checked_settings
from scsr_opt.camera.sources import FlatLayout, pack
from scsr_opt.errors import InputError

ENDINGS = (".dat", ".npy", ".npz", ".h5", ".hdf5")

_CHUNK_BYTES = 32 << 20
# Frames that HDF5 compresses together: few, so that a window reads little more than itself.
_HDF5_FRAMES = 8


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
    - `path`: ends in `.dat`, `.npy`, `.npz`, `.h5` or `.hdf5`; a file of that name is replaced, as by `numpy.save`.
    - `recording`: a `Recording`, or an array (T, h, w) of 0 and 1, upright.
    - `flip`: `.dat` only: store the rows bottom-up as cameras do (the default), or top-down.
    - `row_bits`: `.dat` only: length of a row in the file, at least the width; the bits that are no pixels are zero. By
      default the width.
    - `white_rate`, `readout_rate`, `bad_pixels`: if given, instead of the recording's.

    **Returns:** the path.

    **Raises:** `InputError` if the ending is not known, the file cannot be written, the recording is not one, or `path`
    is a `.dat` that would be read back with another size.
    """
    file = as_path(path)
    flip = None if flip is None else flag(flip, "flip")
    row_bits = None if row_bits is None else whole(row_bits, "row_bits", 1)
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
    check_writable(file)
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
    with whole_file(file) as part:
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


def _chunks(recording: Recording, multiple: int = 1) -> Iterator[UInt8[np.ndarray, "n h w"]]:
    """All frames, at each step a number of them that is divisible by `multiple`."""
    step = max(1, _CHUNK_BYTES // (recording.height * recording.width * multiple)) * multiple
    starts = range(0, recording.frames, step)
    return read_meanwhile(recording.window(start, min(start + step, recording.frames)) for start in starts)


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
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("spikes.npy", "w", force_zip64=True) as member:
            _write_spikes(member, recording)
        for name, value in _extras(recording).items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)


def _write_hdf5(part: Path, recording: Recording) -> None:
    frames, height, width = recording.shape
    with _HDF5File(part, "r+") as stored_in:
        # No cache of chunks, so that a disk is found full while frames are written, not after the last.
        with h5py.File(stored_in, "w", rdcc_nbytes=0) as file:
            stored = file.create_dataset(
                "raw_spike",
                recording.shape,
                np.uint8,
                chunks=(min(frames, _HDF5_FRAMES), height, width),
                compression="gzip",
                compression_opts=1,
            )
            start = 0
            for window in _chunks(recording, _HDF5_FRAMES):
                stored[start : start + len(window)] = window
                start += len(window)
                if stored_in.error is not None:
                    break
            extras = _extras(recording)
            mask = extras.pop("bad_pixels", None)
            stored.attrs.update(extras)
            if mask is not None:
                file.create_dataset("bad_pixels", data=mask)


class _HDF5File(io.FileIO):
    """A file for h5py that raises what was wrong with writing at the end of its `with` block, and not before.

    HDF5 does not get over a write that fails: closing the file then ends the whole process.
    """

    error: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data)
        while len(left) and self.error is None:
            try:
                left = left[super().write(left) :]
            except OSError as error:
                self.error = error
        return len(data)

    def __exit__(self, *_: Any) -> None:
        self.close()
        if self.error is not None:
            raise self.error


def _extras(recording: Recording) -> dict[str, Any]:
    extras = {name: getattr(recording, name) for name in ("white_rate", "readout_rate", "bad_pixels")}
    return {name: value for name, value in extras.items() if value is not None}
