"""JAX's switches in the environment: double precision, the search for values that are not numbers, and devices.

They hold for a whole process, so each test starts one, of a small scene. What is compared with single precision is
calculated here in that.
"""

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

_SCENE = """
import sys
from pathlib import Path

import jax
import numpy as np

rows, columns = np.mgrid[0:12, 0:16]
charge, spikes = np.random.default_rng(0).random((12, 16)), np.zeros((41, 12, 16), np.uint8)
for t in range(41):
    charge += 0.3 + 0.2 * np.sin((columns - 0.1 * t) * 0.9) * np.cos(rows * 0.6)
    spikes[t] = charge >= 1
    charge -= spikes[t]
"""
_RUNS_NOT_NUMBERS = """
import math
from learned.zoo import model
from scsr_opt import reconstruct, reconstruct_sequence
from scsr_opt.motion import Motion
from scsr_opt.priors import HuberTotalVariation
from scsr_opt.solvers import FISTA, DualityGap

solution = reconstruct(spikes, scale=2)
assert solution.status.usable and math.isnan(solution.stages[-1].gap)
for solution in reconstruct_sequence(spikes, [18, 22], scale=2):
    assert solution.status.usable
assert solution.diagnostics.motion_carried
still = reconstruct(spikes[np.zeros(41, int)], scale=2, prior=HuberTotalVariation())
assert still.status.usable and still.diagnostics.solver == "DataProximal"
assert math.isnan(still.stages[-1].gap)
asked = FISTA(iterations=5, stopping=DualityGap())
motion = Motion.constant((0, 0.1), spikes.shape[1:])
known = reconstruct(spikes, scale=2, prior=HuberTotalVariation(), solver=asked, strength=0.003, motion=motion)
assert known.stages[-1].gap > 0
assert np.isfinite(model("unrolled", 2)(spikes, scale=2, record=False).image).all()
"""
_NETWORKS = """
from learned.zoo import model

def picture(name):
    scale, options = (4, {}) if name == "ridge-centred" else (2, {"record": False})
    solution = model(name, scale)(spikes, scale=scale, **options)
    assert solution.image.dtype == np.float32 and solution.status.usable, name
    return solution.image

for name, scale in (("unrolled", 2), ("spikesr-small", 2), ("ridge-centred", 4)):
    assert model(name, scale).name == name  # its weights are read
for name in sys.argv[2:]:
    np.save(sys.argv[1] + f"/{name}.npy", picture(name))
"""
_WAVELETS = """
from scsr_opt import reconstruct
from scsr_opt.motion import Motion
from scsr_opt.priors import WaveletL1
from scsr_opt.solvers import FISTA

motion = Motion.constant((0, 0.1), spikes.shape[1:])
given = {"scale": 2, "strength": 0.005, "motion": motion, "gain": None, "prior": WaveletL1(iterations=20)}
usual = reconstruct(spikes, **given)
exact = reconstruct(spikes, **given, solver=FISTA(iterations=3000, tolerance=1e-6))
assert usual.status.name == exact.status.name == "converged"
if sys.argv[1:]:
    np.savez(sys.argv[1] + "/wavelets.npz", usual=usual.image, exact=exact.image)
"""
_PLATFORMS = """
from scsr_opt.baselines import mgsr
from learned.zoo import model
from scsr_opt import InputError, reconstruct, reconstruct_sequence
from scsr_opt.cli import demo_scene as demo

folder = Path(sys.argv[1])
doors = [
    lambda: reconstruct(spikes, scale=2),
    lambda: next(reconstruct_sequence(spikes, [20], scale=2)),
    lambda: model("unrolled", 2)(spikes, scale=2, record=False),
    lambda: model("ridge-centred", 4)(spikes, scale=4),
    lambda: mgsr(spikes, scale=2),
    lambda: demo.run(folder),
]
for door in doors:
    try:
        door()
        print("nothing is said")
    except InputError as error:
        print(error)
    except Exception as error:
        print(repr(error))
"""


def here(program: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The names that the program gives values to, run in this process, without arguments."""
    monkeypatch.setattr(sys, "argv", sys.argv[:1])
    names: dict[str, Any] = {}
    exec(_SCENE + program, names)
    return names


def run(program: str, *arguments: object, **environment: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-c", _SCENE + program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=1200, env=os.environ | environment)


def test_debug_nans_solves_films_and_networks_run():
    """Numbers that are not measured are no NaN in a compiled program, and NaN in the record all the same."""
    done = run(_RUNS_NOT_NUMBERS, JAX_DEBUG_NANS="1")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("networks", "apart"),
    [
        (["unrolled"], 1e-4),
        pytest.param(["spikesr-small"], 1e-4, marks=pytest.mark.slow),
        pytest.param(["ridge-centred"], 1e-2, marks=pytest.mark.slow),
    ],
)
def test_enable_x64_networks_load_their_weights_and_see_the_same(tmp_path, monkeypatch, networks, apart):
    """They stay in float32, as the weights are; ridge-centred is solved twice, each time to a tolerance of 1e-4."""
    done = run(_NETWORKS, tmp_path, *networks, JAX_ENABLE_X64="1")
    assert done.returncode == 0, done.stderr
    picture = here(_NETWORKS, monkeypatch)["picture"]
    for name in networks:
        usual, wide = picture(name), np.load(tmp_path / f"{name}.npy")
        assert usual.max() > 0.2
        np.testing.assert_allclose(wide, usual, atol=apart, err_msg=name)


def test_enable_x64_wavelets_end_at_the_same_minimum(tmp_path, monkeypatch):
    """Neither precision is wrong: solved on, both come to one picture. At the usual tolerance either is some way from
    it, and rounding decides which iteration is the last."""
    done = run(_WAVELETS, tmp_path, JAX_ENABLE_X64="1")
    assert done.returncode == 0, done.stderr
    single, double = here(_WAVELETS, monkeypatch), np.load(tmp_path / "wavelets.npz")
    exact = single["exact"].image
    np.testing.assert_allclose(double["exact"], exact, atol=1e-3)
    for usual in (single["usual"].image, double["usual"]):
        np.testing.assert_allclose(usual, exact, atol=0.03)


def test_platforms_device_that_is_not_there_is_said_in_one_sentence(tmp_path):
    """A slip of the pen; the next test has one that is known to JAX, but not there."""
    done = run(_PLATFORMS, tmp_path, JAX_PLATFORMS="cudda")
    lines = done.stdout.splitlines()
    assert len(lines) == 6, done.stderr
    for line in lines:
        assert line.startswith("JAX finds no device of the kind that JAX_PLATFORMS=cudda asks for: unset"), line
    assert not list(tmp_path.iterdir())


_COMMANDS = [
    "solve a.npy -o b.png",
    "solve a.npy -o b.png --prior ridge",  # whose weights are arrays of JAX's before the solve begins
    "sequence a.npy -o b.gif",
    "baseline a.npy -o b.png",
    "demo -o demo",
]


def test_platforms_command_line_ends_with_2_and_writes_nothing(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((8, 6, 5), np.uint8))
    program = f"from scsr_opt.cli import main\nfor words in {_COMMANDS}:\n    print(main(words.split()))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True, text=True, timeout=300, cwd=tmp_path, env=os.environ | {"JAX_PLATFORMS": "cuda"},
    )  # fmt: skip
    assert done.stdout.split() == ["2"] * len(_COMMANDS), done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == len(_COMMANDS), done.stderr
    assert all(line.startswith("scsr: ") and "JAX_PLATFORMS=cuda" in line for line in lines), done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]
