"""`scsr batch`: each recording its own picture and report, whatever becomes of the others."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import scsr_opt
from scsr_opt import Status, reconstruct
from scsr_opt.camera import Recording, read_recording, write_recording
from scsr_opt.cli import main
from scsr_opt.motion import Global
from scsr_opt.report import read_picture


@pytest.fixture
def recordings(spikes) -> Callable[..., None]:
    """Writes recordings of these names, with their folders."""

    def write(*names: str) -> None:
        for name in names:
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            write_recording(name, Recording.from_array(spikes, white_rate=0.6))

    return write


@pytest.fixture
def batch(capsys) -> Callable[..., tuple[list[str], list[str]]]:
    """Runs `scsr batch`, wants this exit code, and returns the lines of standard output and of its errors."""

    def run(*arguments: str, code: int = 0) -> tuple[list[str], list[str]]:
        assert main(["batch", *arguments]) == code
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        errors = [line for line in said.err.splitlines() if line.startswith("scsr: error: ")]
        return said.out.splitlines(), errors

    return run


def files(folder: str) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*") if path.is_file())


def test_batch_writes_picture_and_report_of_each(batch, recordings, asked):
    recordings("in/b.npz", "in/a.npz", "in/c.npy")
    said, errors = batch("in/*.npz", "in/c.npy", "-o", "out", "--scale", "2", "--key", "9", "--frames", "21")
    assert not errors and files("out") == ["a.json", "a.png", "b.json", "b.png", "c.json", "c.png"]
    assert [line.split()[:2] for line in said[:-1]] == [
        ["recording", "picture"],
        ["in/a.npz", "out/a.png"],
        ["in/b.npz", "out/b.png"],
        ["in/c.npy", "out/c.png"],
    ]
    assert said[1].endswith("  the picture meets the tolerance") and said[-1] == "3 of 3 pictures written."
    assert [(call["key"], call["scale"], call["frames"]) for call in asked] == [(9, 2, 21)] * 3
    assert json.loads(Path("out/b.json").read_text())["recording"]["name"] == "b"


def test_batch_goes_on_where_a_file_is_bad(batch, recordings, asked):
    recordings("in/a.npz", "in/d.npz", "in/e.npz")
    Path("in/b.npz").write_bytes(b"no recording at all")
    Path("in/c.npz").write_bytes(Path("in/a.npz").read_bytes()[:-200])
    os.mkdir("out")
    Path("out/e.png").write_text("holiday")
    said, errors = batch("in/*", "none.dat", "no*.npy", "-o", "out", "--scale", "2", code=1)
    assert files("out") == ["a.json", "a.png", "d.json", "d.png", "e.png"]
    assert Path("out/e.png").read_text() == "holiday"
    assert said[-1] == "2 of 7 pictures written." and len(said) == 9 and len(errors) == 5
    for line, error in zip([said[2], said[3], said[5], said[6], said[7]], errors, strict=True):
        name, result = line.split()[0], error.partition(f"{line.split()[0]}: ")[2]
        assert error.startswith(f"scsr: error: {name}: ") and line.split()[1] == "–" and line.endswith(result)
    assert "out/e.png is there already: give --overwrite" in errors[2] and "There is no file" in errors[3]
    assert "no*.npy" in errors[4]
    assert [Path(call["spikes"].name).name for call in asked] == ["a", "d"]


def test_batch_reports_a_solve_that_fails(batch, recordings, asked, monkeypatch):
    from dataclasses import replace

    recordings("a.npz", "b.npz")
    solve = scsr_opt.reconstruct

    def failing(recording, **given):
        return replace(
            solve(recording, **given),
            status=Status.no_samples if recording.name == "a" else Status.iterations_exhausted,
        )

    monkeypatch.setattr(scsr_opt, "reconstruct", failing)
    said, errors = batch("a.npz", "b.npz", "-o", "out", "--scale", "1", code=1)
    assert files("out") == ["a.json", "b.json", "b.png"] and len(errors) == 1
    assert json.loads(Path("out/a.json").read_text())["status"]["usable"] is False
    assert said[1].endswith(Status.no_samples.clause) and said[2].endswith(Status.iterations_exhausted.clause)


def test_batch_survives_a_fault_of_the_program(batch, recordings, asked, monkeypatch):
    """Memory that is not enough for one recording may be enough for the next."""
    recordings("a.npz", "b.npz")
    solve = scsr_opt.reconstruct

    def failing(recording, **given):
        if recording.name == "a":
            raise MemoryError
        return solve(recording, **given)

    monkeypatch.setattr(scsr_opt, "reconstruct", failing)
    _, errors = batch("a.npz", "b.npz", "-o", "out", "--scale", "1", code=1)
    assert errors == [
        "scsr: error: a.npz: there is not enough memory for this; take fewer --frames, a --crop of the sensor or a "
        "smaller --scale"
    ]
    assert files("out") == ["b.json", "b.png"]


def test_batch_that_is_interrupted_has_a_table(capsys, recordings, asked, monkeypatch):
    recordings("a.npz", "b.npz", "c.npz")
    solve = scsr_opt.reconstruct

    def interrupted(recording, **given):
        if recording.name == "b":
            raise KeyboardInterrupt
        return solve(recording, **given)

    monkeypatch.setattr(scsr_opt, "reconstruct", interrupted)
    assert main(["batch", "*.npz", "-o", "out", "--scale", "1"]) == 130
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == "1 of 3 pictures written." and "interrupted." in said.err
    assert files("out") == ["a.json", "a.png"]


def test_batch_of_several_folders_keeps_them_apart(batch, recordings, asked):
    """Their names may be the same, and hold anything."""
    recordings("in/one/spikes.npz", "in/two [x]/spikes.npz", "in/a b é.npz")
    batch("in/**/*.npz", "in/two [x]/spikes.npz", "in/one/spikes.npz", "-o", "out", "--scale", "1", "--quiet")
    assert [name for name in files("out") if name.endswith("png")] == [
        "a b é.png",
        "one/spikes.png",
        "two [x]/spikes.png",
    ]
    assert len(asked) == 3


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["-o", "out"], "scsr batch needs FILE, which is missing"),
        (["a.npz"], "--output"),
        (["a.npz", "-o", "out", "--format", "gif"], "--format"),
        (["a.npz", "-o", "out", "--scale", "0"], "--scale is 0"),
        (["a.npz", "-o", "out", "--frames", "-1"], "--frames is -1"),
        (["a.npz", "-o", "out", "--iterations", "0"], "--iterations is 0"),
        (["a.npz", "-o", "out", "--white", "-1"], "white is -1"),
        (["a.npz", "-o", "out", "--white", "1", "--format", "tif"], "--white is for 8-bit pictures"),
        (["a.npz", "a.npy", "-o", "out"], "a.npz and a.npy would have the same picture, out/a.png"),
        (["none.npz", "b*.npz", "-o", "out"], "none.npz: There is no file"),
        (["a.npz", "-o", "a.npz"], "--output a.npz is a file, but pictures go into a folder"),
        (["a.npz", "-o", ".", "--format", "npz", "--overwrite"], "is the file that is read"),
        (["a.npz", "-o", "out", "--key", "99"], "Key frame 99 is not in"),
        (["a.npz", "-o", "out", "--crop", "0,0,99,99"], "does not lie in"),
        (["a.npz", "-o", "out", "--motion", "north"], "--motion north is not known"),
        (["a.npz", "--evry", "-o", "out"], "Unknown option"),
    ],
)
def test_batch_refuses_and_leaves_nothing(batch, here, recordings, asked, given, message):
    recordings("a.npz", "a.npy")
    _, errors = batch(*given, "--quiet", code=2)
    assert message in errors[0] and sorted(os.listdir(here)) == ["a.npy", "a.npz"] and not asked


def test_batch_end_to_end(batch, recordings, here):
    """By real solves, which equal those one by one."""
    recordings("a.npz")
    Path("b.npz").write_bytes(b"")
    options = ["--scale", "2", "--frames", "21", "--motion", "global", "--strength", "0.01", "--format", "npz"]
    batch("*.npz", "-o", "out", *options, code=1)
    motion, recording = Global(), read_recording("a.npz")
    expected = reconstruct(recording, scale=2, frames=21, motion=motion, strength=0.01)
    np.testing.assert_array_equal(read_picture("out/a.npz"), expected.image)
