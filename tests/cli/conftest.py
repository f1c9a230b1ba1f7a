"""Fixtures that the tests of the command share: a recording, the command itself, and a stand-in for the work."""

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import scsr_opt
from scsr_opt import Diagnostics, Solution, Stage, Status
from scsr_opt.camera import Recording, tfp, write_recording
from scsr_opt.cli import main
from scsr_opt.motion import Motion
from scsr_opt.sequences import Plan, write_sequence

FRAMES, HEIGHT, WIDTH = 31, 24, 40


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    """Every test starts in an empty folder of its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def ramp() -> np.ndarray:
    """Spikes of firing rates that rise from 0 at the left to 0.6 at the right, without noise."""
    rate = np.linspace(0.0, 0.6, WIDTH)
    charge = np.floor(np.arange(FRAMES + 1)[:, None] * rate + 1e-9)
    return np.broadcast_to(np.diff(charge, axis=0)[:, None, :], (FRAMES, HEIGHT, WIDTH)).astype(np.uint8)


@pytest.fixture
def spikes() -> np.ndarray:
    return ramp()


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
        return Solution(
            image=image,
            recording=spikes,
            scale=scale,
            key=key,
            white_rate=spikes.white_rate,
            status=Status.converged,
            stages=stages,
            diagnostics=Diagnostics(iterations=2),
            motion=Motion.of_velocity(velocity),
        )

    monkeypatch.setattr(scsr_opt, "reconstruct", stand_in, raising=False)
    return calls


@pytest.fixture
def scsr(capsys) -> Callable[..., str]:
    """Runs `scsr`, wants this exit code, and returns what went to standard output (0) or standard error (others)."""

    def run(*arguments: object, code: int = 0) -> str:
        assert main([str(argument) for argument in arguments]) == code
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        if code == 0:
            # Lines of progress, which work of more than half a minute shows off a terminal, are no errors.
            assert re.sub(r"^scsr: [a-z].* \(\d+ s\)\n", "", said.err, flags=re.M) == ""
            return said.out
        assert said.out == ""
        assert said.err.startswith("scsr: error: ") and said.err.count("\n") == 1, said.err
        return said.err

    return run


EVERY = 10  # of the store: pictures of frames 0, 10, 20 and 30


FAILING = 13  # frame of which `quick_sequences` fails to make a picture


def quick_sequences(patch: pytest.MonkeyPatch) -> list[dict]:
    """Puts a quick stand-in in the place of `reconstruct_sequence`, and takes no pixel for bad.

    Its pictures are as bright as their frame is late. Motion is found anew at the first picture of a call and at the
    third.

    **Returns:** what it was called with, a table for each call: `recording`, `keys`, `scale`, `options`.
    """
    calls: list[dict] = []

    def stand_in(recording, keys, *, scale, options):
        calls.append({"recording": recording, "keys": list(keys), "scale": scale, "options": options})
        height, width = recording.shape[1:] if options.crop is None else options.crop[2:]
        for number, key in enumerate(keys):
            yield Solution(
                image=np.full((scale * height, scale * width), key / FRAMES, np.float32),
                recording=recording,
                scale=scale,
                key=key,
                white_rate=recording.white_rate,
                status=Status.non_finite if key == FAILING else Status.converged,
                crop=options.crop,
                diagnostics=Diagnostics(motion_carried=number not in (0, 2)),
            )

    patch.setattr("scsr_opt.sequences.run.reconstruct_sequence", stand_in)
    return calls


@pytest.fixture
def sequences(monkeypatch) -> list[dict]:
    """Sequences are made by `quick_sequences`; returns what it was called with."""
    return quick_sequences(monkeypatch)


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> Path:
    """Folder with a good recording in every format, and a good store."""
    folder = tmp_path_factory.mktemp("originals")
    recording = Recording.from_array(ramp(), white_rate=0.6)
    for name in ("ramp.npz", "ramp.npy", "ramp.h5", "ramp_40x24.dat"):
        write_recording(folder / name, recording)
    with pytest.MonkeyPatch.context() as patch:
        quick_sequences(patch)
        plan = Plan.of(recording, range(0, FRAMES, EVERY), scale=1, group=3)
        write_sequence(plan, folder / "a.zarr")
    return folder


@pytest.fixture
def solves(here, originals, monkeypatch) -> list[str]:
    """Copies of the recordings in the folder of the test; returns the names of the solves that were begun."""
    for name in ("ramp.npz", "ramp.npy", "ramp.h5", "ramp_40x24.dat"):
        shutil.copy(originals / name, here)
    begun: list[str] = []

    def one(*_, **__):
        begun.append("reconstruct")
        raise RuntimeError("a solve began")

    monkeypatch.setattr(scsr_opt, "reconstruct", one, raising=False)
    monkeypatch.setattr("scsr_opt.sequences.run.reconstruct_sequence", one)
    return begun


def contents(folder: Path) -> dict[str, object]:
    """Every path below a folder, with the bytes of files and the targets of links."""
    found: dict[str, object] = {}
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(place, name)
            key = os.path.relpath(path, folder)
            found[key] = os.readlink(path) if path.is_symlink() else path.read_bytes() if path.is_file() else None
    return found


@pytest.fixture
def refused(capsys, here, solves) -> Callable[..., str]:
    """Runs `scsr`, which has to refuse in one line and to leave the folder as it was; returns that line."""

    def run(*arguments: str) -> str:
        before = contents(here)
        code = main(list(arguments))
        said = capsys.readouterr()
        assert code in (1, 2), f"exit code {code}: {said.out}"
        assert said.out == "", said.out
        assert said.err.startswith("scsr: error: ") and said.err.count("\n") == 1, said.err
        assert "a fault of the program" not in said.err and "Traceback" not in said.err, said.err
        assert contents(here) == before
        assert not solves
        return said.err

    return run


@pytest.fixture
def quickly(monkeypatch, solves) -> None:
    """The folder of `solves`, where sequences are made by `quick_sequences`."""
    quick_sequences(monkeypatch)
