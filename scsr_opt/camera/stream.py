"""Frames of a camera's pipe: read as they come, and only the newest of them held.

A stream has no end that is known before it comes and nothing in it can be read twice. So what a picture needs is held
in blocks that are never written to again: a recording of the frames around a key frame shares them, and stays readable
while newer blocks come and old ones are let go.
"""

import dataclasses
import fcntl
import math
import os
import select
import tempfile
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from scsr_opt.camera.flat import ROWS_WITH_GAPS, parse_size, row_layout
from scsr_opt.camera.formats import read_recording
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.sources import FlatLayout, PackedSource
from scsr_opt.errors import InputError

# Frames, at least, that are waited for to see how rows lie in them; from so many a file's content is judged, too.
_BEGINNING_FRAMES = 128
# Frames of a block: a multiple of eight, so that a block begins on a whole byte whatever the layout. More bytes at once
# cost fewer calls; more frames at once, delay.
_EIGHT, _BLOCK_FRAMES, _BLOCK_BYTES = 8, 32, 1 << 18
# Bytes that a pipe may hold while nobody reads: as many as Linux lets a user ask for.
_PIPE_BYTES = 1 << 20
# Seconds after which a stream that is quiet sees that it was closed.
_PATIENCE = 0.2


class Block(NamedTuple):
    """Consecutive frames: the number of the first one, their packed bytes, and when the last of them arrived, by
    `time.monotonic`."""

    start: int
    content: UInt8[np.ndarray, " bytes"]
    arrived: float


@dataclass(frozen=True, eq=False)
class HeldSource(PackedSource):
    """The newest frames of a stream.

    **Fields:** `blocks` that are held, without gaps; `shape`: (T, h, w) of the stream until now, of which frames before
    the first block cannot be read any more.
    """

    blocks: tuple[Block, ...]
    shape: tuple[int, int, int]
    layout: FlatLayout
    flipped: bool

    def packed(self, start: int, stop: int) -> UInt8[np.ndarray, " bytes"]:
        needed = [
            block
            for block, after in zip(self.blocks, (*self.blocks[1:], None), strict=True)
            if block.start < stop and (after is None or after.start > start)
        ]
        if not needed or needed[0].start > start:
            raise InputError(f"Frame {start} of the stream is not held any more: it holds those from {self.first} on.")
        bits = self.layout.frame_bits(self.shape[1])
        first = needed[0].start * bits // 8
        content = np.concatenate([block.content for block in needed])
        return content[start * bits // 8 - first : math.ceil(stop * bits / 8) - first]

    @property
    def first(self) -> int:
        """The first frame that can be read."""
        return self.blocks[0].start


class FrameStream:
    """Packed frames from a file descriptor; made by `open_stream`, and read by one thread.

    **Fields:**
    - `recording`: what is known of the camera; its spikes are those of the beginning.
    - `frames`: whole frames until now.
    - `cut`: bytes at the end that are no whole frame; 0 until then.
    - `fault`: why reading failed; None where the stream simply ended.
    """

    def __init__(self, descriptor: int, recording: Recording, begin: bytes):
        assert isinstance(recording.source, PackedSource)
        self.recording = recording
        self.frames = self.cut = 0
        self.fault: OSError | None = None
        self._descriptor, self._begin, self._closed = descriptor, memoryview(begin), threading.Event()
        self._layout, self._flipped = recording.source.layout, recording.source.flipped
        eight = _EIGHT * self._layout.frame_bits(recording.height) // 8
        number = min(max(_BLOCK_BYTES // eight, 1), _BLOCK_FRAMES // _EIGHT)
        self.block_frames = number * _EIGHT
        """Frames that are read at once."""
        self._block_bytes = number * eight
        self._blocks: deque[Block] = deque()

    def read(self, hold: int) -> bool:
        """Reads the next block and lets go of those that the newest `hold` frames do not need; False at the end."""
        content = np.empty(self._block_bytes, np.uint8)
        length = self._fill(content.data)
        height = self.recording.height
        frames = self._layout.frames(length, height)
        if frames:
            self._blocks.append(Block(self.frames, content[:length], time.monotonic()))
            self.frames += frames
        while len(self._blocks) > 1 and self._blocks[1].start <= self.frames - hold:
            self._blocks.popleft()
        if length < len(content):
            self.cut = self._layout.rest(length, height)
            return False
        return True

    def held(self) -> Recording:
        """The recording until now, of which only the frames that are held can be read."""
        shape = (self.frames, self.recording.height, self.recording.width)
        source = HeldSource(tuple(self._blocks), shape, self._layout, self._flipped)
        return dataclasses.replace(self.recording, source=source)

    def arrived(self, frame: int) -> float:
        """When a frame that is held arrived, by `time.monotonic`."""
        return next(block.arrived for block in reversed(self._blocks) if block.start <= frame)

    def close(self) -> None:
        """Ends a `read` that waits in another thread. The descriptor stays open, as it is the caller's."""
        self._closed.set()

    def _fill(self, block: memoryview) -> int:
        """Fills a block from the stream, and returns the number of bytes; less than all at the end."""
        length = min(len(self._begin), len(block))
        block[:length] = self._begin[:length]
        self._begin = self._begin[length:]
        try:
            while length < len(block) and not self._closed.is_set():
                if select.select([self._descriptor], [], [], _PATIENCE)[0]:
                    count = os.readv(self._descriptor, [block[length:]])
                    if count == 0:
                        break
                    length += count
        except OSError as error:
            self.fault = error
        return length


def open_stream(descriptor: int, *, size: Any, row_bits: int | None = None, **known: Any) -> FrameStream:
    """A stream of packed frames, as in a `.dat` file, from a pipe or anything else that can be read.

    **Arguments:** `descriptor`: of a file that is open for reading, 0 for standard input; `size`, `row_bits` and the
    others: as of `read_recording` for a `.dat` file. Where rows have bits that are no pixels is found from the first
    frames, which are waited for.

    **Raises:** `InputError` as `read_recording`, without a `size`, if nothing can be read, or if the stream ends before
    a whole frame.
    """
    if size is None:
        raise InputError("A stream does not hold the size of its frames: give it as size, WIDTHxHEIGHT in pixels.")
    width, height = parse_size(size)
    usual, gapped = row_layout(width, row_bits or width), ROWS_WITH_GAPS.get(width)
    lengths = [layout.frame_bits(height) // 8 for layout in (usual, gapped) if layout is not None]
    # A length that fits both: only content tells then.
    wanted = math.lcm(*lengths)
    begin = _read_begin(descriptor, wanted * math.ceil(_BEGINNING_FRAMES * max(lengths) / wanted))
    if len(begin) < lengths[0]:
        raise InputError(
            f"The stream ended after {len(begin):,} bytes, before its first frame of {width}x{height} "
            f"({lengths[0]:,} bytes): check the size, and what writes to the pipe."
        )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "stream.dat"
        file.write_bytes(begin)
        try:
            recording = read_recording(file, size=(width, height), row_bits=row_bits, **known)
        except InputError as error:
            raise InputError(str(error).replace(str(file), "The stream")) from error
    assert isinstance(recording.source, PackedSource)
    block = Block(0, np.frombuffer(begin, np.uint8), time.monotonic())
    source = HeldSource((block,), recording.shape, recording.source.layout, recording.flipped)
    return FrameStream(descriptor, dataclasses.replace(recording, source=source), begin)


def _read_begin(descriptor: int, length: int) -> bytes:
    """The first bytes of a stream; fewer where it ends before."""
    try:
        fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    except (AttributeError, OSError):
        pass  # no pipe, or another system
    begin = bytearray()
    try:
        while len(begin) < length and (some := os.read(descriptor, length - len(begin))):
            begin += some
    except OSError as error:
        raise InputError(f"The stream cannot be read: {(error.strerror or str(error)).lower()}.") from error
    return bytes(begin)
