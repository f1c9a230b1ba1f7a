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

import h5py
import numpy as np
from jaxtyping import Shaped, UInt8

from scsr_opt.errors import InputError

DAMAGED = (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError)
"""What the readers of numpy (it parses a header as Python), zipfile and h5py raise on a damaged file."""


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
        """Of an array (T, h, w) with any strides, 0 and 1 already checked."""
        return cls(pack(array, array.shape[2], flipped=False), checked_shape(array.shape, "The array"))


@dataclass(frozen=True)
class FlatSource(SpikeSource):
    """A flat file: packed frames one after another, no header.

    A frame is ceil(h·row_bits / 8) bytes, row-major; within a byte the least significant bit is the leftmost pixel.
    Each row has `row_bits` ≥ w bits, of which the last row_bits − w are padding. `flipped`: the bottom row comes first.
    """

    path: Path
    shape: tuple[int, int, int]
    row_bits: int
    flipped: bool

    @property
    def frame_bytes(self) -> int:
        return frame_bytes(self.shape[1], self.row_bits)

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        _, height, width = self.shape
        count, size = stop - start, self.frame_bytes
        try:
            packed = np.memmap(self.path, np.uint8, mode="r", offset=start * size, shape=(count, size))
        except DAMAGED as error:
            raise _lost(self.path, error) from error
        bits = np.unpackbits(packed, axis=1, count=height * self.row_bits, bitorder="little")
        rows = bits.reshape(count, height, self.row_bits)[:, :, :width]
        if self.flipped or self.row_bits != width:
            return _copied(rows, self.flipped)
        return rows


@dataclass(frozen=True)
class NpySource(SpikeSource):
    """A `.npy` file that holds (T, h, w), mapped; its values are checked as they are read."""

    path: Path
    shape: tuple[int, int, int]
    flipped: bool

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        try:
            stored = np.lib.format.open_memmap(self.path, mode="r")
        except DAMAGED as error:
            raise _lost(self.path, error) from error
        frames = as_spikes(np.asarray(stored[start:stop]), f"{self.path.name}, frames {start} to {stop - 1},")
        return _copied(frames, self.flipped)


@dataclass(frozen=True)
class Hdf5Source(SpikeSource):
    """The dataset `key` of an HDF5 file, (T, h, w); its values are checked as they are read."""

    path: Path
    key: str
    shape: tuple[int, int, int]
    flipped: bool

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        try:
            with h5py.File(self.path, "r") as file:
                stored = np.asarray(file[self.key][start:stop])  # pyright: ignore[reportIndexIssue]
        except DAMAGED as error:
            raise _lost(self.path, error) from error
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
        return (self.source.shape[0], self.height, self.width)

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        rows, columns = slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)
        return _copied(self.source.read(start, stop)[:, rows, columns], False)


def frame_bytes(height: int, row_bits: int) -> int:
    """Bytes of a packed frame. Frames begin on whole bytes: where h·row_bits is no multiple of 8, zero bits fill up."""
    return math.ceil(height * row_bits / 8)


def pack(frames: UInt8[np.ndarray, "n h w"], row_bits: int, flipped: bool) -> UInt8[np.ndarray, "n bytes"]:
    """Frames as the bytes of a flat file, one row of bytes a frame: the inverse of `FlatSource.read`."""
    count, height, width = frames.shape
    rows = frames[:, ::-1] if flipped else frames
    if row_bits != width:
        rows = np.pad(rows, ((0, 0), (0, 0), (0, row_bits - width)))
    return np.packbits(rows.reshape(count, height * row_bits), axis=1, bitorder="little")


def _copied(frames: UInt8[np.ndarray, "n h w"], flipped: bool) -> UInt8[np.ndarray, "n h w"]:
    return np.array(frames[:, ::-1] if flipped else frames, order="C", copy=True)


def _lost(path: Path, error: Exception) -> InputError:
    return InputError(
        f"{path} cannot be read ({error}): it is damaged, or was moved, cut short or replaced since it was opened; get "
        f"it anew and open it again with read_recording."
    )
