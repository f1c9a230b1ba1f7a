"""A forked process gets an error, instead of hanging, since JAX cannot be used there; a spawned one works."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "register_at_fork"), reason="this system knows no fork")

# Seconds after which a process is taken to hang. A start on a machine with other work takes tens of seconds.
_HANGS = 600

_BEGIN = """
import multiprocessing, sys, warnings
import numpy as np
warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
warnings.filterwarnings("ignore", "This process", DeprecationWarning)

def spikes():
    return (np.random.default_rng(0).random((20, 8, 9)) < 0.4).astype(np.uint8)

def denoised(shape):
    from scsr_opt.priors import TotalVariation
    from scsr_opt.priors.total_variation import Dual
    picture = np.ones(shape, np.float32)
    return float(TotalVariation().prox(picture, 0.1, Dual(0 * picture, 0 * picture))[0].sum())

def asked(function):
    import scsr_opt
    try:
        return function()
    except scsr_opt.InputError as error:
        return str(error)

def child(queue, function, *given):
    queue.put(asked(lambda: function(*given)))

def in_process(method, function, *given):
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    process = context.Process(target=child, args=(queue, function, *given))
    process.start()
    try:
        return queue.get(timeout=60)
    except Exception:
        return "hangs"
    finally:
        process.kill()
        process.join()
"""


def output(tmp_path: Path, code: str) -> str:
    script = tmp_path / "script.py"
    body = "".join(f"    {line}\n" for line in code.strip().splitlines())
    script.write_text(f"{_BEGIN}\n{_FUNCTIONS}\nif __name__ == '__main__':\n{body}")
    root = str(Path(__file__).resolve().parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=_HANGS, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


_FUNCTIONS = """
def reconstructed():
    from scsr_opt import reconstruct
    return reconstruct(spikes(), scale=2).image.shape

def sequenced():
    from scsr_opt import reconstruct_sequence
    return next(reconstruct_sequence(spikes(), scale=2, keys=[10]))

def moved():
    from scsr_opt.motion.estimators.automatic import estimate_motion
    return estimate_motion(spikes(), key=10)

def gains():
    from scsr_opt.calibration import gain_at_rest
    return gain_at_rest(spikes(), white_rate=0.6)

def applied():
    from scsr_opt.operators import Downsample
    return Downsample((8, 8), 2)(np.ones((8, 8), np.float32))

def bounded():
    from scsr_opt.operators import Downsample, norm_bound
    return norm_bound(Downsample((8, 8), 2))

def baseline():
    from scsr_opt.baselines import tfp_sr
    return tfp_sr(spikes(), scale=2)

def baseline_with_motion():
    from scsr_opt.baselines import mgsr
    from scsr_opt.motion import Motion
    return mgsr(spikes(), scale=2, motion=Motion.none(*spikes().shape[1:]))

def network():
    import learned
    return learned.unrolled(spikes(), scale=2)

def played():
    from scsr_opt.baselines import tfp_bicubic
    return tfp_bicubic(spikes(), scale=2).shape

def grandchild():
    return in_process("fork", denoised, (5, 6))

def started(how):
    import jax
    if how == "devices":
        jax.devices()
    else:
        denoised((6, 7))
"""

DOORS = [
    "reconstructed",
    "sequenced",
    "moved",
    "gains",
    "applied",
    "bounded",
    "baseline",
    "baseline_with_motion",
    "network",
    "grandchild",
]


def test_every_door_refuses_in_a_process_forked_after_a_solve(tmp_path):
    said = output(
        tmp_path,
        "from learned import zoo\nfrom scsr_opt import baselines, calibration, estimate_motion, reconstruct\n"
        f"started('a solve')\nfor door in ({', '.join(DOORS)}, lambda: denoised((5, 6))):\n    "
        "print(in_process('fork', door))\nprint(denoised((6, 8)))\nprint(in_process('fork', played))",
    )
    *refused, here, numpy_part = said.splitlines()
    assert len(refused) == len(DOORS) + 1
    assert all("was forked from one in which JAX had been started" in line and '"spawn"' in line for line in refused)
    assert here == "48.0"  # the parent goes on
    assert numpy_part == "(16, 18)"  # what does without JAX works


def test_process_forked_after_a_look_at_the_devices_is_refused(tmp_path):
    """The least that starts JAX."""
    said = output(tmp_path, "import scsr_opt\nstarted('devices')\nprint(in_process('fork', denoised, (5, 6)))")
    assert '"spawn"' in said


def test_process_forked_before_jax_is_used_works(tmp_path):
    code = "import scsr_opt.priors, jax\nfor _ in range(2):\n    print(in_process('fork', denoised, (5, 6)))"
    assert output(tmp_path, code).split() == ["30.0", "30.0"]


@pytest.mark.parametrize("method", ["spawn", pytest.param("forkserver", marks=pytest.mark.slow)])
def test_fresh_process_works_after_a_solve(tmp_path, method):
    assert output(tmp_path, f"started('a solve')\nprint(in_process({method!r}, denoised, (5, 6)))").strip() == "30.0"
