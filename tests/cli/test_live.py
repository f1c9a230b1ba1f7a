"""`scsr sequence -`: what is said of a stream, how it ends, and what is refused."""

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from scsr_opt import Diagnostics, Solution, Status, reconstruct
from scsr_opt.camera import read_recording
from scsr_opt.camera.white import White
from scsr_opt.cli import main
from scsr_opt.motion import Global
from scsr_opt.report import read_picture

HEIGHT, WIDTH = 24, 40
FAILING = 600


def packed(frames: int) -> bytes:
    """Frames of a ramp of firing rates, as a camera packs them."""
    rate = np.linspace(0.1, 0.6, WIDTH)
    spikes = np.diff(np.floor(np.arange(frames + 1)[:, None] * rate), axis=0).astype(np.uint8)
    return np.packbits(np.repeat(spikes[:, None], HEIGHT, axis=1).reshape(frames, -1), 1, bitorder="little").tobytes()


@pytest.fixture
def stream(monkeypatch) -> Iterator[Callable[[bytes], None]]:
    """A function that gives a command this content as its standard input."""
    ends: list[int] = []
    writers: list[threading.Thread] = []

    def give(content: bytes) -> None:
        reading, writing = os.pipe()
        ends.append(reading)

        def write() -> None:
            try:
                os.write(writing, content)
            except BrokenPipeError:
                pass
            os.close(writing)

        writers.append(threading.Thread(target=write))
        writers[-1].start()
        monkeypatch.setattr("scsr_opt.cli.live.STDIN", reading)

    yield give
    for end in ends:
        os.close(end)
    for writer in writers:
        writer.join()


@pytest.fixture
def solves(monkeypatch) -> list[dict]:
    """Puts a quick stand-in in the place of `reconstruct`; returns what it was called with."""
    calls: list[dict] = []

    def stand_in(recording, *, scale, key, options):
        calls.append({"recording": recording, "key": key, "options": options})
        return Solution(
            image=np.full((scale * HEIGHT, scale * WIDTH), 0.25, np.float32),
            recording=recording,
            scale=scale,
            key=key,
            white_rate=recording.white_rate,
            status=Status.non_finite if key == FAILING else Status.converged,
            diagnostics=Diagnostics(),
            white=White(0.5, True, "found"),
        )

    monkeypatch.setattr("scsr_opt.sequences.live.reconstruct", stand_in)
    return calls


GIVEN = ("sequence", "-", "--size", f"{WIDTH}x{HEIGHT}", "--every", "1000", "--scale", "2", "-o")


def test_stream_is_reported(scsr, here, stream, solves):
    stream(packed(500) + b"end")
    said = scsr(*GIVEN, "out", "--frames", "21", "--motion", "none", "--readout-rate", "20000").splitlines()
    assert said[0] == "out: 1 picture of frame 0 written; 500 frames were read."
    assert said[1] == "No key frame was dropped."
    assert re.fullmatch(
        r"Delay from the arrival of a key frame to its picture: \S+ s \(median\), \S+ s at most.", said[2]
    )
    assert said[3] == "The stream ended inside a frame: its last 3 bytes were not used."
    assert said[4] == "Shown as white: intensity 0.5 (found)."
    (call,) = solves
    assert call["options"].frames == 21 and type(call["options"].motion).__name__ == "Still"
    assert call["recording"].readout_rate == 20_000 and call["recording"].name == "stream"
    assert read_picture("out/images/0000000000.png")[0, 0] == pytest.approx(0.5, abs=0.01)
    assert Path("out/times.csv").read_text().splitlines()[1] == "0,0000000000.png,0,0.0,converged,0"
    assert os.listdir(here) == ["out"]


@pytest.mark.filterwarnings("ignore:The solve does not keep up")
def test_stream_latest_writes_one_file(scsr, here, stream, solves):
    stream(packed(3500))
    assert scsr(*GIVEN, "now.png", "--latest", "--white", "1", "--start", "100", "--quiet") == ""
    assert os.listdir(here) == ["now.png"] and solves[-1]["key"] == 3100
    assert read_picture("now.png")[0, 0] == pytest.approx(0.25, abs=0.01)
    stream(packed(300))
    assert "now.png is there already: give --overwrite" in scsr(*GIVEN, "now.png", "--latest", code=2)


def test_stream_dropped_key_frames_are_said(capsys, stream, solves, monkeypatch):
    """Here all but the last, which come while nothing is solved for."""
    from scsr_opt.sequences.live import _Newest

    hand_over = _Newest.__iter__

    def late(newest):
        while not newest._ended:
            threading.Event().wait(0.01)
        return hand_over(newest)

    monkeypatch.setattr(_Newest, "__iter__", late)
    stream(packed(5000))
    assert main([*GIVEN, "out"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "out: 1 picture of frame 4000 written; 5000 frames were read."
    assert said[1] == (
        "4 key frames were dropped, 4 of them before the first picture, as the solve did not keep up with the stream."
    )


def test_stream_of_which_a_picture_fails(capsys, stream, solves):
    stream(packed(700))
    assert main([*GIVEN, "out", "--start", str(FAILING)]) == 1
    said = capsys.readouterr()
    assert said.out.startswith("out: no picture written; 700 frames were read.\n")
    assert said.err.startswith(
        "scsr: error: 1 of 1 pictures could not be solved for, the last one: a value that is not finite appeared"
    )


def test_stream_that_ends_before_the_first_key_frame(scsr, here, stream, solves):
    stream(packed(200))
    said = scsr(*GIVEN, "out", "--start", "500", code=2)
    assert "The stream ended after 200 frames, before the first key frame, 500" in said
    assert os.listdir(here) == [] and not solves


def test_stream_that_breaks_off_says_so(capsys, stream, solves, monkeypatch):
    def broken(*_):
        raise ConnectionResetError(104, "Connection reset by peer")

    stream(packed(300))
    monkeypatch.setattr(os, "readv", broken)
    assert main([*GIVEN, "out"]) == 2
    said = capsys.readouterr()
    assert said.out.startswith("out: 1 picture of frame 0 written; ")
    assert said.err == "scsr: error: The stream could not be read any further: connection reset by peer.\n"


PROGRAM = """
import signal, sys, numpy as np, scsr_opt.cli.app as app, scsr_opt.sequences.live as live
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
from scsr_opt import Solution, Status
def stand_in(recording, *, scale, key, options):
    return Solution(image=np.full((scale * recording.height, scale * recording.width), 0.25, np.float32), scale=scale,
                    recording=recording, key=key, white_rate=0.6, status=Status.converged)
live.reconstruct = stand_in
sys.argv = ["scsr", *sys.argv[1:]]
sys.exit(app.main())
"""


@pytest.mark.parametrize(
    ("number", "code", "message"),
    [(signal.SIGTERM, 143, "scsr: error: terminated.\n"), (signal.SIGINT, 130, "scsr: error: interrupted.\n")],
)
def test_stream_that_is_interrupted_is_reported(here, number, code, message):
    """While the camera says nothing; what was written stays."""
    command = [sys.executable, "-c", PROGRAM, *GIVEN, "out"]
    pipe = subprocess.PIPE
    running = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe)
    assert running.stdin is not None and running.stdout is not None and running.stderr is not None
    running.stdin.write(packed(900))
    running.stdin.flush()
    for _ in range(1200):
        if Path("out/times.csv").exists() or running.poll() is not None:
            break
        threading.Event().wait(0.05)
    running.send_signal(number)
    assert running.wait(120) == code
    said, errors = running.stdout.read().decode(), running.stderr.read().decode()
    assert said.startswith("out: 1 picture of frame 0 written; ") and "Delay" in said
    assert errors == message and os.listdir("out/images") == ["0000000000.png"]
    for end in (running.stdin, running.stdout, running.stderr):
        end.close()


def test_stream_end_to_end(scsr, stream, tmp_path):
    """By a real solve, which equals that of the file."""
    content = packed(200)
    (tmp_path / "a.dat").write_bytes(content)
    stream(content)
    options = ("--frames", "21", "--motion", "global", "--strength", "0.01", "--bits", "32")
    scsr(*GIVEN, "out", "--start", "90", *options)
    motion, recording = Global(), read_recording(tmp_path / "a.dat", size=(WIDTH, HEIGHT))
    expected = reconstruct(recording, scale=2, key=90, frames=21, motion=motion, strength=0.01)
    np.testing.assert_array_equal(read_picture("out/images/0000000090.tif"), expected.image)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["-o", "out", "--size", "40x24"], "A stream needs --every N"),
        (["-o", "out", "--every", "9"], "A stream does not hold the size of its frames: give --size WIDTHxHEIGHT"),
        (["-o", "a.zarr", "--every", "9", "--size", "40x24"], "nobody knows how long it gets"),
        (["-o", "a.png", "--every", "9", "--size", "40x24"], "nobody knows how long it gets"),
        (["-o", "out", "--every", "9", "--latest"], "pictures end in .png, .tif"),
        (["-o", "out", "--every", "0", "--size", "40x24"], "every is 0"),
        (["-o", "out", "--every", "9", "--size", "40x24", "--start", "-1"], "start is -1"),
        (["-o", "out", "--every", "9", "--size", "40x24", "--stop", "0"], "stop is 0"),
        (["-o", "out", "--every", "9", "--size", "40x24", "--workers", "2"], "--workers is not for a stream"),
        (["-o", "out", "--every", "9", "--size", "40x24", "--scheduler", "tcp://a:1"], "--scheduler is not for"),
        (["-o", "out", "--every", "9", "--size", "40x24", "--group", "2"], "--group is not for a stream"),
        (["-o", "out", "--every", "9", "--size", "40x24", "--rate", "2"], "--rate is not for a stream"),
        (["-o", "out", "--every", "9", "--size", "40x24", "--array", "a"], "--array a is the name of an array"),
        (["-o", "out", "--every", "9", "--size", "40x24", "--motion", "1,0"], "the velocity at one moment"),
        (["-o", "out", "--every", "9", "--size", "40x24", "--crop", "9,9,99,9"], "does not lie in stream"),
        (["-o", "out", "--every", "9", "--size", "40x24", "--scale", "0"], "--scale is 0"),
        (["-o", "out", "--every", "9", "--size", "4000x2400"], "The stream ended after 24,000 bytes, before its first"),
    ],
)
def test_stream_refuses(scsr, here, stream, solves, given, message):
    stream(packed(200))
    assert message in scsr("sequence", "-", *given, code=2)
    assert os.listdir(here) == [] and not solves


@pytest.mark.parametrize(("closed", "message"), [(True, "Standard input is closed"), (False, "is a terminal")])
def test_standard_input_that_is_no_stream(scsr, monkeypatch, closed, message):
    master, terminal = os.openpty()
    if closed:
        os.close(terminal)
    monkeypatch.setattr("scsr_opt.cli.live.STDIN", terminal)
    assert message in scsr(*GIVEN, "out", code=2)
    for one in (master,) if closed else (master, terminal):
        os.close(one)


def test_latest_is_for_streams(scsr, file):
    said = scsr("sequence", file, "-o", "a.png", "--latest", code=2)
    assert "--latest is for a stream, whose FILE is -" in said


def test_options_are_no_files(scsr):
    assert "Unknown option: --evry" in scsr("sequence", "--evry", "-o", "a.zarr", code=2)
