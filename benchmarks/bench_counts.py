"""What cannot be noisy: iterations, operations, bytes, kernels and compilations, for a test that guards them.

    python -m benchmarks.bench_counts --write tests/benchmarks/counts.json

counts them anew; do that, and look at what changed, when a change is meant to change them or XLA is another version.
The numbers depend on nothing but the program: not on the machine's load, nor on how often it is run.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.bench_cases import posed, recorded
from benchmarks.bench_iteration import first_state, fused_iteration, placed_of, problem_of
from benchmarks.bench_solvers import followed, minimum, reached
from benchmarks.bench_timing import compilations, program
from scsr_opt import reconstruct, solvers
from scsr_opt.camera.sampling_rules import Intervals
from scsr_opt.operators.sampling import accumulate
from scsr_opt.priors import Bounded, HuberTotalVariation, Prior, RidgeRegulariser
from scsr_opt.solvers import FISTA, Problem, Solver

# Large enough that borders hardly count, small enough to compile and run in a moment.
_PICTURE = (96, 128)
_SENSOR = 20
# Frames, rows and columns of the sensor, scale: as large a picture.
_ACCUMULATED = (41, 24, 32, 4)
_HUBER, _RIDGE = HuberTotalVariation(), RidgeRegulariser.load()
_SOLVERS: dict[str, tuple[Solver, Prior]] = {
    "FISTA": (FISTA(), _HUBER), "CondatVu": (solvers.CondatVu(), _HUBER), "ADMM": (solvers.ADMM(), _HUBER),
    "LBFGS": (solvers.LBFGS(), _HUBER),
    "FISTA, ridge": (FISTA(), _RIDGE),
}  # fmt: skip


def iterations() -> dict[str, dict[str, int]]:
    """Of solvers to each gap that they reach on a pan of 20×20 pixels at ×2, by name and gap; with Huber-TV where no
    prior is named."""
    case = posed(recorded("camera", scale=2, sensor=_SENSOR, frames=41), Intervals(), careful=False)
    strength, minima, found = jnp.asarray(case.strength, jnp.float32), {}, {}
    for name, (solver, prior) in _SOLVERS.items():
        problem, kind = Problem(case.term, prior, strength), type(prior)
        minima[kind] = known = minima.get(kind) or minimum(problem, case.start, 300)
        assert known is not None
        looks = followed(solver, problem, case.start, known.above, case.truth, 2, seconds=60.0)
        # Gaps below 1e-4 are near what float32 knows of F: which iteration meets them is chance.
        found[name] = {f"{one['gap']:.0e}": one["iterations"] for one in reached(looks) if one["gap"] >= 1e-4}
    return found


def programs() -> dict[str, dict[str, float]]:
    """Of iterations and their parts at 96×128: operations and bytes by XLA's cost analysis, bytes held, fusions."""
    problem, image = problem_of(_PICTURE)
    data = problem.data
    fista, condat, pixels = FISTA(), solvers.CondatVu(), image.size
    state, other = (first_state(solver, problem, image) for solver in (fista, condat))
    priors = {"Huber-TV": _HUBER, "ridge": _RIDGE, "bounded": Bounded(_HUBER)}
    placed = placed_of(*_ACCUMULATED)
    counted = {
        "FISTA, an iteration": program(fused_iteration, fista, problem, state),
        "CondatVu, an iteration": program(fused_iteration, condat, problem, other),
        "f and its gradient": program(lambda f, x: f.value_and_gradient(x), data, image),
        "accumulate M and c": program(lambda p: accumulate(p), placed),
        # With a strength that is known when compiling, as users write it.
        **{
            f"proximal step, {name}": program(lambda x, p, of=of: of.prox(x, 1e-3, p), image, of.initial_state(image))
            for name, of in priors.items()
        },
    }
    return {
        name: {
            "operations a pixel": (one.flops or 0.0) / pixels, "bytes a pixel": (one.moved or 0.0) / pixels,
            "bytes held a pixel": one.memory / pixels, "fusions": one.fusions,
        }
        for name, one in counted.items()
    }  # fmt: skip


def compilations_again() -> dict[str, int]:
    """Programs that are compiled for a first `reconstruct`, for one of the same again, and for two of other recordings
    of its shape."""
    told = {}
    for name, seed in (("first", 0), ("again", 0), ("second", 1), ("third", 2)):
        made = recorded("camera", scale=2, sensor=_SENSOR, frames=41, seed=seed)
        with compilations() as seconds:
            reconstruct(made.spikes, scale=2, white_rate=made.white_rate)
        told[name] = len(seconds)
    return told


def counts() -> dict[str, Any]:
    """All but the compilations, which have to be none."""
    return {"jax": jax.__version__, "iterations": iterations(), "programs": programs()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, help="the file that the test compares with")
    arguments = parser.parse_args()
    told = json.dumps(counts(), indent=1)
    print(told)
    if arguments.write is not None:
        arguments.write.write_text(told + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
