"""`scsr play`."""

import os
import sys

import pytest
from PIL import Image

from scsr_opt.camera import Recording, tfp, write_recording
from scsr_opt.report import read_picture

FRAMES, HEIGHT, WIDTH = 31, 24, 40  # of the fixture `spikes`


def test_play_writes_the_playback(scsr, file, spikes):
    assert scsr("play", file, "-o", "a.png", "--key", "12", "--bits", "16") == "a.png: frame 12 by tfp.\n"
    assert read_picture("a.png") == pytest.approx(tfp(spikes, 12, white_rate=0.6).clip(0, 1), abs=1e-4)


@pytest.mark.parametrize("method", ["tfp", "tfi", "stp"])
def test_play_has_a_name_of_its_own_for_the_picture(scsr, file, method):
    assert scsr("play", file, "--method", method, "--quiet") == ""
    picture = read_picture(f"ramp_{method}.png")
    assert picture.shape == (HEIGHT, WIDTH) and picture[:, -1].mean() > 0.8 > 0.2 > picture[:, 1].mean()


def test_play_at_the_ends_of_a_recording(scsr, file, spikes):
    for key in (0, FRAMES - 1):
        scsr("play", file, "-o", "a.npz", "--key", key, "--overwrite")
        assert read_picture("a.npz") == pytest.approx(tfp(spikes, key, white_rate=0.6), abs=1e-6)


def test_play_a_recording_shorter_than_the_window(scsr, spikes):
    write_recording("short.npz", Recording.from_array(spikes[:5]))
    scsr("play", "short.npz", "-o", "a.npz")
    assert read_picture("a.npz") == pytest.approx(spikes[:5].mean(0) / 0.6, abs=1e-6)


def test_play_a_film(scsr, file):
    said = scsr("play", file, "-o", "a.gif", "--start", "5", "--stop", "20", "--step", "5", "--window", "7")
    assert said.splitlines()[0] == "a.gif: 3 pictures of frames 5 to 15, every 5."
    with Image.open("a.gif") as film:
        assert film.size == (WIDTH, HEIGHT)
        assert film.n_frames == 3  # pyright: ignore[reportAttributeAccessIssue]
        assert film.info["duration"] == 670  # hundredths of a second: 2 s in all


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "a.jpg"], "its ending is '.jpg', but pictures end in .png"),
        (["-o", "missing/a.png"], "the folder missing does not exist"),
        (["-o", "ramp.npz"], "--output ramp.npz is the file that is read"),
        (["--key", "31"], "Key frame 31 is not in ramp, which has 31 frames"),
        (["--key", "-1"], "Key frame -1 is not in ramp"),
        (["--window", "0"], "--window is 0, but it must be from 1 to the 31 frames of the recording"),
        (["--window", "1000"], "--window is 1000, but it must be from 1 to the 31 frames of the recording"),
        (["--window", "5", "--method", "tfi"], "--window is for --method tfp, but the method is tfi: leave it out"),
        (["--bits", "12"], "12 bits per pixel cannot be stored in .png"),
        (["--gamma", "0"], "gamma is 0"),
        (["-o", "a.gif", "--key", "3"], "--key and --bits are for pictures, but a.gif is a film"),
        (["-o", "a.png", "--start", "3"], "--start, --stop, --step and --rate are for films, but a.png is a picture"),
        (["-o", "a.png", "--rate", "5"], "--start, --stop, --step and --rate are for films"),
        (
            ["-o", "a.gif", "--start", "20", "--stop", "10"],
            "--start is 20 and --stop is 10, but frames go from --start to before --stop",
        ),
        (["-o", "a.gif", "--stop", "32"], "choose 0 <= --start < --stop <= 31"),
        (["-o", "a.gif", "--step", "0"], "--step is 0"),
        (["-o", "a.gif", "--rate", "0"], "rate is 0"),
        (["-o", "a.gif", "--gamma", "0"], "gamma is 0"),
    ],
)
def test_play_refuses(scsr, here, file, options, message):
    assert message in scsr("play", file, *options, code=2)
    assert os.listdir(here) == ["ramp.npz"]


def test_play_mp4_without_an_encoder(scsr, monkeypatch, file):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert "needs the program ffmpeg" in scsr("play", file, "-o", "a.mp4", code=2)
