"""`benchmarks.killing`, in short; and going on with real solves, without another process."""

import random

import pytest

from benchmarks.killing import kill_often, simulated
from scsr_opt.camera import read_recording
from scsr_opt.motion import Global
from scsr_opt.pipeline.sequence import reconstruct_sequence
from scsr_opt.sequences import Plan, SequenceStore, write_sequence


@pytest.mark.slow  # each run is a process that imports JAX
@pytest.mark.parametrize(
    "mode, kinds",
    [
        ({}, {"runs"}),
        ({"workers": 2}, {"runs", "workers"}),
        ({"workers": 2, "cluster": True}, {"runs", "workers", "schedulers"}),
    ],
)
def test_a_sequence_that_is_killed_loses_nothing(tmp_path, mode, kinds):
    simulated(tmp_path / "object.npy", 51)
    options = [str(tmp_path / "object.npy"), "--scale", "2", "--start", "15", "--stop", "33", "--every", "3"]
    options += ["--group", "2", "--frames", "31", "--motion", "global", "--strength", "0.01"]
    kills = kill_often(tmp_path, options, 4, random.Random(1), **mode)
    assert kills.lossless and kills.total == 4 and set(kills.killed) == kinds, kills.line


def test_a_solve_that_is_interrupted_goes_on_to_the_same_bits(tmp_path, files, monkeypatch):
    """Pictures are warm-started within a group, so that one that went on from its middle would differ."""
    recording = read_recording(simulated(tmp_path / "object.npy", 45))
    plan = Plan.of(
        recording, range(15, 30, 3), scale=1, group=3, frames=21, motion=Global(affine=False), strength=0.01,
        bad_pixels=None, gain=None, light="constant",
    )  # fmt: skip
    write_sequence(plan, tmp_path / "whole.zarr")
    write, written = SequenceStore.write_picture, []

    def stopping(store, number, solution):
        written.append(number)
        if len(written) == 2:
            raise KeyboardInterrupt
        write(store, number, solution)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(SequenceStore, "write_picture", stopping)
        write_sequence(plan, tmp_path / "a.zarr")
    assert write_sequence(plan, tmp_path / "a.zarr").there == 0
    assert files(tmp_path / "a.zarr") == files(tmp_path / "whole.zarr")
    store = SequenceStore.open(tmp_path / "a.zarr")
    second = list(reconstruct_sequence(recording, [24, 27], scale=1, options=plan.options))
    assert all((store.picture(number) == one.image).all() for number, one in enumerate(second, 3))
