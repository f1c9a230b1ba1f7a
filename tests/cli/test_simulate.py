"""`scsr simulate`."""

import os

import numpy as np
import pytest
from PIL import Image

from scsr_opt.camera import read_recording
from scsr_opt.report import read_picture


@pytest.fixture
def picture(here) -> str:
    rows, columns = np.mgrid[0:48, 0:64]
    Image.fromarray((127 + 100 * np.sin(rows / 5) * np.cos(columns / 7)).astype(np.uint8)).save(here / "waves.png")
    return "waves.png"


def test_simulate_and_read_back(scsr, picture):
    said = scsr(
        "simulate", picture, "-o", "rec.npz", "--scale", "2", "--frames", "40", "--velocity", "-0.1", "0.2",
        "--white-rate", "0.5", "--truth", "truth.png", "--true-velocity", "v.npy",
    )  # fmt: skip
    assert said.splitlines() == [
        "rec.npz: 40 frames of 32x24, key frame 20.",
        "truth.png: the true picture, 64x48.",
        "v.npy: the true velocity, sensor pixels per frame.",
    ]
    recording = read_recording("rec.npz")
    assert recording.shape == (40, 24, 32) and recording.white_rate == 0.5 and recording.bad_pixels is None
    velocity = np.load("v.npy")
    assert velocity.shape == (2, 24, 32) and velocity[0] == pytest.approx(-0.1) and velocity[1] == pytest.approx(0.2)
    assert (read_picture("truth.png") == read_picture(picture)).all()


@pytest.mark.parametrize("scene", ["static", "translation", "affine", "object", "disc"])
def test_simulate_every_scene(scsr, picture, scene):
    images = [picture, "sample:camera"] if scene in ("object", "disc") else [picture]
    scsr("simulate", *images, "-o", "rec.npz", "--scene", scene, "--frames", "20", "--true-velocity", "v.npy")
    moves = np.abs(np.load("v.npy")).max() > 0.01
    assert moves == (scene != "static") and 0.05 < read_recording("rec.npz").spikes.mean() < 0.6


def test_simulate_video(scsr, here, picture):
    for number in range(3):
        Image.fromarray(np.roll(np.asarray(Image.open(picture)), number, axis=1)).save(f"frame{number}.png")
    frames = [f"frame{number}.png" for number in range(3)]
    scsr("simulate", *frames, "-o", "a.npz", "--scene", "video", "--readouts", "8", "--frames", "17")
    (here / "clip").mkdir()
    for name in frames:
        os.rename(name, here / "clip" / name)
    scsr("simulate", "clip", "-o", "b.npz", "--scene", "video", "--readouts", "8", "--frames", "17")
    assert (read_recording("a.npz").spikes == read_recording("b.npz").spikes).all()


def test_simulate_marks_bad_pixels(scsr, picture):
    scsr("simulate", picture, "-o", "rec.h5", "--dead", "0.1", "--hot", "0.05", "--frames", "5", "--seed", "3")
    bad = read_recording("rec.h5").bad_pixels
    assert bad is not None and bad.sum() == pytest.approx(0.15 * 12 * 16, abs=1)


@pytest.mark.parametrize(
    ("images", "options", "message"),
    [
        (["nothing.png"], [], "There is no picture nothing.png"),
        (["sample:mona-lisa"], [], "There is no sample picture 'mona-lisa'"),
        (["waves.png"], ["-o", "rec.avi"], "its ending is '.avi', but recordings end in .dat, .npy, .npz, .h5, .hdf5"),
        (["waves.png"], ["-o", "missing/rec.npz"], "the folder missing does not exist"),
        (["waves.png"], ["--frames", "0"], "--frames is 0"),
        (["waves.png"], ["--scale", "0"], "--scale is 0"),
        (["waves.png"], ["--scale", "100"], "100"),
        (["waves.png"], ["--key", "101"], "--key is 101, but the recording will have frames 0 to 100"),
        (["waves.png"], ["--scene", "object"], "made of two pictures, the background and what moves before it, but 1"),
        (["waves.png", "waves.png"], [], "The scene translation is made of one picture, but 2 were given"),
        (["waves.png"], ["--zoom", "0.1"], "--zoom is for --scene affine, but the scene is translation: leave it out"),
        (["waves.png"], ["--follow-motion"], "--follow-motion is for --scene video"),
        (["waves.png"], ["--white-rate", "0"], "white_rate"),
        (["waves.png"], ["--truth", "t.jpg"], "its ending is '.jpg', but pictures end in"),
        (["waves.png"], ["--truth", "waves.png"], "--truth waves.png is the file that is read"),
        (["waves.png"], ["--true-velocity", "v.txt"], "--true-velocity v.txt must end in .npy"),
        (["clip"], ["--scene", "video", "--true-velocity", "v.npy"], "cannot be had for a video"),
        (
            ["waves.png"],
            ["--true-velocity", "rec.npy", "-o", "rec.npy"],
            "--true-velocity and --output are both rec.npy",
        ),
    ],
)
def test_simulate_refuses(scsr, here, picture, images, options, message):
    output = [] if "-o" in options else ["-o", "rec.npz"]
    assert message in scsr("simulate", *images, *output, *options, code=2)
    assert os.listdir(here) == ["waves.png"]
