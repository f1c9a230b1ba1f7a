"""Pictures of a stream while it comes: of every N-th frame, or of as many of these as the solve keeps up with.

One thread reads. Whenever all frames that a key frame needs are there, it waits to be solved for, in the place of the
one that waited before: that one is dropped. So a picture is late by at most the rest of one solve and its own, and
memory holds the frames around three key frames, however long the stream. A picture is solved for alone, from nothing
but those frames: it must not depend on which others were dropped, as that depends on the machine's speed.
"""

import csv
import os
import shutil
import statistics
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, SupportsFloat, SupportsIndex, runtime_checkable

from scsr_opt._files import as_path, check_writable
from scsr_opt._kernels.memory import give_memory_back
from scsr_opt._validation import whole
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.stream import FrameStream
from scsr_opt.camera.white import White
from scsr_opt.errors import InputError
from scsr_opt.pipeline.options import Options
from scsr_opt.pipeline.reconstruct import reconstruct
from scsr_opt.pipeline.solution import Solution
from scsr_opt.progress import NoProgress, Progress, check_progress
from scsr_opt.report.pictures import PictureFormat
from scsr_opt.sequences.outputs import COLUMNS, IMAGES, STILLS, TABLE, SequenceFormat, row_of
from scsr_opt.sequences.store import Picture

# Newest pictures whose delays are kept, for their median.
_DELAYS = 1000
# Seconds after which Python hands over to a thread that waits; 0.005 by default. The thread that reads needs a moment
# of Python for each part of a block, and a pipe is full after 4 ms of 20,000 frames of 400×250 per second. Beside a
# thread that is always in Python, on one core that other programs share, 2,700 frames were read per second with 0.005,
# 28,000 with 0.001 and 100,000 with 0.0005.
_SWITCH_INTERVAL = 0.0005


@runtime_checkable
class LiveOutput(Protocol):
    """What the pictures of a stream are written to."""

    def write(self, number: int, solution: Solution) -> None:
        """Writes a picture, whole or not at all; the key frame is the `number`-th. A solve may have failed."""
        ...


class LiveFolder:
    """A folder as `SequenceFormat` has it, which is written picture by picture: `images/`, and `times.csv`, which gets
    a row as soon as a picture is there. Key frames that were dropped are not in it.

    **Raises:** `InputError` if `path` has an ending, or is there already and may not be overwritten.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        bits: int | None = None,
        gamma: float | None = None,
        overwrite: bool = False,
    ):
        if as_path(path).suffix:
            raise InputError(
                f"A stream cannot be written to {path}, as nobody knows how long it gets: name a folder (without an "
                f"ending) for its pictures, or ask for the latest alone (a .png, .tif or .npz)."
            )
        self._format = SequenceFormat.of(path, bits=bits, gamma=gamma)
        self._format.check(overwrite)
        self._overwrite, self._begun = overwrite, False

    def write(self, number: int, solution: Solution) -> None:
        """As `LiveOutput`. **Raises:** `InputError` if it cannot be written."""
        folder, bits = self._format.path, self._format.bits
        # Ten digits: three days at 40,000 frames per second.
        name = f"{solution.key:010d}{STILLS[bits]}" if solution.status.usable else None
        seconds = solution.key / solution.recording.readout_rate
        row = row_of(Picture(number, solution.key, seconds, solution.status, solution.key), name)
        try:
            if not self._begun:
                if self._overwrite:
                    shutil.rmtree(folder / IMAGES, ignore_errors=True)
                    (folder / TABLE).unlink(missing_ok=True)
                folder.mkdir(exist_ok=self._overwrite)
                (folder / IMAGES).mkdir()
            if name is not None:
                solution.save(folder / IMAGES / name, bits=bits, gamma=self._format.gamma)
            with open(folder / TABLE, "a", newline="", encoding="utf-8") as file:
                rows = csv.writer(file, lineterminator="\n")
                rows.writerows([row] if self._begun else [COLUMNS, row])
        except OSError as error:
            raise InputError(f"Cannot write {folder}: {(error.strerror or str(error)).lower()}.") from error
        self._begun = True


class LatestPicture:
    """One picture file, which the newest picture replaces: who opens it sees the one before or the new one, whole.

    **Raises:** `InputError` if `path` has not the ending of a picture, or is there already and may not be overwritten.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, bits: int | None = None, gamma: float = 1.0, overwrite: bool = False
    ):
        PictureFormat.of(path, bits=bits, gamma=gamma)
        check_writable(path)
        self._path, self._bits, self._gamma = as_path(path), bits, gamma
        if self._path.exists() and not overwrite:
            raise InputError(f"{path} is there already: give --overwrite to replace it, or another name.")

    def write(self, number: int, solution: Solution) -> None:
        """As `LiveOutput`. **Raises:** `InputError` if it cannot be written."""
        if solution.status.usable:
            solution.save(self._path, bits=self._bits, gamma=self._gamma)


class _Moment(NamedTuple):
    """A key frame, the recording that holds the frames it needs, and when the key frame arrived (`time.monotonic`)."""

    key: int
    recording: Recording
    arrived: float


class _Newest:
    """Hands key frames from one thread to another: the newest one; one that was not taken before is dropped."""

    def __init__(self):
        self._changed = threading.Condition()
        self._waiting: _Moment | None = None
        self._ended = False
        self.dropped = 0

    def put(self, moment: _Moment) -> None:
        with self._changed:
            self.dropped += self._waiting is not None
            self._waiting = moment
            self._changed.notify()

    def end(self) -> None:
        """No more come; the one that waits may still be taken."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    def __iter__(self) -> Iterator[_Moment]:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None or self._ended)
                moment, self._waiting = self._waiting, None
            if moment is None:
                return
            yield moment


class LiveSequence:
    """Pictures of every `every`-th frame of a stream, as many as the solve keeps up with.

    A picture is that of `reconstruct(recording, key=…)` of all of the stream, bit for bit. The last key frame always
    comes out.

    **Arguments:**
    - `stream`: see `open_stream`. `output`: gets the pictures.
    - `every`, `start`: frames from one key frame to the next, and the first one; `stop`: frame before which key frames
      end, the end of the stream if None.
    - `white`: intensity that 8-bit pictures show as white; that of the first picture if None.
    - `scale`, `options`, `changes`: as of `reconstruct`.

    **Fields:** what came of it until now, also where `run` was interrupted.
    - `written`, `failed`: number of pictures that were written, and whose solve failed.
    - `first`, `last`: key frames of the first and the last picture; None where there is none.
    - `failure`: a clause on why the last one of those failed; None where none did.
    - `dropped_before`: key frames that were dropped before the first picture, while programs were compiled.
    - `longest`: the longest delay, seconds.

    **Raises:** `InputError` for what cannot be used.
    """

    def __init__(
        self,
        stream: FrameStream,
        output: LiveOutput,
        *,
        scale: SupportsIndex,
        every: SupportsIndex,
        start: SupportsIndex = 0,
        stop: SupportsIndex | None = None,
        white: SupportsFloat | None = None,
        options: Options | None = None,
        **changes: Any,
    ):
        self.stream, self._output = stream, output
        self._scale, self._every = whole(scale, "scale", 1), whole(every, "every", 1)
        self._start = whole(start, "start", 0)
        self._stop = None if stop is None else whole(stop, "stop", self._start + 1)
        self._options = Options.of(options, changes)
        self._most = self._options.validated(stream.recording, self._scale).most_frames
        self.white = None if white is None else White.given(float(white))
        self._newest = _Newest()
        self._fault: BaseException | None = None
        self._delays: deque[float] = deque(maxlen=_DELAYS)
        self.written = self.failed = self.dropped_before = 0
        self.longest = 0.0
        self.first: int | None = None
        self.last: int | None = None
        self.failure: str | None = None
        self._behind = False  # whether it was said that the solve does not keep up

    @property
    def dropped(self) -> int:
        """Key frames that were dropped, as newer ones came while others were solved for."""
        return self._newest.dropped

    @property
    def delay(self) -> float:
        """Seconds from the arrival of a key frame until its picture was written, the median of the last 1,000."""
        return statistics.median(self._delays) if self._delays else 0.0

    def run(self, progress: Progress | None = None) -> None:
        """Writes pictures until the stream ends. Where the solve begins not to keep up, there is a warning.

        **Raises:** `InputError` if a picture cannot be written, where those before are there; or if the stream ends
        before the first key frame.
        """
        check_progress(progress)
        meter = NoProgress() if progress is None else progress
        reader = threading.Thread(target=self._read, name="scsr-stream", daemon=True)
        interval = sys.getswitchinterval()
        sys.setswitchinterval(min(interval, _SWITCH_INTERVAL))
        meter.start(None, "Solving")
        reader.start()
        try:
            for moment in self._newest:
                self._solve(moment)
                meter.advance(1)
        finally:
            self.stream.close()
            reader.join()
            meter.finish()
            sys.setswitchinterval(interval)
        if self._fault is not None:
            raise self._fault
        if self.stream.frames <= self._start:
            raise InputError(
                f"The stream ended after {self.stream.frames} frames, before the first key frame, {self._start}: no "
                f"picture was written."
            )

    def _solve(self, moment: _Moment) -> None:
        solution = reconstruct(moment.recording, scale=self._scale, key=moment.key, options=self._options)
        if solution.status.usable:
            self.white = self.white or solution.white
            solution = replace(solution, white=self.white)
        self._output.write((moment.key - self._start) // self._every, solution)
        give_memory_back()
        if not solution.status.usable:
            self.failed, self.failure = self.failed + 1, solution.status.clause
            return
        seconds = time.monotonic() - moment.arrived
        self._delays.append(seconds)
        self.longest = max(self.longest, seconds)
        if self.first is None:
            self.first, self.dropped_before = moment.key, self.dropped
        elif not self._behind and self.dropped > self.dropped_before:
            self._behind = True
            warnings.warn(
                "The solve does not keep up with the stream, and key frames are dropped: take a larger every, a "
                "smaller scale, or a crop.",
                stacklevel=3,
            )
        self.written, self.last = self.written + 1, moment.key

    def _read(self) -> None:
        """Reads the stream to its end, and hands over each key frame as soon as the frames that it needs are there. At
        the end, frames after the last ones are not waited for."""
        hold = self._most + self.stream.block_frames + 2
        key = self._start
        more = True
        try:
            while more and (self._stop is None or key < self._stop):
                more = self.stream.read(hold)
                while (self._stop is None or key < self._stop) and self._complete(key, ended=not more):
                    self._newest.put(_Moment(key, self.stream.held(), self.stream.arrived(key)))
                    key += self._every
        except BaseException as error:
            self._fault = error
        finally:
            self._newest.end()

    def _complete(self, key: int, *, ended: bool) -> bool:
        """Whether all frames that a key frame needs are there: half of `most_frames` after it, or, where it is so early
        that frames before are missing, as many in all."""
        frames = self.stream.frames
        return key < frames and (ended or frames >= max(key + self._most // 2 + 1, self._most))
