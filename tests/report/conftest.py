import sys
from pathlib import Path

import numpy as np
import pytest

from scsr_opt.camera import Recording
from scsr_opt.motion import Motion
from scsr_opt.pipeline.solution import Diagnostics, Solution
from scsr_opt.solvers.record import Stage, Status

SCALE = 4


@pytest.fixture
def scene() -> np.ndarray:
    """A flat picture (96, 160) with texture in one place: rows 40–60, columns 100–130."""
    image = np.full((96, 160), 0.4, np.float32)
    image[40:60, 100:130] += 0.3 * np.random.default_rng(0).standard_normal((20, 30)).astype(np.float32)
    return image


@pytest.fixture
def spikes() -> np.ndarray:
    return (np.random.default_rng(0).random((31, 24, 40)) < 0.3).astype(np.uint8)


@pytest.fixture
def solution(scene, spikes) -> Solution:
    """A made-up one of a recording with three bad pixels."""
    bad = np.zeros((24, 40), bool)
    bad[0, :3] = True
    stages = tuple(Stage(t, 10.0 / t, 8.0 / t, 2.0 / t, 0.5**t, 0.1, 0.01 * t) for t in range(1, 13))
    velocity = np.zeros((2, 24, 40), np.float32)
    velocity[1, :, 20:] = 0.2
    return Solution(
        image=scene,
        recording=Recording.from_array(spikes, white_rate=0.5, bad_pixels=bad, name="street"),
        scale=SCALE,
        key=15,
        white_rate=0.5,
        status=Status.converged,
        stages=stages,
        diagnostics=Diagnostics(iterations=12, strength=0.25, objective=np.nan, motion_carried=True),
        motion=Motion.of_velocity(velocity),
    )


@pytest.fixture
def encoder(tmp_path, monkeypatch) -> Path:
    """A stand-in for ffmpeg: stores what it is fed, fails if the picture is all black, and takes names as ffmpeg does:
    what stands before a colon is a protocol."""
    program = tmp_path / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text(
        f"#!{sys.executable}\n"
        "import re, sys\n"
        "data = sys.stdin.buffer.read()\n"
        "if not any(data):\n"
        "    sys.exit('first line\\nall is black')\n"
        "if re.match('-|[A-Za-z0-9+.-]*:', sys.argv[-1]):\n"
        "    sys.exit('Protocol not found')\n"
        "open(sys.argv[-1], 'wb').write(' '.join(sys.argv[1:-1]).encode() + b'|' + data)\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent))
    return program
