"""The examples of README.md and docs/extending.md run as they stand."""

import re
from pathlib import Path
from typing import Any

import matplotlib
import pytest
from skimage import data

from scsr_opt.camera import Sensor, simulate, write_recording
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.scenes import Translation

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent


def examples(page: str) -> str:
    """All Python of a page, one block after another."""
    return "\n".join(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.S))


def test_readme_examples_run(tmp_path, monkeypatch):
    """On 32×24 sensor pixels in the place of the page's 400×250."""
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    scene = Translation(data.camera()[60:156, 200:328], (0.05, 0.1), key=100)
    made = simulate(scene, scale=4, frames=170, sensor=Sensor(white_rate=0.6, photons=1000))
    write_recording("car.dat", Recording.from_array(made.spikes, white_rate=0.6))
    code = examples("README.md")
    assert "400x250" in code
    exec(compile(code.replace("400x250", "32x24"), "README.md", "exec"), {"__name__": "readme"})
    assert {"car.png", "car.json", "car_figure.png"} <= {path.name for path in tmp_path.iterdir()}


def test_extending_examples_run(capsys):
    """The prior and the solver converge, and the estimator finds the motion of the scene."""
    known: dict[str, Any] = {"__name__": "extending"}
    exec(compile(examples("docs/extending.md"), "extending.md", "exec"), known)
    assert known["solution"].status.name == known["outcome"].status.name == "converged"
    assert known["motion"].velocity[:, 0, 0] == pytest.approx((0.05, 0.12), abs=0.01)
    assert "20 steps" in capsys.readouterr().out
