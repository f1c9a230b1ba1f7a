"""`scsr solve`: what it reads, writes, passes on and refuses."""

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import scsr_opt
from scsr_opt import Diagnostics, Shortcuts, Solution, Stage, Status
from scsr_opt.camera import Recording, tfp
from scsr_opt.errors import InputError
from scsr_opt.pipeline.scene_summary import SceneSummary
from scsr_opt.report import bicubic, read_picture
from scsr_opt.solvers import TileIterations

FRAMES, HEIGHT, WIDTH = 31, 24, 40  # of the fixture `spikes`


def solved(image: np.ndarray, status: Status = Status.converged, **fields: Any) -> Solution:
    """A solution of a dark recording at scale 2."""
    recording = Recording.from_array(np.zeros((FRAMES, HEIGHT, WIDTH), np.uint8))
    known = {"recording": recording, "scale": 2, "key": 15, "white_rate": 0.6}
    return Solution(image=image, status=status, **known, **fields)


def test_solve_writes_all_that_was_asked_for(scsr, file, asked, spikes):
    said = scsr(
        "solve", file, "--scale", "2", "--key", "10", "-o", "a.png", "--report", "a.json", "--figure", "f.png"
    )  # fmt: skip
    lines = said.splitlines()
    assert lines[0] == "ramp: 31 frames of 40x24, key frame 10 -> 80x48 (x2)"
    assert re.fullmatch(r"2 iterations\. The picture meets the tolerance\. \d+\.\d s in all\.", lines[2])
    assert lines[3:] == ["Shown as white: intensity 1 (nominal).", "a.png", "a.json", "f.png"]
    (call,) = asked
    assert (np.asarray(call["spikes"]) == spikes).all() and call["spikes"].white_rate == 0.6
    assert call["key"] == 10 and call["scale"] == 2
    assert call.keys() == {"spikes", "scale", "key"}  # the rest is left to the defaults
    wanted = np.kron(tfp(spikes, 10, white_rate=0.6), np.ones((2, 2))).clip(0, 1)
    assert read_picture("a.png") == pytest.approx(wanted, abs=0.5 / 255 + 1e-6)
    told = json.loads(Path("a.json").read_text())
    assert (
        told["picture"]["scale"] == 2 and told["picture"]["key"] == 10 and told["seconds"].keys() == {"read", "solve"}
    )
    with Image.open("f.png") as figure:
        assert figure.width >= 1000 and figure.height >= 500


def test_solve_is_silent_when_asked(scsr, file, asked):
    assert scsr("solve", file, "-o", "a.png", "-q") == ""


def test_what_was_skipped_is_told_and_shown(scsr, file, monkeypatch):
    scene = SceneSummary(
        np.array([[0, 2, 2]]), np.array([[31, 1, 1]]), np.ones((1, 3), np.float32), "2 layers", 500, 200
    )
    stages = (Stage(1, 1.0, 0.5, 0.5, 2e-4, 1.0),)
    diagnostics = Diagnostics(seconds={"motion": 0.5}, solver="DataProximal", positions=1)
    solution = solved(np.zeros((48, 80), np.float32), stages=stages, diagnostics=diagnostics, scene=scene)
    monkeypatch.setattr(scsr_opt, "reconstruct", lambda *_, **__: solution)
    said = scsr("solve", file, "--scale", "2", "-o", "a.png", "--explain", "--figure", "plan.png")
    assert "Measurements: 200 instead of 500 (60 % fewer)." in said and "  33 %: nothing moves" in said
    assert "Solver: data-proximal, which is faster where nothing moves." in said and "Seconds: motion 0.50." in said
    assert "One more iteration would change the picture by 0.02 % at most." in said
    with Image.open("plan.png") as figure:
        assert figure.width > figure.height


def test_where_the_iteration_went_on_is_told_and_shown(scsr, file, monkeypatch):
    scene = SceneSummary(np.array([[2, 2]]), np.array([[1, 1]]), np.ones((1, 2), np.float32), "2 layers", 500, 500)
    tiles = TileIterations(7, np.array([[0, 12]]), 64, 8e-4, 1e-3)
    stages = (Stage(1, 1.0, 0.5, 0.5, 5e-5, 1.0),)
    diagnostics = Diagnostics(seconds={"motion": 0.5}, positions=5)
    image = np.zeros((48, 80), np.float32)
    solution = solved(image, stages=stages, diagnostics=diagnostics, scene=scene, tiles=tiles)
    monkeypatch.setattr(scsr_opt, "reconstruct", lambda *_, **__: solution)
    given = ("--scale", "2", "-o", "a.png", "--explain", "--figure", "plan.png", "--report", "a.json")
    said = scsr("solve", file, *given)
    assert "Iterations: 7 of the whole picture, then up to 12 more on 1 of its 2 squares of 64x64 pixels; " in said
    assert "One more iteration, with the motion blur held fixed, would change the picture by 0.005 % at most." in said
    assert "One more iteration would change no square by more than 0.08 % of the picture's root mean square" in said
    told = json.loads(Path("a.json").read_text())
    assert told["tiles"] == {
        "tiles": 2, "tiles_iterated_further": 1, "most_iterations": 19, "largest_change": 8e-4, "change_limit": 1e-3
    }  # fmt: skip
    assert told["scene"]["scene"] == "2 layers" and told["scene"]["samples"] == told["scene"]["intervals"] == 500
    with Image.open("plan.png") as figure:
        coloured = np.ptp(np.asarray(figure.convert("RGB"), int), axis=-1) > 30
        assert coloured[:, figure.width // 2 :].sum() > 1000  # the tile that was gone on with, and the scale


def test_all_is_done_when_asked(scsr, file, asked):
    said = scsr("solve", file, "-o", "a.png", "--no-skip", "--explain")
    (call,) = asked
    assert call["shortcuts"] == Shortcuts.none() and "No work was left out." in said


def test_solve_takes_frames_around_the_key(scsr, file, asked):
    scsr("solve", file, "-o", "a.npz", "--key", "28", "--frames", "11")
    (call,) = asked
    assert call["key"] == 28 and call["frames"] == 11
    with np.load("a.npz") as stored:
        assert stored["key"] == 28 and stored["scale"] == 4 and stored["velocity"].shape == (2, HEIGHT, WIDTH)


def test_solve_passes_bad_pixels_on(scsr, here, file, asked):
    np.save(here / "bad.npy", np.eye(HEIGHT, WIDTH, dtype=bool))
    scsr("solve", file, "-o", "a.png", "--bad-pixels", "bad.npy")
    assert (asked[0]["spikes"].bad_pixels == np.eye(HEIGHT, WIDTH, dtype=bool)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "a.bmp"], "its ending is '.bmp', but pictures end in .png, .tif, .tiff, .npz"),
        (["-o", "missing/a.png"], "the folder missing does not exist"),
        (["-o", "."], "its ending is 'missing'"),
        (["-o", "a.png", "--bits", "32"], "32 bits per pixel cannot be stored in .png"),
        (["-o", "a.png", "--report", "a.txt"], "--report a.txt must end in .json"),
        (["-o", "a.png", "--figure", "a.gif"], "--figure a.gif must end in .png or .pdf or .svg"),
        (["-o", "a.png", "--figure", "a.png"], "--figure and --output are both a.png"),
        (["-o", "ramp.npz"], "--output ramp.npz is the file that is read"),
        (["-o", "a.png", "--key", "31"], "Key frame 31 is not in ramp"),
        (["-o", "a.png", "--scale", "0"], "--scale is 0"),
        (["-o", "a.png", "--bad-pixels", "small.npy"], "(24, 40)"),
        (["-o", "a.png", "--size", "41x24"], "41x24"),
    ],
)
def test_solve_refuses_before_it_starts(scsr, here, file, asked, options, message):
    np.save(here / "small.npy", np.zeros((2, 3)))
    assert message in scsr("solve", file, *options, code=2)
    assert asked == [] and sorted(os.listdir(here)) == ["ramp.npz", "small.npy"]


def test_a_failed_solve_writes_no_picture(scsr, here, monkeypatch, file):
    def fail(spikes, *, scale, **_):
        return solved(np.full((96, 160), np.nan, np.float32), Status.no_samples)

    monkeypatch.setattr(scsr_opt, "reconstruct", fail, raising=False)
    (here / "a.png").write_text("the old one")
    given = ("-o", "a.png", "--report", "a.json", "--figure", "f.png", "--overwrite")
    said = scsr("solve", file, *given, code=1)
    assert said == f"scsr: error: No picture was written: t{Status.no_samples.message[1:]}\n"
    assert sorted(os.listdir(here)) == ["a.json", "a.png", "ramp.npz"] and (here / "a.png").read_text() == "the old one"
    assert json.loads((here / "a.json").read_text())["status"]["name"] == "no_samples"


def test_a_picture_that_is_not_finite_is_an_error(scsr, here, monkeypatch, file):
    def lie(spikes, *, scale, **_):
        return solved(np.full((96, 160), np.nan, np.float32))

    monkeypatch.setattr(scsr_opt, "reconstruct", lie, raising=False)
    assert "are not finite, so it is not written" in scsr("solve", file, "-o", "a.png", code=2)
    assert os.listdir(here) == ["ramp.npz"]


def test_solve_tells_what_it_learned_of_the_camera(scsr, monkeypatch, file):
    def learn(spikes, *, scale, **_):
        found = Diagnostics(optics_sigma=0.527, gain_spread=0.0431, gain_spread_at_rest=0.0267)
        return solved(np.zeros((96, 160), np.float32), diagnostics=found)

    monkeypatch.setattr(scsr_opt, "reconstruct", learn, raising=False)
    said = scsr("solve", file, "-o", "a.png")
    assert "Lens: blurs by a standard deviation of 0.53 sensor pixels.\n" in said
    assert "Fixed pattern: gains spread by 4.3 %.\n" in said
    assert "Fixed pattern: where nothing moves, gains seem to spread by 2.7 %.\n" in said


def test_what_reconstruct_refuses_is_one_line(scsr, monkeypatch, file):
    def refuse(*_, **__):
        raise InputError("The scale is 5000, but the picture would not fit into memory.")

    monkeypatch.setattr(scsr_opt, "reconstruct", refuse, raising=False)
    assert "would not fit" in scsr("solve", file, "-o", "a.png", "--scale", "5000", code=2)


def test_from_a_picture_to_a_sharper_one_than_playback(scsr, here):
    """The whole path with nothing replaced: simulate, solve, compare with the truth."""
    scsr(
        "simulate", "sample:camera", "-o", "rec.npz", "--scale", "16", "--frames", "41", "--velocity", "0.1", "0.15",
        "--truth", "large.png",
    )  # fmt: skip
    scsr("solve", "rec.npz", "--scale", "2", "-o", "a.png", "--figure", "f.png", "--report", "a.json")
    scsr("play", "rec.npz", "-o", "played.png")
    truth = read_picture("large.png").reshape(64, 8, 64, 8).mean(axis=(1, 3))
    enlarged = bicubic(read_picture("played.png"), 2)
    error, played = (np.abs(image - truth)[8:-8, 8:-8].mean() for image in (read_picture("a.png"), enlarged))
    assert error < 0.75 * played
    told = json.loads((here / "a.json").read_text())
    assert told["motion"]["mean_speed"] == pytest.approx(np.hypot(0.1, 0.15), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("real_car_400x250.dat", (800, 500)),
        ("real_roadside_static.npz", (800, 500)),
        ("real_lowlight_helicopter.npz", (500, 500)),
    ],
)
def test_real_recordings(scsr, shared_data, name, size):
    scsr("solve", shared_data / "recordings" / name, "--scale", "2", "--frames", "101", "-o", "a.png")
    with Image.open("a.png") as picture:
        assert picture.size == size
        assert np.asarray(picture).std() > 5
