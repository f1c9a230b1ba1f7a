"""Regression guard that no noise can set off: iterations, operations, bytes and kernels, compared with counts.json.

A change on purpose, or another version of XLA (`jax` in the file says which it was), is taken over by

    .venv/bin/python -m benchmarks.counts --write tests/benchmarks/counts.json

after a look at what changed. With the version of XLA that they were counted with, programs differ little from processor
to processor: to lose one fusion in each dual step is beyond the margins. Other versions fuse differently, and there the
margins notice work that is done twice.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from benchmarks import counts

ROOT = Path(__file__).resolve().parents[2]
RECORDED = json.loads((Path(__file__).parent / "counts.json").read_text(encoding="utf-8"))
# Of iterations: rounding decides about one at each restart, which comes every ten or so.
MORE_ITERATIONS, AT_LEAST = 0.2, 1
# Operations follow from the formulas, unless XLA calculates something twice to fuse more; bytes and kernels from what
# is fused.
COUNTED = ("operations a pixel", "bytes a pixel", "bytes held a pixel", "fusions")
MARGIN = 0.1 if jax.__version__ == RECORDED["jax"] else 0.25


@pytest.mark.slow  # 29 core seconds of compiling with all optimisations, for speed alone
def test_programs_move_and_calculate_no_more():
    """Each program has no more operations, bytes and fusions than counts.json records, compiled with XLA's defaults.

    Lower counts pass; write them into counts.json, so that they stay."""
    anew = {"XLA_FLAGS": "", "JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}
    code = "import json; from benchmarks import counts; print(json.dumps(counts.programs()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | anew, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    counted = json.loads(done.stdout)
    assert set(counted) == set(RECORDED["programs"])
    for name, recorded in RECORDED["programs"].items():
        for what in COUNTED:
            assert 0 < counted[name][what] <= (1 + MARGIN) * recorded[what], f"{name}: {what}, {recorded[what]} before"


def test_solvers_need_no_more_iterations():
    counted = counts.iterations()
    assert set(counted) == set(RECORDED["iterations"])
    for solver, recorded in RECORDED["iterations"].items():
        for gap, number in recorded.items():
            most = number + max(AT_LEAST, MORE_ITERATIONS * number)
            assert counted[solver].get(gap, 10**6) <= most, f"{solver} to a gap of {gap}, {number} before"


def test_same_shape_compiles_nothing_again():
    counted = counts.compilations_again()
    assert counted["first"] > 0 and counted["again"] == 0
    # Another recording may have another of the few lengths that samples are padded to.
    assert counted["second"] <= 10 and counted["third"] == 0
