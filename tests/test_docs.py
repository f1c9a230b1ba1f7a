"""The examples of README.md and the pages how-to, formats and extending run as they stand, and the commands of
README.md and the pages how-to and sequences."""

import re
import shlex
from pathlib import Path
from typing import Any

import matplotlib
import pytest
from skimage import data

from scsr_opt.camera import Sensor, simulate, write_recording
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.scenes import Translation
from scsr_opt.cli import main

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent


def examples(page: str) -> str:
    """All Python of a page, one block after another."""
    return "\n".join(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.S))


@pytest.fixture
def car(tmp_path, monkeypatch) -> None:
    """A folder with car.dat, 32×24 sensor pixels in the place of the pages' 400×250."""
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    scene = Translation(data.camera()[60:156, 200:328], (0.05, 0.1), key=100)
    made = simulate(scene, scale=4, frames=170, sensor=Sensor(white_rate=0.6, photons=1000))
    write_recording("car.dat", Recording.from_array(made.spikes, white_rate=0.6))


@pytest.mark.parametrize(
    ("page", "files"),
    [
        ("README.md", {"car.png", "car_figure.png"}),
        ("docs/howto.md", {"car.png", "car.json", "wipe.html", "crops.png", "motion.png"}),
        ("docs/formats.md", {"mine_120x80.dat"}),
    ],
)
def test_code_runs(page, files, car, tmp_path):
    code = examples(page)
    assert code
    exec(compile(code.replace("400x250", "32x24"), page, "exec"), {"__name__": "page"})
    assert files <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("page", ["README.md", "docs/howto.md", "docs/sequences.md"])
def test_commands_run(page, car, capsys):
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.S)
    lines = [line for block in blocks for line in block.splitlines() if line.startswith("scsr ")]
    given = [line for line in lines if "# not run: " not in line]
    assert given
    for line in given:
        tokens = shlex.split(line.replace("400x250", "32x24"), comments=True)[1:]
        assert main(tokens) == 0, f"{line}: {capsys.readouterr().err}"


def test_extending_examples_run(capsys):
    """The prior and the solver converge, and the estimator finds the motion of the scene."""
    known: dict[str, Any] = {"__name__": "extending"}
    exec(compile(examples("docs/extending.md"), "extending.md", "exec"), known)
    assert known["solution"].status.name == known["outcome"].status.name == "converged"
    assert known["motion"].velocity[:, 0, 0] == pytest.approx((0.05, 0.12), abs=0.01)
    assert "20 steps" in capsys.readouterr().out
