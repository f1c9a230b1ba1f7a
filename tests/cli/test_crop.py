"""`--crop` of every command that looks at a recording."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

import scsr_opt
from scsr_opt.baselines import tfp_bicubic
from scsr_opt.camera import read_recording, tfp, write_recording
from scsr_opt.errors import InputError
from scsr_opt.operators import Blur
from scsr_opt.pipeline.solution import Diagnostics, Solution
from scsr_opt.report import read_picture
from scsr_opt.solvers import Status

FRAMES, HEIGHT, WIDTH = 31, 24, 40  # of the fixture `spikes`
CROP = (4, 2, 8, 16)
CUT = (..., slice(4, 12), slice(2, 18))
CROPPED = ("--crop", "4,2,8,16")


@pytest.fixture
def noise(here) -> np.ndarray:
    """A recording in which every place looks different: noise.npz."""
    spikes = (np.random.default_rng(0).random((FRAMES, HEIGHT, WIDTH)) < 0.3).astype(np.uint8)
    np.savez("noise.npz", spikes=spikes, bad_pixels=spikes[0])
    return spikes


def test_info_tells_of_the_crop(scsr, noise):
    said = scsr("info", "noise.npz", *CROPPED)
    assert "16 x 8 pixels" in said and "from row 4, column 2" in said
    facts = json.loads(scsr("info", "noise.npz", *CROPPED, "--json"))
    assert facts["crop"] == list(CROP) and facts["spikes"] == noise[CUT].sum()
    assert facts["bad_pixels"] == noise[0][CUT].sum()
    assert json.loads(scsr("info", "noise.npz", "--json"))["crop"] is None


def test_play_shows_the_crop(scsr, noise):
    scsr("play", "noise.npz", "-o", "a.npz", *CROPPED)
    assert read_picture("a.npz") == pytest.approx(tfp(noise[CUT], 15, white_rate=0.6), abs=1e-6)


def test_baseline_makes_the_picture_of_the_crop(scsr, noise):
    scsr("baseline", "noise.npz", "--method", "tfp-bicubic", "--scale", "2", "-o", "a.npz", *CROPPED)
    expected = tfp_bicubic(read_recording("noise.npz").crop(*CROP), scale=2, key=15)
    np.testing.assert_array_equal(read_picture("a.npz"), expected)


def test_compare_is_handed_the_crop(scsr, noise, monkeypatch):
    def compare(recording, *_, **__):
        raise InputError(f"seen: {recording.shape}, {np.array_equal(recording.spikes, noise[CUT])}")

    monkeypatch.setattr("learned.evaluation.compare.compare_stages", compare)
    given = ("noise.npz", "--models", "fista-tv", "-o", "out", *CROPPED)
    assert "seen: (31, 8, 16), True" in scsr("compare", *given, code=2)


def test_solve_hands_on_the_crop_and_reports_it(scsr, noise, monkeypatch):
    calls = []

    def reconstruct(recording, *, scale, crop, **others):
        calls.append({"recording": recording, "crop": crop, **others})
        return Solution(
            image=np.zeros((16, 32), np.float32),
            recording=recording,
            scale=scale,
            key=15,
            white_rate=0.6,
            status=Status.converged,
            crop=crop,
            diagnostics=Diagnostics(iterations=2),
        )

    monkeypatch.setattr(scsr_opt, "reconstruct", reconstruct, raising=False)
    given = ("--scale", "2", "-o", "a.npz", "--report", "a.json", "--figure", "f.png", "--optics", "0.5", *CROPPED)
    said = scsr("solve", "noise.npz", *given)
    assert said.startswith("noise: 31 frames of 40x24, 16x8 of them from row 4, column 2, key frame 15 -> 32x16 (x2)\n")
    (call,) = calls
    assert call["crop"] == CROP and call["recording"].shape == (FRAMES, HEIGHT, WIDTH)
    assert call["optics"].shape == Blur.gaussian((16, 32), 1.0).shape
    assert json.loads(Path("a.json").read_text())["picture"]["crop"] == list(CROP)
    with np.load("a.npz") as stored:
        assert stored["crop"].tolist() == list(CROP)


def test_sequence_hands_on_the_crop(scsr, noise, sequences):
    scsr("sequence", "noise.npz", "-o", "a.gif", "--every", "10", "--scale", "2", *CROPPED)
    (call,) = sequences
    assert call["recording"].shape == (FRAMES, HEIGHT, WIDTH) and call["options"].crop == CROP


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), CROP[2:]])
def test_gains_and_velocities_are_of_the_sensor_or_of_the_crop(scsr, noise, asked, shape):
    np.save("gain.npy", np.ones(shape))
    np.save("v.npy", np.zeros((2, *shape)))
    scsr("solve", "noise.npz", "-o", "a.png", "--gain", "gain.npy", "--motion", "v.npy", *CROPPED)
    (call,) = asked
    assert call["gain"].shape == shape and call["crop"] == CROP
    assert call["motion"].velocity.shape == (2, *CROP[2:])  # a motion is that of the part


def test_gains_and_velocities_of_another_size_are_refused(scsr, noise, asked):
    np.save("gain.npy", np.ones((8, 17)))
    np.save("v.npy", np.zeros((2, 8, 17)))
    said = scsr("solve", "noise.npz", "-o", "a.png", "--gain", "gain.npy", *CROPPED, code=2)
    assert "holds float64 of shape (8, 17), but gains are (24, 40) or, of the crop, (8, 16), finite and above 0" in said
    said = scsr("solve", "noise.npz", "-o", "a.png", "--motion", "v.npy", *CROPPED, code=2)
    assert "but a velocity is (2, 24, 40) or, of the crop, (2, 8, 16), finite" in said
    assert asked == []


SIZE = "which has 24 rows and 40 columns: choose a height and a width of at least 1"


@pytest.mark.parametrize(
    ("crop", "message"),
    [
        ("0,0,25,40", f"The crop of 25 rows from 0 and 40 columns from 0 does not lie in noise, {SIZE}"),
        ("20,0,8,8", f"The crop of 8 rows from 20 and 8 columns from 0 does not lie in noise, {SIZE}"),
        ("-1,0,4,4", SIZE),
        ("0,0,0,4", SIZE),
        ("0,0,4,-4", SIZE),
        ("0,40,1,1", SIZE),
        ("1,2,3", "--crop is 1,2,3, but it must be TOP,LEFT,HEIGHT,WIDTH, four whole numbers of sensor pixels"),
        ("1,2,3,4,5", "--crop is 1,2,3,4,5, but"),
        ("0,0,4,4,", "--crop is 0,0,4,4,, but"),
        ("a,b,c,d", "--crop is a,b,c,d, but"),
        ("1.5,0,4,4", "--crop is 1.5,0,4,4, but"),
        ("16x8", "--crop is 16x8, but"),
        ("", "--crop is , but"),
    ],
)
@pytest.mark.parametrize("command", ["info", "play", "solve", "sequence", "baseline", "compare"])
def test_a_crop_that_is_none_is_refused_before_the_work(scsr, here, noise, asked, command, crop, message):
    outputs = {"info": (), "sequence": ("-o", "a.gif"), "compare": ("-o", "out", "--models", "fista-tv")}
    said = scsr(command, "noise.npz", *outputs.get(command, ("-o", "a.png")), f"--crop={crop}", code=2)
    assert message in said
    assert asked == [] and os.listdir(here) == ["noise.npz"]


def test_the_advice_of_the_error_for_a_huge_scale_holds(scsr, monkeypatch, capsys):
    """The recording is dark: there is nothing to iterate, which is said by another exit code."""
    monkeypatch.setattr("scsr_opt._validation._MOST_PIXELS", 500)
    write_recording("dark.npz", np.zeros((11, 12, 18), np.uint8))
    command = ("solve", "dark.npz", "-o", "a.png", "--scale", "2", "--motion", "none")
    assert scsr(*command, code=2).endswith("take a smaller scale, or a crop.\n")
    assert "No picture was written" in scsr(*command, "--crop", "2,3,5,5", code=1)
