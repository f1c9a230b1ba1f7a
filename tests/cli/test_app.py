"""`scsr` itself: help, wrong arguments, errors."""

import os
import re
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from scsr_opt.camera import read_recording
from scsr_opt.cli import main
from scsr_opt.errors import InputError


def test_help_comes_at_once_and_without_jax():
    program = (
        "import sys, scsr_opt.cli as c; c.main(['--help']); sys.exit('jax' in sys.modules or 'numpy' in sys.modules)"
    )
    started = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "solve" in done.stdout
    assert time.perf_counter() - started < 5  # half a second on an idle machine; what is heavy takes longer than this


@pytest.mark.parametrize(
    "command",
    [
        "info",
        "calibrate",
        "simulate",
        "play",
        "solve",
        "batch",
        "sequence",
        "export",
        "baseline",
        "demo",
        "warm",
        "cache",
        "train",
        "compare",
    ],  # fmt: skip
)
def test_help_of_every_command(scsr, command):
    said = scsr(command, "--help")
    assert f"scsr {command}" in said
    if command in ("info", "play", "solve", "batch", "sequence", "baseline", "compare"):
        assert "Spikes per frame" in said and "Hz" in said  # units
    if command in ("simulate", "solve", "batch", "sequence"):
        assert "sensor pixels per frame" in " ".join(said.replace("│", " ").split())


def test_version(scsr):
    assert scsr("--version").strip() == "0.1.0"


def test_entry_point_is_installed(here):
    done = subprocess.run(
        [Path(sys.executable).with_name("scsr"), "info", "nothing.npz"], capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("scsr: error: There is no file") and done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("variable", "value", "message"),
    [
        ("JAX_ENABLE_X64", "abc", "JAX refuses the environment's JAX_ENABLE_X64=abc: correct or unset it."),
        ("JAX_LOGGING_LEVEL", "abc", "JAX refuses the environment's JAX_LOGGING_LEVEL=abc: correct or unset it."),
        ("JAX_DEFAULT_DEVICE", "abc", "JAX refuses the environment's JAX_DEFAULT_DEVICE=abc: correct or unset it."),
        ("JAX_DEFAULT_DEVICE", "gpu", "JAX finds no device of the kind that JAX_DEFAULT_DEVICE=gpu asks for: unset"),
        ("JAX_PLATFORM_NAME", "cuda", "JAX finds no device of the kind that JAX_PLATFORM_NAME=cuda asks for: unset"),
    ],
)
def test_variable_that_jax_refuses_is_said_in_one_sentence(here, file, variable, value, message):
    program = f"import sys; from scsr_opt.cli import main; sys.exit(main(['baseline', {file!r}, '-o', 'a.png']))"
    environment = {name: text for name, text in os.environ.items() if name != "JAX_PLATFORMS"} | {variable: value}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)
    assert done.returncode == 2 and done.stderr.startswith(f"scsr: error: {message}"), done.stderr
    assert done.stderr.count("\n") == 1 and not Path("a.png").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["explode"], r'Unknown command "explode": choose from info, calibrate, simulate, .*, train\.$'),
        (["info"], "scsr info needs FILE, which is missing: The recording: .dat"),
        (["info", "a.npz", "b.npz"], r"scsr info has no use for b.npz: leave it out, or see scsr info --help"),
        (["info", "a.npz", "--colour"], "Unknown option: --colour"),
        (["solve", "a.npz", "-o", "a.png", "--strengt", "1"], r"Unknown option: --strengt; did you mean --strength\?$"),
        (
            ["solve", "a.npz", "-o", "a.png", "--prior", "magic"],
            r'Invalid value "magic" for --prior; choose from: "ridge", ',
        ),
        (["solve", "a.npz"], "scsr solve needs --output or -o, which is missing: Picture to write: .png"),
        (["solve", "a.npz", "-o"], "-o requires an argument"),
        (["solve", "a.npz", "-o", "a.png", "--scale", "four"], '--scale: "four" is not a whole number'),
        (["solve", "a.npz", "-o", "a.png", "--scale", "2.5"], '--scale: "2.5" is not a whole number'),
        (["solve", "a.npz", "-o", "a.png", "--key", "10.7"], '--key: "10.7" is not a whole number'),
        (["solve", "a.npz", "-o", "a.png", "--iterations", "1e3"], '--iterations: "1e3" is not a whole number'),
        (["baseline", "a.npz", "-o", "a.png", "--scale", "2.5"], '--scale: "2.5" is not a whole number'),
        (["play", "a.npz", "--key", "2.5"], '--key: "2.5" is not a whole number'),
        (["info", "a.npz", "--row-bits", "41.5"], '--row-bits: "41.5" is not a whole number'),
        (["simulate", "a.png", "-o", "a.npz", "--frames", "9.9"], '--frames: "9.9" is not a whole number'),
        (["play", "a.npz", "--method", "magic"], "magic"),
        (["simulate", "-o", "a.npz", "--velocity", "1"], r"--velocity needs 2 values, but got 1: DOWN RIGHT in"),
        (["simulate", "-o", "a.npz", "--velocity"], r"--velocity needs 2 values, but got 0: DOWN RIGHT in"),
    ],
)
def test_wrong_arguments(scsr, arguments, message):
    said = scsr(*arguments, code=2)
    assert re.search(message, said), said
    assert not re.search(r"[.!?]\s+[A-Z]", said.removeprefix("scsr: error: "))


def test_interrupting_says_so(scsr, monkeypatch, file):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("scsr_opt.camera.read_recording", interrupt)
    assert "interrupted." in scsr("info", file, code=130)


@pytest.mark.parametrize("while_importing", [False, True])
def test_terminating_ends_cleanly(here, while_importing):
    """SIGTERM in the middle of the work: one line, exit code 143, and no file half written; also where Python makes
    another error of it, as from `__set_name__` while a module is imported."""
    write = "import time; from scsr_opt._files import whole_file\nwith whole_file('a.png') as t: t.touch(); {}"
    work = write.format("print('begun', flush=True); time.sleep(60)").replace("\n", "\n    ")
    if while_importing:
        name = work.replace("\n", "\n        ")
        work = f"class Name:\n        def __set_name__(*_):\n            {name}\n    class Slow: name = Name()"
    code = f"""
import sys, scsr_opt.cli.app as app, scsr_opt.camera
def read(*_, **__):
    {work}
scsr_opt.camera.read_recording = read
sys.argv = ["scsr", "info", "x.npz"]
sys.exit(app.main())
"""
    running = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert running.stdout is not None and running.stdout.readline() == "begun\n"
    running.send_signal(signal.SIGTERM)
    _, said = running.communicate(timeout=30)
    assert running.returncode == 143 and said == "scsr: error: terminated.\n"
    assert not list(here.iterdir())


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (
            MemoryError(),
            "there is not enough memory for this; take fewer --frames, a --crop of the sensor or a smaller --scale.",
        ),
        (OSError(28, "No space left on device", "x.npz"), "x.npz: No space left on device."),
        (OSError(5, "Input/output error"), "Input/output error."),
        (InputError("strength is\n-1"), "strength is -1"),
        (ValueError("odd"), "ValueError: odd (a fault of the program; SCSR_TRACEBACK=1 shows where)"),
        (TypeError("odd"), "TypeError: odd (a fault of the program; SCSR_TRACEBACK=1 shows where)"),
    ],
)
def test_errors_are_one_line(scsr, monkeypatch, file, error, sentence):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("scsr_opt.camera.read_recording", fail)
    assert scsr("info", file, code=2) == f"scsr: error: {sentence}\n"
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
