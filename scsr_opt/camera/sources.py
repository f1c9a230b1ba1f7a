"""Where the spikes of a recording lie, behind one question: "frames start … stop − 1, please".

A recording of one second at 250×400 is half a gigabyte packed and four unpacked, so nothing here holds more than it was
asked for. A source on disk remembers where its file is and what it looks like, and maps only the part it reads: no
handle stays open, a source can be pickled and handed to another process, and opening a huge file costs nothing.

All sources hand out uint8 arrays (n, h, w) of 0 and 1, freshly allocated and contiguous, top row first.
"""

import math
import tokenize
import zipfile
import zlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Shaped, UInt8

from scsr_opt.errors import InputError

DAMAGED = (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError)
"""Errors that the readers of numpy (it parses a header as Python), zipfile and h5py raise on a damaged file."""


def as_spikes(array: Shaped[np.ndarray, "..."], where: str) -> UInt8[np.ndarray, "..."]:
    """`array` as uint8 of 0 and 1, without a copy where it can be had; `where` names it in the error."""
    if array.dtype == np.bool_:
        return array.view(np.uint8)
    if array.dtype.kind not in "iu":
        raise InputError(
            f"{where} holds values of type {array.dtype}, but spikes are bool or integer, 0 or 1: convert it first, "
            f"for example with (array > 0)."
        )
    if array.size and (array.max() > 1 or array.min() < 0):
        raise InputError(
            f"{where} holds values from {array.min()} to {array.max()}, but a spike frame has only 0 and 1: it may "
            f"hold intensities or spike intervals, or packed bits (those are read from flat .dat files)."
        )
    return array.astype(np.uint8, copy=False)


def checked_shape(shape: tuple[int, ...], where: str) -> tuple[int, int, int]:
    """`shape` as (T, h, w), none of them zero."""
    if len(shape) != 3:
        raise InputError(
            f"{where} has {len(shape)} dimensions {shape}, but spikes have three, (frames, rows, columns): reshape it, "
            f"a single frame with array[None]."
        )
    if 0 in shape:
        raise InputError(f"{where} is empty, its shape is {shape}: at least one frame, row and column are needed.")
    return (int(shape[0]), int(shape[1]), int(shape[2]))


class SpikeSource(ABC):
    """Spikes of a known shape (T, h, w), read a window at a time."""

    shape: tuple[int, int, int]

    @abstractmethod
    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        """Frames `start` to `stop` − 1 as a new array; 0 ≤ start < stop ≤ T is the caller's care."""


@dataclass(frozen=True, eq=False)
class ArraySource(SpikeSource):
    """Spikes in memory, upright, one bit each: an eighth of the bytes they came in, so that a copy, which nobody else
    can write to, costs little beside the array that it is made of (`of`)."""

    packed: UInt8[np.ndarray, "T bytes"]
    shape: tuple[int, int, int]

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        _, height, width = self.shape
        bits = np.unpackbits(self.packed[start:stop], axis=1, count=height * width, bitorder="little")
        return bits.reshape(stop - start, height, width)

    @classmethod
    def of(cls, array: UInt8[np.ndarray, "T h w"]) -> "ArraySource":
        """A packed copy of an array (T, h, w) with any strides, 0 and 1 already checked."""
        shape = checked_shape(array.shape, "The array")
        return cls(np.packbits(array.reshape(shape[0], -1), axis=1, bitorder="little"), shape)


@dataclass(frozen=True)
class FlatLayout:
    """Where the pixels of a frame lie among the bits of a flat file.

    **Fields:**
    - `row_bits`: bits of a row, those that are no pixels included.
    - `segments`: (start, stop) of the runs of bits of a row that are its pixels, from left to right.
    - `aligned`: whether every frame begins on a whole byte, zero bits filling up the last one of the frame before.
    """

    row_bits: int
    segments: tuple[tuple[int, int], ...]
    aligned: bool = True

    @property
    def width(self) -> int:
        """Pixels of a row."""
        return sum(stop - start for start, stop in self.segments)

    def frame_bits(self, height: int) -> int:
        """Bits from the beginning of a frame of `height` rows to that of the next."""
        bits = height * self.row_bits
        return math.ceil(bits / 8) * 8 if self.aligned else bits

    def frames(self, length: int, height: int) -> int:
        """Whole frames of `height` rows in a file of `length` bytes."""
        return length * 8 // self.frame_bits(height)

    def rest(self, length: int, height: int) -> int:
        """Bytes of a file of `length` bytes that are left over after its whole frames."""
        bits = length * 8 % self.frame_bits(height)
        return math.ceil(bits / 8) if self.aligned else bits // 8

    def pixels(self, rows: Shaped[np.ndarray, "... row_bits"]) -> Shaped[np.ndarray, "... w"]:
        """Pixels of rows of bits: a view where they lie in one piece."""
        parts = [rows[..., start:stop] for start, stop in self.segments]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)

    def rows(self, frames: UInt8[np.ndarray, "n h w"]) -> UInt8[np.ndarray, "n h row_bits"]:
        """Rows of bits with these pixels, zeros between them."""
        if self.segments == ((0, self.row_bits),):
            return frames
        rows = np.zeros((*frames.shape[:2], self.row_bits), np.uint8)
        column = 0
        for start, stop in self.segments:
            rows[:, :, start:stop] = frames[:, :, column : column + stop - start]
            column += stop - start
        return rows


class PackedSource(SpikeSource):
    """Packed frames one after another, without a header.

    A frame is row-major; within a byte the least significant bit is the leftmost pixel. `layout` says which bits are
    pixels. `flipped`: the bottom row comes first.
    """

    layout: FlatLayout
    flipped: bool

    @abstractmethod
    def packed(self, start: int, stop: int) -> UInt8[np.ndarray, "bytes"]:
        """Bytes that hold frames `start` to `stop` − 1, from the one in which frame `start` begins to the one in which
        the last frame ends."""

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        height, row_bits = self.shape[1], self.layout.row_bits
        rows = self.bits(start, stop)[:, : height * row_bits].reshape(stop - start, height, row_bits)
        pixels = self.layout.pixels(rows)
        if self.flipped or not pixels.flags.c_contiguous:
            return _copied(pixels, self.flipped)
        return pixels

    def bits(self, start: int, stop: int) -> UInt8[np.ndarray, "n bits"]:
        """All bits of frames `start` to `stop` − 1, as they are packed."""
        count = self.layout.frame_bits(self.shape[1])
        bits = np.unpackbits(self.packed(start, stop), bitorder="little")
        skipped = start * count % 8
        return bits[skipped : skipped + (stop - start) * count].reshape(stop - start, count)


@dataclass(frozen=True)
class FlatSource(PackedSource):
    """A flat file, mapped."""

    path: Path
    shape: tuple[int, int, int]
    layout: FlatLayout
    flipped: bool

    def packed(self, start: int, stop: int) -> UInt8[np.ndarray, "bytes"]:
        count = self.layout.frame_bits(self.shape[1])
        first = start * count // 8
        length = math.ceil(stop * count / 8) - first
        try:
            return np.memmap(self.path, np.uint8, mode="r", offset=first, shape=(length,))
        except DAMAGED as error:
            raise _lost(self.path, error) from error


@dataclass(frozen=True)
class NpySource(SpikeSource):
    """A `.npy` file that holds (T, h, w), or (h, w, T) if `time_last`, mapped; values are checked as they are read."""

    path: Path
    shape: tuple[int, int, int]
    flipped: bool
    time_last: bool

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        try:
            stored = np.lib.format.open_memmap(self.path, mode="r")
        except DAMAGED as error:
            raise _lost(self.path, error) from error
        window = np.asarray(frames_of(stored, start, stop, self.time_last))
        frames = as_spikes(window, f"{self.path.name}, frames {start} to {stop - 1},")
        return _copied(frames, self.flipped)


@dataclass(frozen=True)
class Hdf5Source(SpikeSource):
    """The dataset `key` of an HDF5 file, (T, h, w), or (h, w, T) if `time_last`; values are checked when read."""

    path: Path
    key: str
    shape: tuple[int, int, int]
    flipped: bool
    time_last: bool

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        try:
            with h5py.File(self.path, "r") as file:
                stored = np.asarray(frames_of(file[self.key], start, stop, self.time_last))
        except DAMAGED as error:
            raise hdf5_fault(self.path, error) or _lost(self.path, error) from error
        frames = as_spikes(stored, f"{self.path.name}, dataset {self.key!r}, frames {start} to {stop - 1},")
        return _copied(frames, self.flipped)


@dataclass(frozen=True)
class CroppedSource(SpikeSource):
    """A rectangle of another source."""

    source: SpikeSource
    top: int
    left: int
    height: int
    width: int

    @property
    def shape(self) -> tuple[int, int, int]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """(frames, rows, columns) of the part."""
        return (self.source.shape[0], self.height, self.width)

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        rows, columns = slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)
        return _copied(self.source.read(start, stop)[:, rows, columns], False)


def frames_of(stored: Any, start: int, stop: int, time_last: bool) -> Any:
    """Frames `start` to `stop` − 1 of an array or dataset, time first."""
    return np.moveaxis(stored[:, :, start:stop], -1, 0) if time_last else stored[start:stop]


def pack(frames: UInt8[np.ndarray, "n h w"], layout: FlatLayout, flipped: bool) -> UInt8[np.ndarray, "n bytes"]:
    """Frames as the bytes of an aligned flat file, one row of bytes a frame: the inverse of `FlatSource.read`."""
    count, height, _ = frames.shape
    rows = layout.rows(frames[:, ::-1] if flipped else frames)
    return np.packbits(rows.reshape(count, height * layout.row_bits), axis=1, bitorder="little")


def hdf5_fault(path: Path, error: Exception) -> InputError | None:
    """Meaning of h5py's `error` where the file itself is not to blame; None for all others."""
    text = str(error).lower()
    # Not any "lock": what is said of a file cut short speaks of its superblock.
    if "unable to lock file" in text:
        return InputError(
            f"{path} is locked, another program has it open for writing: close it there, or set the environment "
            f"variable HDF5_USE_FILE_LOCKING=FALSE if it only stayed locked."
        )
    if "already open for" in text:
        return InputError(
            f"{path} is open for writing, or was not closed by the program that wrote it: close it there, or, if that "
            f"has ended, run h5clear -s on it."
        )
    if "plugin" in text or ("filter" in text and ("not registered" in text or "not available" in text)):
        return InputError(
            f"{path} is compressed with a filter that is not installed here ({error}): install it (pip install "
            f"hdf5plugin, and import hdf5plugin first), or rewrite the file with h5repack -f GZIP=1."
        )
    return None


def _copied(frames: UInt8[np.ndarray, "n h w"], flipped: bool) -> UInt8[np.ndarray, "n h w"]:
    return np.array(frames[:, ::-1] if flipped else frames, order="C", copy=True)


def _lost(path: Path, error: Exception) -> InputError:
    return InputError(
        f"{path} cannot be read ({error}): it is damaged, or was moved, cut short or replaced since it was opened; get "
        f"it anew and open it again with read_recording."
    )
