"""Fixtures that the tests of the command share: a recording, the command itself, and a stand-in for the work."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import scsr_opt
from scsr_opt import Diagnostics, Solution, Stage, Status
from scsr_opt.camera import Recording, tfp, write_recording
from scsr_opt.cli import main
from scsr_opt.motion import Motion

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
