import sys
from pathlib import Path

import numpy as np
import pytest

from scsr_opt.motion import Motion
from scsr_opt.solvers.solution import Result, Solution, Stage

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
def solution(scene) -> Solution:
    stages = tuple(Stage(t, 10.0 / t, 8.0 / t, 2.0 / t, 0.5**t, 0.1, 0.01 * t) for t in range(1, 13))
    velocity = np.zeros((2, 24, 40), np.float32)
    velocity[1, :, 20:] = 0.2
    stats = {"iterations": np.int64(12), "strength": np.float32(0.25), "odd": np.nan, "list": [np.bool_(True), None]}
    return Solution(scene, stages, Result.converged, stats, Motion.of_velocity(velocity))


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
