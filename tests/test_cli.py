"""`scsr` as its user meets it: what it prints, what it writes, how it ends."""

import json
import os
import re
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import scsr_opt
from scsr_opt.camera import Recording, read_recording, tfp, write_recording
from scsr_opt.cli import main
from scsr_opt.errors import InputError
from scsr_opt.motion import ILK, TVL1, Dense, Global, PhaseCorrelation, Still
from scsr_opt.priors.total_variation import TotalVariation
from scsr_opt.report import bicubic, read_picture
from scsr_opt.solvers import FISTA, ISTA, JaxoptFISTA, JaxoptISTA, Result, Solution, Stage

FRAMES, HEIGHT, WIDTH = 31, 24, 40


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    """Every test starts in an empty folder of its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def spikes() -> np.ndarray:
    """A ramp of firing rates from 0 at the left to 0.6 at the right, without noise."""
    rate = np.linspace(0.0, 0.6, WIDTH)
    charge = np.floor(np.arange(FRAMES + 1)[:, None] * rate + 1e-9)
    return np.broadcast_to(np.diff(charge, axis=0)[:, None, :], (FRAMES, HEIGHT, WIDTH)).astype(np.uint8)


@pytest.fixture
def file(here, spikes) -> str:
    write_recording("ramp.npz", Recording.from_array(spikes, white_rate=0.6))
    return "ramp.npz"


@pytest.fixture
def asked(monkeypatch) -> list[dict]:
    """Puts a quick stand-in in the place of `reconstruct`; returns what it was called with."""
    calls: list[dict] = []

    def stand_in(spikes, *, scale, key, progress, **others):
        calls.append({"spikes": spikes, "scale": scale, "key": key, **others})
        progress.start(2, "Solving")
        progress.advance(2)
        progress.finish()
        image = np.kron(tfp(spikes, key, white_rate=spikes.white_rate), np.ones((scale, scale), np.float32))
        stages = tuple(Stage(t, 1.0 / t, 0.5 / t, 0.5 / t, 0.1**t, 0.5) for t in (1, 2))
        velocity = np.zeros((2, *image.shape), np.float32)[:, ::scale, ::scale]
        return Solution(image, stages, Result.converged, {"iterations": 2}, velocity)

    monkeypatch.setattr(scsr_opt, "reconstruct", stand_in, raising=False)
    return calls


def run(capsys, *arguments: object, code: int = 0) -> str:
    """Runs `scsr`, wants this exit code, and returns what went to standard output (0) or standard error (others)."""
    assert main([str(argument) for argument in arguments]) == code
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    if code == 0:
        assert said.err == ""
        return said.out
    assert said.out == ""
    assert said.err.startswith("scsr: error: ") and said.err.count("\n") == 1, said.err
    return said.err


# ---- help ------------------------------------------------------------------------------------------------------------


def test_help_comes_at_once_and_without_jax():
    program = (
        "import sys, scsr_opt.cli as c; c.main(['--help']); sys.exit('jax' in sys.modules or 'numpy' in sys.modules)"
    )
    started = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "solve" in done.stdout
    assert time.perf_counter() - started < 5  # half a second on an idle machine; what is heavy takes longer than this


@pytest.mark.parametrize("command", ["info", "simulate", "play", "solve", "demo"])
def test_help_of_every_command(capsys, command):
    said = run(capsys, command, "--help")
    assert f"scsr {command}" in said
    if command in ("info", "play", "solve"):
        assert "Spikes per frame" in said and "Hz" in said  # units
    if command in ("simulate", "solve"):
        assert "sensor pixels per frame" in " ".join(said.replace("│", " ").split())


def test_version(capsys):
    assert run(capsys, "--version").strip() == "0.1.0"


def test_entry_point_is_installed(here):
    done = subprocess.run(
        [Path(sys.executable).with_name("scsr"), "info", "nothing.npz"], capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("scsr: error: There is no file") and done.stderr.count("\n") == 1


# ---- wrong arguments -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["explode"], 'Unknown command "explode"'),
        (["info"], "requires an argument"),
        (["info", "a.npz", "b.npz"], r"Unused Tokens: \['b.npz'\]"),
        (["info", "a.npz", "--colour"], "Unknown option: --colour"),
        (["solve", "a.npz"], "--output requires"),
        (["solve", "a.npz", "-o", "a.png", "--scale", "four"], '"four".*int'),
        (["play", "a.npz", "--method", "magic"], "magic"),
        (["simulate", "-o", "a.npz", "--velocity", "1"], "velocity"),
    ],
)
def test_wrong_arguments(capsys, arguments, message):
    said = run(capsys, *arguments, code=2)
    assert re.search(message, said), said


def test_interrupting_says_so(capsys, monkeypatch, file):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("scsr_opt.camera.read_recording", interrupt)
    assert "interrupted." in run(capsys, "info", file, code=130)


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (MemoryError(), "there is not enough memory for this; take fewer frames (--frames) or a smaller --scale."),
        (OSError(28, "No space left on device", "x.npz"), "x.npz: No space left on device."),
        (OSError(5, "Input/output error"), "Input/output error."),
        (InputError("strength is\n-1"), "strength is -1"),
        (ValueError("odd"), "ValueError: odd (a fault of the program; SCSR_TRACEBACK=1 shows where)"),
        (TypeError("odd"), "TypeError: odd (a fault of the program; SCSR_TRACEBACK=1 shows where)"),
    ],
)
def test_errors_are_one_line(capsys, monkeypatch, file, error, sentence):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("scsr_opt.camera.read_recording", fail)
    assert run(capsys, "info", file, code=2) == f"scsr: error: {sentence}\n"
    monkeypatch.setenv("SCSR_TRACEBACK", "1")
    with pytest.raises(type(error)):
        main(["info", file])


def test_the_project_s_warnings_are_one_line_and_others_silent(capsys, monkeypatch, file):
    real = read_recording

    def warn(*arguments, **options):
        warnings.warn_explicit("the last frame\nis cut short", UserWarning, "scsr_opt/camera/formats.py", 1)
        warnings.warn_explicit("old name", DeprecationWarning, "elsewhere/library.py", 1)
        return real(*arguments, **options)

    monkeypatch.setattr("scsr_opt.camera.read_recording", warn)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main(["info", file]) == 0
    assert capsys.readouterr().err == "scsr: warning: the last frame is cut short\n"


def test_a_reader_that_stops_reading_is_no_error(file):
    program = "import sys; from scsr_opt.cli import main; sys.exit(main(['info', 'ramp.npz']))"
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stderr is not None
    child.stdout.close()
    assert child.stderr.read() == "" and child.wait() == 0
    child.stderr.close()


# ---- info ------------------------------------------------------------------------------------------------------------


def test_info(capsys, file, spikes):
    said = run(capsys, "info", file)
    assert "40 x 24 pixels" in said and "31 at 40000 Hz = 0.775 ms" in said
    assert f"{spikes.sum():,}, {spikes.mean():.4g} per pixel and frame" in said
    assert f"never fired: {(spikes.sum(0) == 0).sum()}" in said
    assert run(capsys, "info", file, "--quiet") == ""


def test_info_as_json(capsys, here, spikes):
    flat = here / "ramp_40x24.dat"
    write_recording(flat, Recording.from_array(spikes))
    facts = json.loads(run(capsys, "info", flat, "--json", "--white-rate", "0.5", "--readout-rate", "20000"))
    assert facts["frames"] == FRAMES and facts["width"] == WIDTH and facts["height"] == HEIGHT
    assert facts["spikes"] == spikes.sum() and facts["stored_bottom_up"] is True
    assert facts["white_rate"] == 0.5 and facts["duration"] == pytest.approx(FRAMES / 20000)
    assert facts["rate_high"] == pytest.approx(spikes.mean(0).max(), rel=0.01)


def test_info_counts_a_long_recording_in_windows(capsys, monkeypatch, here):
    spikes = np.zeros((700, 250, 400), np.uint8)
    spikes[::3, 10] = 1
    write_recording(here / "long_400x250.dat", Recording.from_array(spikes))
    largest = []
    real = Recording.window
    monkeypatch.setattr(
        Recording,
        "window",
        lambda self, a, b: (largest.append((b - a) * self.height * self.width), real(self, a, b))[1],
    )
    facts = json.loads(run(capsys, "info", "long_400x250.dat", "--json"))
    assert facts["spikes"] == spikes.sum() and max(largest) <= 32 << 20 and len(largest) > 1


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npz", None, "There is no file"),
        ("a.dat", b"", "is empty"),
        ("a.dat", b"\0" * 100, "The size of the frames in a.dat is not known"),
        ("a.npz", b"garbage", "a.npz"),
        ("a.xyz", b"\0", r"a.xyz"),
    ],
)
def test_files_that_cannot_be_read(capsys, here, name, content, message):
    if content is not None:
        (here / name).write_bytes(content)
    assert message in run(capsys, "info", name, code=2)


def test_reading_options_are_passed_on(capsys, here, spikes):
    (here / "raw.dat").write_bytes(np.packbits(spikes, axis=2, bitorder="little").tobytes())
    np.savez(here / "odd.npz", light=spikes)
    np.save(here / "bad.npy", np.eye(HEIGHT, WIDTH, dtype=bool))
    facts = json.loads(
        run(capsys, "info", "raw.dat", "--size", "40x24", "--no-flip", "--bad-pixels", "bad.npy", "--json")
    )
    assert facts["stored_bottom_up"] is False and facts["bad_pixels"] == HEIGHT
    assert json.loads(run(capsys, "info", "odd.npz", "--array", "light", "--json"))["spikes"] == spikes.sum()
    assert "row_bits" in run(capsys, "info", "odd.npz", "--row-bits", "48", code=2)
    assert "nowhere.npy" in run(capsys, "info", "odd.npz", "--array", "light", "--bad-pixels", "nowhere.npy", code=2)


# ---- play ------------------------------------------------------------------------------------------------------------


def test_play_writes_the_playback(capsys, file, spikes):
    assert run(capsys, "play", file, "-o", "a.png", "--key", "12", "--bits", "16") == "a.png: frame 12 by tfp.\n"
    assert read_picture("a.png") == pytest.approx(tfp(spikes, 12, white_rate=0.6).clip(0, 1), abs=1e-4)


@pytest.mark.parametrize("method", ["tfp", "tfi", "stp"])
def test_play_has_a_name_of_its_own_for_the_picture(capsys, file, method):
    assert run(capsys, "play", file, "--method", method, "--quiet") == ""
    picture = read_picture(f"ramp_{method}.png")
    assert picture.shape == (HEIGHT, WIDTH) and picture[:, -1].mean() > 0.8 > 0.2 > picture[:, 1].mean()


def test_play_at_the_ends_of_a_recording(capsys, file, spikes):
    for key in (0, FRAMES - 1):
        run(capsys, "play", file, "-o", "a.npz", "--key", key)
        assert read_picture("a.npz") == pytest.approx(tfp(spikes, key, white_rate=0.6), abs=1e-6)


def test_play_a_film(capsys, file):
    said = run(capsys, "play", file, "-o", "a.gif", "--start", "5", "--stop", "20", "--step", "5", "--window", "7")
    assert said == "a.gif: 3 pictures of frames 5 to 15, every 5.\n"
    with Image.open("a.gif") as film:
        assert film.size == (WIDTH, HEIGHT)
        assert film.n_frames in (1, 3)  # pyright: ignore[reportAttributeAccessIssue] (equal frames may be merged)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "a.jpg"], "its ending is '.jpg', but pictures end in .png"),
        (["-o", "missing/a.png"], "the folder missing does not exist"),
        (["-o", "ramp.npz"], "--output ramp.npz is the file that is read"),
        (["--key", "31"], "Key frame 31 is not in ramp, which has 31 frames"),
        (["--key", "-1"], "Key frame -1 is not in ramp"),
        (["--window", "0"], "--window is 0"),
        (["--bits", "12"], "12 bits per pixel cannot be stored in .png"),
        (["--gamma", "0"], "gamma is 0"),
        (["-o", "a.gif", "--key", "3"], "--key and --bits are for pictures, but a.gif is a film"),
        (["-o", "a.gif", "--start", "20", "--stop", "10"], "A film from frame 20 to 10"),
        (["-o", "a.gif", "--stop", "32"], "choose 0 <= --start < --stop <= 31"),
        (["-o", "a.gif", "--step", "0"], "--step is 0"),
        (["-o", "a.gif", "--rate", "0"], "--rate is 0"),
    ],
)
def test_play_refuses(capsys, here, file, options, message):
    assert message in run(capsys, "play", file, *options, code=2)
    assert os.listdir(here) == ["ramp.npz"]


def test_play_mp4_without_an_encoder(capsys, monkeypatch, file):
    monkeypatch.setenv("PATH", "")
    assert "needs the program ffmpeg" in run(capsys, "play", file, "-o", "a.mp4", code=2)


# ---- simulate --------------------------------------------------------------------------------------------------------


@pytest.fixture
def picture(here) -> str:
    rows, columns = np.mgrid[0:48, 0:64]
    Image.fromarray((127 + 100 * np.sin(rows / 5) * np.cos(columns / 7)).astype(np.uint8)).save(here / "waves.png")
    return "waves.png"


def test_simulate_and_read_back(capsys, picture):
    said = run(
        capsys, "simulate", picture, "-o", "rec.npz", "--scale", "2", "--frames", "40", "--velocity", "-0.1", "0.2",
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
def test_simulate_every_scene(capsys, picture, scene):
    images = [picture, "sample:camera"] if scene in ("object", "disc") else [picture]
    run(capsys, "simulate", *images, "-o", "rec.npz", "--scene", scene, "--frames", "20", "--true-velocity", "v.npy")
    moves = np.abs(np.load("v.npy")).max() > 0.01
    assert moves == (scene != "static") and 0.05 < read_recording("rec.npz").spikes.mean() < 0.6


def test_simulate_video(capsys, here, picture):
    for number in range(3):
        Image.fromarray(np.roll(np.asarray(Image.open(picture)), number, axis=1)).save(f"frame{number}.png")
    frames = [f"frame{number}.png" for number in range(3)]
    run(capsys, "simulate", *frames, "-o", "a.npz", "--scene", "video", "--readouts", "8", "--frames", "17")
    (here / "clip").mkdir()
    for name in frames:
        os.rename(name, here / "clip" / name)
    run(capsys, "simulate", "clip", "-o", "b.npz", "--scene", "video", "--readouts", "8", "--frames", "17")
    assert (read_recording("a.npz").spikes == read_recording("b.npz").spikes).all()


def test_simulate_marks_bad_pixels(capsys, picture):
    run(capsys, "simulate", picture, "-o", "rec.h5", "--dead", "0.1", "--hot", "0.05", "--frames", "5", "--seed", "3")
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
def test_simulate_refuses(capsys, here, picture, images, options, message):
    output = [] if "-o" in options else ["-o", "rec.npz"]
    assert message in run(capsys, "simulate", *images, *output, *options, code=2)
    assert os.listdir(here) == ["waves.png"]


# ---- solve -----------------------------------------------------------------------------------------------------------


def test_solve_writes_all_that_was_asked_for(capsys, file, asked, spikes):
    said = run(
        capsys, "solve", file, "--scale", "2", "--key", "10", "-o", "a.png", "--report", "a.json", "--figure", "f.png"
    )  # fmt: skip
    lines = said.splitlines()
    assert lines[0] == "ramp: 31 frames of 40x24, key frame 10 -> 80x48 (x2)"
    assert lines[2].startswith("2 iterations in ") and lines[2].endswith("The picture meets the tolerance.")
    assert lines[3:] == ["a.png", "a.json", "f.png"]
    (call,) = asked
    assert (np.asarray(call["spikes"]) == spikes).all() and call["spikes"].white_rate == 0.6
    assert call["key"] == 10 and call["scale"] == 2 and call["frames"] == 101
    assert call.keys() == {"spikes", "scale", "key", "frames"}  # the rest is left to the defaults
    wanted = np.kron(tfp(spikes, 10, white_rate=0.6), np.ones((2, 2))).clip(0, 1)
    assert read_picture("a.png") == pytest.approx(wanted, abs=0.5 / 255 + 1e-6)
    told = json.loads(Path("a.json").read_text())
    assert (
        told["picture"]["scale"] == 2 and told["picture"]["key"] == 10 and told["seconds"].keys() == {"read", "solve"}
    )
    with Image.open("f.png") as figure:
        assert figure.width >= 1000 and figure.height >= 500


def test_solve_is_silent_when_asked(capsys, file, asked):
    assert run(capsys, "solve", file, "-o", "a.png", "-q") == ""


def test_solve_takes_frames_around_the_key(capsys, file, asked):
    run(capsys, "solve", file, "-o", "a.npz", "--key", "28", "--frames", "11")
    (call,) = asked
    assert call["key"] == 28 and call["frames"] == 11
    with np.load("a.npz") as stored:
        assert stored["key"] == 28 and stored["scale"] == 4 and stored["velocity"].shape == (2, HEIGHT, WIDTH)


@pytest.mark.parametrize(
    ("motion", "expected"), [("-0.1,0.25", (-0.1, 0.25)), ("0.5,-1", (0.5, -1)), ("v.npy", (2, 3))]
)
def test_solve_takes_a_motion(capsys, here, file, asked, motion, expected):
    field = np.zeros((2, HEIGHT, WIDTH))
    field[0], field[1] = 2, 3
    np.save(here / "v.npy", field)
    run(capsys, "solve", file, "-o", "a.png", "--motion", motion)
    velocity = asked[0]["velocity"]
    assert velocity.shape == (2, HEIGHT, WIDTH) and velocity.dtype == np.float32
    assert velocity[0] == pytest.approx(expected[0]) and velocity[1] == pytest.approx(expected[1])


@pytest.mark.parametrize(
    ("options", "name", "value"),
    [
        (["--motion", "none"], "velocity", Still()),
        (["--motion", "global"], "velocity", Global()),
        (["--motion", "dense"], "velocity", Dense()),
        (["--motion", "phase"], "velocity", PhaseCorrelation()),
        (["--motion", "ilk"], "velocity", ILK()),
        (["--motion", "tvl1"], "velocity", TVL1()),
        (["--prior", "tv-anisotropic"], "prior", TotalVariation(isotropic=False)),
        (["--solver", "ista"], "solver", ISTA()),
        (["--solver", "jaxopt-ista"], "solver", JaxoptISTA()),
        (["--solver", "jaxopt-fista"], "solver", JaxoptFISTA()),
        (["--iterations", "7"], "solver", FISTA(iterations=7)),
        (["--strength", "0.5"], "strength", 0.5),
    ],
)
def test_solve_passes_choices_on(capsys, file, asked, options, name, value):
    run(capsys, "solve", file, "-o", "a.png", *options)
    assert type(asked[0][name]) is type(value) and asked[0][name] == value
    assert asked[0].keys() == {"spikes", "scale", "key", "frames", name}


def test_solve_passes_bad_pixels_on(capsys, here, file, asked):
    np.save(here / "bad.npy", np.eye(HEIGHT, WIDTH, dtype=bool))
    run(capsys, "solve", file, "-o", "a.png", "--bad-pixels", "bad.npy")
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
        (["-o", "a.png", "--iterations", "0"], "--iterations is 0"),
        (["-o", "a.png", "--strength", "-1"], "--strength is -1"),
        (["-o", "a.png", "--motion", "fast"], "--motion fast is not known"),
        (["-o", "a.png", "--motion", "1,2,3"], "--motion 1,2,3 is not known"),
        (["-o", "a.png", "--motion", "nan,0"], "--motion nan,0 is not known"),
        (["-o", "a.png", "--motion", "gone.npy"], "--motion gone.npy cannot be read"),
        (["-o", "a.png", "--motion", "small.npy"], "but a velocity is (2, 24, 40)"),
        (["-o", "a.png", "--bad-pixels", "small.npy"], "(24, 40)"),
        (["-o", "a.png", "--size", "41x24"], "41x24"),
    ],
)
def test_solve_refuses_before_it_starts(capsys, here, file, asked, options, message):
    np.save(here / "small.npy", np.zeros((2, 3)))
    assert message in run(capsys, "solve", file, *options, code=2)
    assert asked == [] and sorted(os.listdir(here)) == ["ramp.npz", "small.npy"]


def test_a_failed_solve_writes_no_picture(capsys, here, monkeypatch, file):
    def fail(spikes, *, scale, **_):
        return Solution(np.full((96, 160), np.nan, np.float32), (), Result.no_samples)

    monkeypatch.setattr(scsr_opt, "reconstruct", fail, raising=False)
    (here / "a.png").write_text("the old one")
    said = run(capsys, "solve", file, "-o", "a.png", "--report", "a.json", "--figure", "f.png", code=1)
    assert said == f"scsr: error: {Result.no_samples.sentence} No picture was written.\n"
    assert sorted(os.listdir(here)) == ["a.json", "a.png", "ramp.npz"] and (here / "a.png").read_text() == "the old one"
    assert json.loads((here / "a.json").read_text())["result"]["name"] == "no_samples"


def test_a_picture_that_is_not_finite_is_an_error(capsys, here, monkeypatch, file):
    def lie(spikes, *, scale, **_):
        return Solution(np.full((96, 160), np.nan, np.float32), (), Result.converged)

    monkeypatch.setattr(scsr_opt, "reconstruct", lie, raising=False)
    assert "are not finite, so it is not written" in run(capsys, "solve", file, "-o", "a.png", code=2)
    assert os.listdir(here) == ["ramp.npz"]


def test_what_reconstruct_refuses_is_one_line(capsys, monkeypatch, file):
    def refuse(*_, **__):
        raise InputError("The scale is 5000, but the picture would not fit into memory.")

    monkeypatch.setattr(scsr_opt, "reconstruct", refuse, raising=False)
    assert "would not fit" in run(capsys, "solve", file, "-o", "a.png", "--scale", "5000", code=2)


def test_from_a_picture_to_a_sharper_one_than_playback(capsys, here):
    """The whole path with nothing replaced: simulate, solve, compare with the truth."""
    run(
        capsys, "simulate", "sample:camera", "-o", "rec.npz", "--scale", "8", "--velocity", "0.1", "0.15",
        "--truth", "large.png",
    )  # fmt: skip
    run(capsys, "solve", "rec.npz", "--scale", "2", "-o", "a.png", "--figure", "f.png", "--report", "a.json")
    run(capsys, "play", "rec.npz", "-o", "played.png")
    truth = read_picture("large.png").reshape(128, 4, 128, 4).mean(axis=(1, 3))
    enlarged = bicubic(read_picture("played.png"), 2)
    error, played = (np.abs(image - truth)[16:-16, 16:-16].mean() for image in (read_picture("a.png"), enlarged))
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
def test_real_recordings(capsys, shared_data, name, size):
    run(capsys, "solve", shared_data / "recordings" / name, "--scale", "2", "--frames", "101", "-o", "a.png")
    with Image.open("a.png") as picture:
        assert picture.size == size
        assert np.asarray(picture).std() > 5


# ---- demo ------------------------------------------------------------------------------------------------------------


def test_demo(capsys, here, asked):
    said = run(capsys, "demo", "-o", "made/here")
    assert sorted(os.listdir(here / "made" / "here")) == [
        "figure.png", "picture.png", "recording.npz", "report.json", "truth.png",
    ]  # fmt: skip
    assert "PSNR against the truth" in said and "Look at made/here/figure.png" in said


def test_demo_where_nothing_can_be_written(capsys, here):
    (here / "demo_output").write_text("a file")
    assert "The folder demo_output cannot be made: file exists" in run(capsys, "demo", code=2)
