"""Fixtures for stores of sequences: a recording in a file, a plan of it, and a quick stand-in for the solves."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scsr_opt import Diagnostics, Recording, Solution, Status
from scsr_opt.calibration.bad_pixels import BadPixels
from scsr_opt.camera import read_recording, write_recording
from scsr_opt.motion import Motion
from scsr_opt.sequences import Plan

FRAMES, HEIGHT, WIDTH = 61, 8, 12
FAILING = 44
"""Key frame whose solve fails in the stand-in."""


@pytest.fixture
def recording(tmp_path) -> Recording:
    """Noise, in a file."""
    spikes = np.random.default_rng(5).random((FRAMES, HEIGHT, WIDTH)) < 0.4
    write_recording(tmp_path / "noise.npy", Recording.from_array(spikes.astype(np.uint8)))
    return read_recording(tmp_path / "noise.npy")


@pytest.fixture
def plan(recording) -> Plan:
    """Ten pictures in groups of four."""
    return Plan.of(recording, range(3, 40, 4), scale=2, group=4, bad_pixels=None, frames=11)


class StandIn:
    """In the place of `reconstruct_sequence`: pictures that depend on the key frame, its place in the group and the
    spikes.

    **Fields:** `solved`: key frames of the pictures that were made; `stop_after`: number of pictures after which
    `error` is raised, None for never.
    """

    def __init__(self) -> None:
        self.solved: list[int] = []
        self.stop_after: int | None = None
        self.error: BaseException = KeyboardInterrupt()

    def __call__(self, recording: Recording, keys: Any, *, scale: int, options: Any) -> Iterator[Solution]:
        height, width = recording.shape[1:] if options.crop is None else options.crop[2:]
        for place, key in enumerate(keys):
            if self.stop_after is not None and len(self.solved) >= self.stop_after:
                raise self.error
            self.solved.append(key)
            level = 0.1 + key / 100 + place / 1000
            fine = recording.window(key, key + 1)[0, :height, :width].repeat(scale, 0).repeat(scale, 1)
            image = (level + fine * 0.01).astype(np.float32)
            yield Solution(
                image=image,
                recording=recording,
                scale=scale,
                key=key,
                white_rate=recording.white_rate,
                status=Status.non_finite if key == FAILING else Status.converged,
                diagnostics=Diagnostics(motion_carried=place > 0, iterations=7 + place, strength=0.01),
                motion=Motion.constant((0.1, key / 1000), (height, width)),
                bad_pixels=BadPixels.given(np.arange(height * width).reshape(height, width) == key),
            )


@pytest.fixture
def stand_in(monkeypatch) -> StandIn:
    """A stand-in that is in the place of `reconstruct_sequence`."""
    made = StandIn()
    monkeypatch.setattr("scsr_opt.sequences.run.reconstruct_sequence", made)
    return made


def files_of(path: Path) -> dict[str, bytes]:
    """The files below a folder, by their relative names."""
    return {str(one.relative_to(path)): one.read_bytes() for one in sorted(path.rglob("*")) if one.is_file()}


@pytest.fixture
def files() -> Callable[[Path], dict[str, bytes]]:
    """`files_of`, for tests of other folders."""
    return files_of
