"""Rules for every command that writes: nothing is overwritten unasked, and odd names are names."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

COMMANDS = {
    "solve": ("solve ramp.npz -o a.png --report a.json --figure f.pdf", ["a.png", "a.json", "f.pdf"]),
    "sequence": ("sequence ramp.npz -o a.gif --every 10", ["a.gif"]),
    "sequence of numbers": ("sequence ramp.npz -o a.npy --every 10 --scale 1", ["a.npy", "a.csv"]),
    "play": ("play ramp.npz -o a.tif", ["a.tif"]),
    "play by default": ("play ramp.npz --method tfi", ["ramp_tfi.png"]),
    "play a film": ("play ramp.npz -o a.gif --step 10", ["a.gif"]),
    "baseline": ("baseline ramp.npz --method tfp-bicubic --scale 1 -o a.npz", ["a.npz"]),
    "simulate": (
        "simulate flat.png -o r.h5 --frames 5 --truth t.png --true-velocity v.NPY",
        ["r.h5", "t.png", "v.NPY"],
    ),
    "demo": ("demo -o .", ["recording.npz", "report.json", "truth.png", "picture.png", "figure.png"]),
}
"""By command: how it is called, and what it writes."""

every_output = pytest.mark.parametrize(
    ("command", "output"), [(command, name) for command, (_, names) in COMMANDS.items() for name in names]
)


@pytest.fixture(autouse=True)
def flat(asked, sequences, file) -> None:
    """Stand-ins for the work, and what it is done on: the recording ramp.npz and the picture flat.png."""
    Image.fromarray(np.full((48, 64), 100, np.uint8)).save("flat.png")


@every_output
def test_an_output_that_is_there_is_refused_before_the_work(scsr, asked, sequences, command, output):
    Path(output).write_text("old")
    there = sorted(os.listdir())
    said = scsr(*COMMANDS[command][0].split(), code=2)
    assert f"{output} is there already: give --overwrite to replace it, or another name." in said
    assert asked == sequences == [] and sorted(os.listdir()) == there and Path(output).read_text() == "old"


@pytest.mark.parametrize("command", COMMANDS)
def test_outputs_are_written_where_nothing_is_and_replaced_when_asked(scsr, command):
    arguments, outputs = COMMANDS[command]
    scsr(*arguments.split())
    assert sorted(os.listdir()) == sorted({"ramp.npz", "flat.png", *outputs})
    for output in outputs:
        Path(output).write_text("old")
    scsr(*arguments.split(), "--overwrite")
    assert sorted(os.listdir()) == sorted({"ramp.npz", "flat.png", *outputs})
    assert all(Path(output).read_bytes() != b"old" for output in outputs)


@pytest.mark.parametrize("name", ["stages.txt", "stages.json", "stages.png"])
def test_a_comparison_that_is_there_is_refused(scsr, here, name):
    (here / "out").mkdir()
    (here / "out" / name).write_text("old")
    said = scsr("compare", "ramp.npz", "--models", "fista-tv", "-o", "out", code=2)
    assert f"--output out holds {name} already: give --overwrite" in said and os.listdir("out") == [name]


def test_an_input_is_never_overwritten(scsr):
    os.symlink("ramp.npz", "link.npz")
    os.symlink("link.npz", "chain.npz")
    before = Path("ramp.npz").read_bytes()
    for output in ("ramp.npz", "./ramp.npz", "link.npz", "chain.npz"):
        said = scsr("play", "ramp.npz", "-o", output, "--overwrite", code=2)
        assert "is the file that is read" in said
    assert "is the file that is read" in scsr("play", "chain.npz", "-o", "ramp.npz", "--overwrite", code=2)
    assert Path("ramp.npz").read_bytes() == before


def test_a_link_to_a_file_counts_as_there_and_one_into_nothing_does_not(scsr):
    Path("stored").write_text("old")
    os.symlink("stored", "a.png")
    assert "a.png is there already" in scsr("play", "ramp.npz", "-o", "a.png", code=2)
    assert Path("stored").read_text() == "old"
    os.symlink("new", "b.png")
    scsr("play", "ramp.npz", "-o", "b.png")
    assert Path("b.png").is_symlink() and Path("new").read_bytes().startswith(b"\x89PNG")


NAMES = [
    "2026-11-29T08:00:00",
    " two  words ",
    "-dash",
    "--output",
    "100%d%s",
    '"it\'s"',
    "Straße 電影",
    "a#1",
    "a?b",
    "*[x]",
    "two\nlines",
    "$\\frac{x$",
    "a\\b",
    "~",
    os.fsdecode(b"\xff\xfe"),
    "x" * 250,
]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.filterwarnings("ignore:Glyph")
def test_odd_names_of_inputs_and_outputs(scsr, name):
    os.rename("ramp.npz", f"./{name}.npz")
    source = f"./{name}.npz"
    given = (f"--output={name}.png", f"--report={name}.json", f"--figure={name}.pdf", "--quiet")
    assert scsr("solve", source, *given) == ""
    assert sorted(os.listdir()) == sorted(["flat.png", *(f"{name}.{end}" for end in ("npz", "png", "json", "pdf"))])


@pytest.mark.parametrize("name", ["two\nlines", "Straße 電影", os.fsdecode(b"\xff\xfe")])
def test_a_process_says_odd_names(here, name):
    """Its standard output takes text only; bytes that are none are written as escapes."""
    program = "import sys; from scsr_opt.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "play", "ramp.npz", f"--output={name}.png"]
    done = subprocess.run(command, capture_output=True)
    assert done.returncode == 0, done.stderr
    said = name.encode("utf-8", "backslashreplace") + b".png: frame 15 by tfp.\n"
    assert done.stdout.startswith(said) and (here / f"{name}.png").is_file()


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ("x" * 252 + ".png", "file name too long"),
        ("é" * 126 + ".png", "file name too long"),
        ("flat.png/a.png", "not a directory"),
        ("missing/a.png", "the folder missing does not exist; make it first"),
        ("folder.png", "it is a folder; name a file in it"),
        ("loop.png", "it is a symbolic link that leads to itself"),
        ("null.png", "it is a device or a pipe"),
    ],
)
@pytest.mark.parametrize("command", ["solve", "play", "baseline"])
def test_what_cannot_be_written_is_refused_before_the_work(scsr, here, asked, monkeypatch, command, output, message):
    (here / "folder.png").mkdir()
    os.symlink("loop.png", "loop.png")
    os.symlink("/dev/null", "null.png")
    monkeypatch.setattr("scsr_opt.camera.read_recording", None)
    assert message in scsr(command, "ramp.npz", "-o", output, "--overwrite", code=2)
    assert asked == [] and sorted(os.listdir()) == ["flat.png", "folder.png", "loop.png", "null.png", "ramp.npz"]


def test_a_full_disk_is_one_sentence_with_the_file(scsr, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    assert (
        scsr("play", "ramp.npz", "-o", "a.png", code=2) == "scsr: error: Cannot write a.png: no space left on device.\n"
    )
    assert sorted(os.listdir()) == ["flat.png", "ramp.npz"]


def test_what_a_codec_does_to_the_size_is_said_in_a_line(here):
    """In a process of its own, as the checks of types in tests stand between a warning and whom it is for."""
    program = here / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text('#!/bin/sh\nfor last; do :; done\nexec /bin/cat > "$last"\n')
    program.chmod(0o755)
    command = [sys.executable, "-m", "scsr_opt.cli", "play", "ramp.npz", "-o", "a.mp4", "--crop", "0,0,5,9", "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PATH": str(program.parent)})
    assert done.returncode == 0 and done.stdout == "" and done.stderr.count("\n") == 1
    assert done.stderr.startswith("scsr: warning: a.mp4: the film is 10x6, for pictures of 9x5: an MP4 has even sides")
    assert Path("a.mp4").stat().st_size == 31 * 5 * 9
