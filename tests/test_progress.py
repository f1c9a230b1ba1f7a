"""The argument `progress` is checked before the work begins."""

import re
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from scsr_opt import InputError, reconstruct
from scsr_opt.progress import NoProgress, check_progress
from scsr_opt.report import RichProgress


class NoFinish:
    def start(self, total: int | None, what: str) -> None: ...

    def advance(self, done: int) -> None: ...


BAD: dict[str, Any] = {
    "print": print,
    "a lambda": lambda *_: None,
    "True": True,
    "a name": "bar",
    "a number": 10,
    "a list": [],
    "a class": NoProgress,
    "an object": object(),
    "without finish": NoFinish(),
    "a range": range(3),
}


@pytest.mark.parametrize("bad", BAD)
def test_check_progress_anything_else_is_refused(bad):
    with pytest.raises(InputError, match="^progress is .*; it must be None or an object with the methods start, adv"):
        check_progress(BAD[bad])


@pytest.mark.parametrize("progress", [None, NoProgress(), RichProgress()])
def test_check_progress_an_object_or_none_is_fine(progress):
    check_progress(progress)


class Notes(NoProgress):
    """Names of the parts that were begun, and "ended" for each that was finished."""

    def __init__(self) -> None:
        self.parts: list[str] = []

    def start(self, total: int | None, what: str) -> None:
        self.parts.append(what)

    def finish(self) -> None:
        self.parts.append("ended")


def test_reconstruct_shows_progress_before_its_first_iteration(monkeypatch):
    """Motion and strength are found, and most programs compiled, before any iteration; also where that fails."""
    spikes = np.zeros((24, 6, 8), np.uint8)
    watched = Notes()
    reconstruct(spikes, scale=2, progress=watched)  # without a spike there is nothing to solve
    assert watched.parts == ["finding motion and strength", "ended"]

    def failing(task):
        assert watched.parts[-1] == "finding motion and strength"
        raise InputError("no")

    monkeypatch.setattr("scsr_opt.pipeline.reconstruct.assemble_task", failing)
    with pytest.raises(InputError, match="no"):
        reconstruct(spikes, scale=2, progress=watched)
    assert watched.parts[-1] == "ended"


# In a process of its own, where types are not checked: each function that takes a progress says what is wrong with it.
_DOORS = """
import pathlib, sys, tempfile
import jax.numpy as jnp, numpy as np
from learned.evaluation.compare import compare_stages
from learned.zoo import model
from scsr_opt import reconstruct, reconstruct_sequence
from scsr_opt.cli import demo_scene as demo
from scsr_opt.camera import Static, simulate

spikes, folder = (np.random.default_rng(0).random((24, 6, 8)) < 0.3).astype(np.uint8), pathlib.Path(sys.argv[1])
doors = [
    lambda told: reconstruct(spikes, scale=2, progress=told),
    lambda told: reconstruct_sequence(spikes, [12], scale=2, progress=told),
    lambda told: simulate(Static(np.full((4, 4), 0.5)), scale=1, frames=2, progress=told),
    lambda told: model("fista-tv", 2)(spikes, scale=2, progress=told),
    lambda told: model("fista-tv", 2)(spikes, scale=2, progress=told, start=jnp.zeros((12, 16))),
    lambda told: model("unrolled", 2)(spikes, scale=2, progress=told),
    lambda told: compare_stages(spikes, ["fista-tv"], scale=2, progress=told),
    lambda told: demo.run(folder, progress=told),
]
for number, door in enumerate(doors):
    for told in (print, True):
        try:
            door(told)
            print(number, "nothing is said")
        except Exception as error:
            print(number, type(error).__name__, error)
"""


def test_doors_progress_that_is_none_is_refused_before_the_work(tmp_path):
    run = subprocess.run([sys.executable, "-c", _DOORS, str(tmp_path)], capture_output=True, text=True, timeout=600)
    lines = run.stdout.splitlines()
    assert len(lines) == 16, run.stderr
    for line in lines:
        assert re.match(r"\d InputError progress is (True|<built-in function print>); it must be None or", line), line
    assert not list(tmp_path.iterdir())  # the demo writes its recording first
