"""Frames of a pipe: the same as those of a `.dat` file, and only the newest are held."""

import os
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from scsr_opt import InputError, Recording
from scsr_opt.camera import read_recording
from scsr_opt.camera.sources import pack
from scsr_opt.camera.stream import FrameStream, HeldSource, open_stream


@pytest.fixture
def piped() -> Iterator[Callable[[bytes], int]]:
    """A function that makes a pipe, and writes content into it in pieces of odd lengths; returns the end to read."""
    ends: list[int] = []
    writers: list[threading.Thread] = []

    def make(content: bytes) -> int:
        reading, writing = os.pipe()
        ends.append(reading)

        def write() -> None:
            view = memoryview(content)
            try:
                for start in range(0, len(view), 1237):
                    os.write(writing, view[start : start + 1237])
            except BrokenPipeError:
                pass
            os.close(writing)

        writers.append(threading.Thread(target=write))
        writers[-1].start()
        return reading

    yield make
    for end in ends:
        os.close(end)
    for writer in writers:
        writer.join()


def steady(frames: int, height: int, width: int) -> np.ndarray:
    """Pixels that fire as those of a camera do, each at a rate of its own."""
    rate = np.random.default_rng(1).uniform(0.1, 0.6, (height, width))
    return np.diff(np.floor(np.arange(frames + 1)[:, None, None] * rate), axis=0).astype(np.uint8)


def packed(spikes: np.ndarray, row_bits: int, flipped: bool = True) -> bytes:
    from scsr_opt.camera.flat import row_layout

    return pack(spikes, row_layout(spikes.shape[2], row_bits), flipped).tobytes()


CASES = {
    "usual": (packed(steady(300, 8, 12), 12), "12x8", {}),
    "top-down": (packed(steady(300, 8, 12), 12, flipped=False), "12x8", {"flip": False}),
    "filled up": (packed(steady(300, 7, 9), 9), "9x7", {}),
    "padded, found": (packed(steady(200, 6, 400), 416), "400x6", {}),
    "padded, given": (packed(steady(300, 8, 12), 16), "12x8", {"row_bits": 16}),
}


@pytest.mark.filterwarnings("ignore:stream.dat. frames of 9x7 are taken")
@pytest.mark.parametrize("case", CASES)
def test_held_frames_are_those_of_a_file(tmp_path, piped, case):
    content, size, given = CASES[case]
    (tmp_path / "a.dat").write_bytes(content)
    recording = read_recording(tmp_path / "a.dat", size=size, **given)
    stream = open_stream(piped(content), size=size, **given)
    assert stream.recording.flipped == recording.flipped and stream.recording.shape[1:] == recording.shape[1:]
    more, hold = True, 70
    while more:
        more = stream.read(hold)
        held = stream.held()
        assert isinstance(held.source, HeldSource)
        first = held.source.first
        assert held.frames == stream.frames and stream.frames - first < hold + stream.block_frames
        assert first <= max(0, stream.frames - hold)
        for start, stop in ((first, held.frames), (held.frames - 3, held.frames - 1), (first + 5, first + 6)):
            np.testing.assert_array_equal(held.window(start, stop), recording.window(start, stop))
        if first > 0:
            with pytest.raises(InputError, match=f"Frame {first - 1} of the stream is not held any more"):
                held.window(first - 1, held.frames)
    assert stream.frames == recording.frames and stream.cut == 0 and stream.fault is None


def test_held_recording_stays_as_newer_frames_come(piped):
    spikes = steady(2000, 8, 12)
    stream = open_stream(piped(packed(spikes, 12)), size="12x8")
    stream.read(40)
    early = stream.held()
    while stream.read(40):
        pass
    np.testing.assert_array_equal(early.window(3, early.frames), spikes[3 : early.frames])
    np.testing.assert_array_equal(early.crop(2, 3, 4, 5).window(3, 9), spikes[3:9, 2:6, 3:8])


@pytest.mark.parametrize("rest", [1, 5, 11])
def test_a_stream_that_ends_inside_a_frame_has_the_whole_ones(piped, rest):
    spikes = steady(333, 8, 12)
    stream = open_stream(piped(packed(spikes, 12) + bytes(rest)), size="12x8")
    while stream.read(50):
        pass
    assert stream.frames == 333 and stream.cut == rest
    np.testing.assert_array_equal(stream.held().window(300, 333), spikes[300:])


def test_a_stream_that_breaks_off_has_what_came_before(piped, monkeypatch):
    stream = open_stream(piped(packed(steady(300, 8, 12), 12)), size="12x8")

    def broken(*_):
        raise ConnectionResetError(104, "Connection reset by peer")

    monkeypatch.setattr(os, "readv", broken)
    while stream.read(50):
        pass
    assert isinstance(stream.fault, ConnectionResetError) and stream.frames >= 128


def test_closing_ends_a_read_that_waits(recording_of_zeros):
    reading, writing = os.pipe()
    stream = FrameStream(reading, recording_of_zeros, b"")
    waiting = threading.Thread(target=stream.read, args=(50,))
    waiting.start()
    time.sleep(0.05)
    assert waiting.is_alive()
    stream.close()
    waiting.join(5)
    assert not waiting.is_alive() and stream.frames == 0
    os.close(reading)
    os.close(writing)


@pytest.fixture
def recording_of_zeros(tmp_path) -> Recording:
    (tmp_path / "zeros.dat").write_bytes(bytes(12))
    return read_recording(tmp_path / "zeros.dat", size="12x8")


@pytest.mark.parametrize(
    ("content", "given", "message"),
    [
        (b"", {"size": "12x8"}, r"The stream ended after 0 bytes, before its first frame of 12x8 \(12 bytes\)"),
        (b"12345", {"size": (12, 8)}, "The stream ended after 5 bytes"),
        (bytes(3000), {"size": None}, "A stream does not hold the size of its frames"),
        (bytes(3000), {"size": "12"}, "The size '12' cannot be read"),
        (bytes(3000), {"size": "12x8", "row_bits": 3}, "row_bits=3 is less than the 12 columns"),
        (bytes(3000), {"size": "12x8", "white_rate": -1}, "white_rate is -1"),
        (bytes(3000), {"size": "12x8", "bad_pixels": np.zeros((3, 3), bool)}, "bad_pixels has shape"),
    ],
)
def test_open_stream_refuses(piped, content, given, message):
    with pytest.raises(InputError, match=message) as refused:
        open_stream(piped(content), **given)
    assert "/" not in str(refused.value)  # the name of a temporary file


def test_what_cannot_be_read_is_refused(tmp_path):
    folder = os.open(tmp_path, os.O_RDONLY)
    with pytest.raises(InputError, match="The stream cannot be read: is a directory"):
        open_stream(folder, size="12x8")
    os.close(folder)
