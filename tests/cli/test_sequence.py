"""`scsr sequence` and `scsr export`."""

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scsr_opt.report import read_picture
from scsr_opt.sequences import SequenceStore

FRAMES, HEIGHT, WIDTH = 31, 24, 40  # of the fixture `spikes`

pytestmark = pytest.mark.usefixtures("sequences")


def test_sequence_of_one_picture_is_spoken_of_as_one(scsr, file):
    said = scsr("sequence", file, "-o", "a.gif", "--scale", "2", "--start", "4", "--stop", "5").splitlines()
    assert said[0] == "a.gif has 1 picture, of frame 4."
    assert said[1].startswith("1 picture solved for, ")
    assert said[2] == "Motion was estimated once, at frame 4."


def test_sequence_film_says_where_motion_was_found_anew_and_how_slow_it_is(scsr, here, file, sequences):
    given = ("--scale", "2", "--start", "4", "--stop", "12", "--every", "2", "--rate", "10")
    said = scsr("sequence", file, "-o", "a.gif", *given).splitlines()
    assert said[0] == "a.gif has 4 pictures, of frames 4 to 10, every 2."
    assert said[2] == "Motion was estimated 2 times, at frames 4, 8, and carried on between."
    assert said[-1] == "1 s of the film is 500 µs of the recording."
    with Image.open("a.gif") as film:
        assert film.size == (2 * WIDTH, 2 * HEIGHT)
        assert film.n_frames == 4  # pyright: ignore[reportAttributeAccessIssue]
    (call,) = sequences
    assert call["keys"] == [4, 6, 8, 10] and call["scale"] == 2 and call["options"].frames == 101
    assert sorted(os.listdir(here)) == ["a.gif", "ramp.npz"]


def test_sequence_hands_on_what_is_to_be_solved(scsr, file, sequences):
    options = ["--frames", "21", "--strength", "0.3", "--motion", "global", "--every", "10", "--group", "3"]
    assert scsr("sequence", file, "-o", "out", *options, "--bits", "32", "--scale", "1", "--quiet") == ""
    assert [call["keys"] for call in sequences] == [[0, 10, 20], [30]]
    given = sequences[0]["options"]
    assert given.frames == 21 and given.strength == 0.3 and type(given.motion).__name__ == "Global"
    assert sorted(os.listdir("out/images")) == ["000000.tif", "000010.tif", "000020.tif", "000030.tif"]
    np.testing.assert_allclose(read_picture("out/images/000020.tif"), 20 / FRAMES, rtol=1e-6)


def test_sequence_takes_about_25_pictures(scsr, file, sequences):
    scsr("sequence", file, "-o", "a.gif", "--quiet", "--stop", "12", "--scale", "1")
    assert [key for call in sequences for key in call["keys"]] == list(range(12))


def test_sequence_that_is_there_is_said_to_be(scsr, file, sequences):
    given = ("sequence", file, "-o", "a.zarr", "--every", "10", "--scale", "1")
    scsr(*given)
    del sequences[:]
    said = scsr(*given).splitlines()
    assert said[:2] == [
        "a.zarr has 4 pictures, of frames 0 to 30, every 10.",
        "4 pictures had been there before.",
    ]
    assert sequences == []


def test_sequence_of_which_a_picture_fails_says_so_and_keeps_the_others(scsr, file, capsys):
    """The exit code is 1; a film shows it black, and has as many pictures as were asked for."""
    given = ("--start", "11", "--stop", "16", "--every", "1", "--scale", "1", "--quiet")
    said = scsr("sequence", file, "-o", "a.zarr", *given, code=1)
    message = "1 of 5 pictures could not be solved for, at frame 13: a value that is not finite appeared"
    assert message in said
    for output in ("a.gif", "a.npz", "out"):
        assert message in scsr("export", "a.zarr", "-o", output, "--quiet", code=1)
    with Image.open("a.gif") as film:
        assert film.n_frames == 5  # pyright: ignore[reportAttributeAccessIssue]
        film.seek(2)
        assert np.asarray(film.convert("L")).max() == 0
    with np.load("a.npz") as stored:
        assert np.isnan(stored["image"][2]).all() and np.isfinite(np.delete(stored["image"], 2, 0)).all()
        assert stored["status"].tolist() == ["converged", "converged", "non_finite", "converged", "converged"]
    assert len(os.listdir("out/images")) == 4
    assert Path("out/times.csv").read_text().splitlines()[3].startswith("2,,13,")


def test_sequence_without_motion_says_nothing_of_it(scsr, file, sequences):
    said = scsr("sequence", file, "-o", "a.zarr", "--every", "10", "--scale", "1", "--motion", "none")
    assert "Motion" not in said and "4 pictures solved for" in said


def test_sequence_without_any_picture_is_a_failure(scsr, here, file):
    said = scsr("sequence", file, "-o", "a.gif", "--start", "13", "--stop", "14", code=1)
    assert "1 of 1 picture could not be solved for, at frame 13: a value that is not finite appeared" in said
    assert os.listdir(here) == ["ramp.npz"]
    scsr("sequence", file, "-o", "a.zarr", "--start", "13", "--stop", "14", code=1)
    said = scsr("export", "a.zarr", "-o", "a.gif", code=2)
    assert "a.zarr has no picture that can be used: all 1 solves failed" in said


@pytest.mark.parametrize("name", ["two words.zarr", "a:b.zarr", "Straße 電影.zarr", "-dash.zarr", "a..zarr", "A.ZARR"])
def test_sequence_odd_names_of_stores(scsr, here, file, name):
    given = ("sequence", file, f"--output={name}", "--every", "10", "--scale", "1", "--quiet")
    assert scsr(*given) == "" and scsr(*given) == ""
    assert sorted(os.listdir(here)) == sorted(["ramp.npz", name])
    assert scsr("export", f"./{name}", "-o", "b.npy", "--quiet") == ""


REFUSED = [
    (["-o", "a.png"], "its ending is '.png', but sequences end in .zarr, .npz, .npy, .gif or .mp4, or are a folder"),
    (["-o", "a.tif"], "its ending is '.tif'"),
    (["-o", "a.avi"], "its ending is '.avi'"),
    (["-o", "."], "Cannot tell the format of ."),
    (["-o", ""], "Cannot tell the format of"),
    ([], "--output"),
    (["-o", "a.gif", "--rate", "0"], "rate is 0"),
    (["-o", "a.gif", "--rate", "1e-9"], "rate is 1e-09, but it must be from 0.01 to 1000 pictures per second"),
    (["-o", "a.gif", "--rate", "nan"], "rate is nan"),
    (["-o", "a.zarr", "--rate", "5"], "rate is for films, but a.zarr is none"),
    (["-o", "out", "--rate", "5"], "rate is for films, but out is none"),
    (["-o", "a.gif", "--gamma", "-1"], "gamma is -1"),
    (["-o", "a.npz", "--gamma", "2.2"], "gamma is for what is looked at, but a.npz holds linear intensity"),
    (["-o", "out", "--bits", "32", "--gamma", "2.2"], "32-bit pictures hold linear intensity"),
    (["-o", "out", "--bits", "12"], "bits is 12, but the pictures of a folder have 8, 16 or 32"),
    (["-o", "out", "--bits", "8.5"], "is not a whole number"),
    (["-o", "a.zarr", "--bits", "8"], "bits is for a folder of pictures, but a.zarr is none"),
    (["-o", "a.gif", "--white", "-1"], "white is -1"),
    (["-o", "a.gif", "--white", "nan"], "white is nan"),
    (["-o", "a.zarr", "--scale", "0"], "--scale is 0"),
    (["-o", "a.zarr", "--scale", "-2"], "--scale is -2"),
    (["-o", "a.zarr", "--scale", "1.5"], "is not a whole number"),
    (["-o", "a.zarr", "--scale", "100000"], "take a smaller scale"),
    (["-o", "a.zarr", "--frames", "0"], "--frames is 0"),
    (["-o", "a.zarr", "--group", "0"], "--group is 0"),
    (["-o", "a.zarr", "--workers", "0"], "--workers is 0"),
    (["-o", "a.zarr", "--workers", "-1"], "--workers is -1"),
    (["-o", "a.zarr", "--workers", "two"], "is not a whole number"),
    (["-o", "a.zarr", "--workers", "2", "--scheduler", "tcp://a:1"], "give one of the two"),
    (["-o", "a.zarr", "--start", "31"], "Frames 31 to 31 (excluded) are not in the recording"),
    (["-o", "a.zarr", "--start", "-1"], "Frames -1 to 31 (excluded) are not in the recording"),
    (["-o", "a.zarr", "--stop", "32"], "choose 0 <= --start < --stop <= 31"),
    (["-o", "a.zarr", "--stop", "0"], "--start is 0 and --stop is 0, but frames go"),
    (["-o", "a.zarr", "--start", "9", "--stop", "3"], "--start is 9 and --stop is 3, but frames go"),
    (["-o", "a.zarr", "--every", "0"], "--every is 0"),
    (["-o", "a.zarr", "--every", "-5"], "--every is -5"),
    (["-o", "a.zarr", "--step", "5"], "--step"),
    (["-o", "a.zarr", "--key", "5"], "--key"),
    (["-o", "a.zarr", "--strength", "-1"], "--strength is -1"),
    (["-o", "a.zarr", "--strength", "inf"], "--strength is inf"),
    (["-o", "a.zarr", "--motion", "0.1,0"], "--motion 0.1,0 is the velocity at one moment"),
    (["-o", "a.zarr", "--motion", "north"], "--motion north is not known"),
    (["-o", "a.zarr", "--prior", "nothing"], "--prior"),
    (["-o", "a.zarr", "--solver", "none"], "--solver"),
    (["-o", "a.zarr", "--iterations", "0"], "--iterations is 0"),
    (["-o", "a.zarr", "--refine", "-1"], "--refine is -1"),
    (["-o", "a.zarr", "--samples", "windows:99"], "--samples is windows:99"),
    (["-o", "a.zarr", "--crop", "0,0,99,99"], "does not lie in ramp"),
    (["-o", "a.zarr", "--crop", "1,2,3"], "--crop is 1,2,3"),
    (["-o", "a.zarr", "--gain", "none.npy"], "There is no file none.npy for --gain"),
    (["-o", "a.zarr", "--gain", "much"], "--gain is much"),
    (["-o", "a.zarr", "--optics", "-1"], "--optics is -1"),
    (["-o", "a.zarr", "--bounds", "1,0"], "--bounds is 1,0"),
    (["-o", "a.zarr", "--size", "7x7"], "ramp.npz"),
    (["-o", "a.zarr", "--white-rate", "-1"], "white_rate is -1"),
    (["-o", "a.zarr", "--readout-rate", "0"], "readout_rate is 0"),
    (["-o", "a.zarr", "--bad-pixels", "none.npy"], "none.npy"),
    (["-o", "a.zarr", "--calibration", "none.npz"], "none.npz"),
    (["-o", "missing/a.gif"], "the folder missing does not exist"),
    (["-o", "missing/a.zarr"], "does not exist; make it first"),
    (["-o", "missing/out"], "the folder missing does not exist"),
    (["-o", "ramp.npz"], "ramp.npz is there already"),
    (["-o", "ramp.npz", "--overwrite"], "is the file that is read"),
    (["-o", "ramp.npz/a.zarr"], "ramp.npz"),
    (["-o", "x" * 252 + ".gif"], "file name too long"),
    (["-o", "x" * 252 + ".zarr"], "file name too long"),
    (["-o", "a\0b.zarr"], "null"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED, ids=[" ".join(options)[:60] for options, _ in REFUSED])
def test_sequence_refuses(scsr, here, file, sequences, options, message):
    assert message in scsr("sequence", file, *options, code=2)
    assert os.listdir(here) == ["ramp.npz"] and not sequences


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "bad.npz"),
        (b"", "bad.npz"),
        (b"PK\x03\x04", "bad.npz"),
        (b"no recording at all" * 100, "bad.npz"),
    ],
)
def test_sequence_refuses_a_file_that_is_no_recording(scsr, here, sequences, content, message):
    if content is not None:
        Path("bad.npz").write_bytes(content)
    assert message in scsr("sequence", "bad.npz", "-o", "a.zarr", code=2)
    assert set(os.listdir(here)) <= {"bad.npz"} and not sequences


def test_sequence_refuses_a_recording_that_is_cut_short(scsr, here, file, sequences):
    Path(file).write_bytes(Path(file).read_bytes()[:-200])
    assert "ramp.npz" in scsr("sequence", file, "-o", "a.zarr", code=2)
    assert os.listdir(here) == ["ramp.npz"] and not sequences


@pytest.mark.parametrize("output", ["a.gif", "a.npz", "a.npy", "out", "a.zarr"])
def test_sequence_refuses_what_is_in_the_way(scsr, here, file, sequences, output):
    """A folder with files of somebody else is never replaced, nor a folder by a file."""
    Path(output).mkdir()
    (Path(output) / "thesis.txt").write_text("years of work")
    scsr("sequence", file, "-o", output, "--overwrite", code=2)
    assert os.listdir(output) == ["thesis.txt"] and not sequences


def test_sequence_output_folder_is_refused_and_replaced_when_asked(scsr, file):
    given = ("sequence", file, "-o", "out", "--scale", "1", "--quiet")
    scsr(*given, "--every", "10")
    assert "out is there already: give --overwrite to replace it" in scsr(*given, "--every", "15", code=2)
    scsr(*given, "--every", "15", "--overwrite")
    assert sorted(os.listdir("out/images")) == ["000000.png", "000015.png", "000030.png"]


def test_sequence_refuses_a_store_of_other_options(scsr, file):
    given = ("sequence", file, "-o", "a.zarr", "--scale", "1", "--every", "10", "--quiet")
    scsr(*given)
    said = scsr(*given, "--strength", "0.1", code=2)
    assert "a.zarr holds another sequence: strength is None there and 0.1 here" in said
    scsr(*given, "--strength", "0.1", "--overwrite")


EXPORT_REFUSED = [
    (["none.zarr", "-o", "b.gif"], "There is no store none.zarr"),
    (["ramp.npz", "-o", "b.gif"], "There is no store ramp.npz"),
    (["empty", "-o", "b.gif"], "empty is no store of a sequence"),
    (["a.zarr", "-o", "b.zarr"], "would be a store as well: copy the folder"),
    (["a.zarr", "-o", "b.png"], "its ending is '.png'"),
    (["a.zarr", "-o", "b.npz", "--bits", "16"], "bits is for a folder"),
    (["a.zarr", "-o", "b.gif", "--rate", "0"], "rate is 0"),
    (["a.zarr", "-o", "b", "--gamma", "0"], "gamma is 0"),
    (["a.zarr", "-o", "b.gif", "--white", "0"], "white is 0"),
    (["a.zarr", "-o", "there.gif"], "there.gif is there already"),
    (["a.zarr", "-o", "missing/b.gif"], "the folder missing does not exist"),
    (["a.zarr"], "--output"),
    (["-o", "b.gif"], "STORE"),
    (["half.zarr", "-o", "b.gif"], "half.zarr is not complete: 1 of its 4 pictures are missing, the first is frame 30"),
    (["hurt.zarr", "-o", "b.npz"], "hurt.zarr is damaged: image of frame 20 cannot be read"),
    (["hurt.zarr", "-o", "b.npy"], "hurt.zarr is damaged: image of frame 20 cannot be read"),
    (["hurt.zarr", "-o", "b.gif"], "hurt.zarr is damaged: image of frame 20 cannot be read"),
    (["hurt.zarr", "-o", "b"], "hurt.zarr is damaged: image of frame 20 cannot be read"),
]


@pytest.mark.parametrize(("given", "message"), EXPORT_REFUSED, ids=[" ".join(given) for given, _ in EXPORT_REFUSED])
def test_export_refuses(scsr, here, file, given, message):
    scsr("sequence", file, "-o", "a.zarr", "--scale", "1", "--every", "10", "--group", "3", "--quiet")
    shutil.copytree("a.zarr", "half.zarr")
    shutil.copytree("a.zarr", "hurt.zarr")
    os.remove("half.zarr/status/c/1")
    Path("hurt.zarr/image/c/2/0/0").write_bytes(b"hurt")
    Path("there.gif").write_bytes(b"")
    Path("empty").mkdir()
    before = sorted(os.listdir(here))
    assert message in scsr("export", *given, code=2)
    assert sorted(os.listdir(here)) == before


def test_export_mp4_without_an_encoder(scsr, file, monkeypatch):
    scsr("sequence", file, "-o", "a.zarr", "--scale", "1", "--every", "10", "--quiet")
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    said = scsr("export", "a.zarr", "-o", "a.mp4", code=2)
    assert "An MP4 needs the program ffmpeg" in said and "pip install 'scsr-opt[sequence]' brings one" in said


def test_export_of_a_store_leaves_it(scsr, file):
    scsr("sequence", file, "-o", "a.zarr", "--scale", "1", "--every", "10", "--quiet")
    assert scsr("export", "a.zarr", "-o", "b.npz") == "b.npz: 4 pictures of a.zarr.\n"
    assert SequenceStore.open("a.zarr").pictures()[3].key == 30
