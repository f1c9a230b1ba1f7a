"""Iterations, operations, bytes, kernels and compilations, which no noise can change, for a test that guards them.

    python -m benchmarks.counts --write tests/benchmarks/counts.json

counts them anew; do that, and look at what changed, when a change is meant to change them or XLA is another version.
The numbers depend on nothing but the program: not on the machine's load, nor on how often it is run.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.bench.kernels import first_state, iteration, placed_samples, problem_of
from benchmarks.race import Entry, followed, minimum, reached
from benchmarks.recordings import posed, recorded
from benchmarks.timing import compilations, program
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
_PRIORS: dict[str, Prior] = {"Huber-TV": HuberTotalVariation(), "ridge": RidgeRegulariser.load()}
_SOLVERS: dict[str, tuple[Solver, str]] = {
    "FISTA": (FISTA(), "Huber-TV"),
    "CondatVu": (solvers.CondatVu(), "Huber-TV"),
    "ADMM": (solvers.ADMM(), "Huber-TV"),
    "LBFGS": (solvers.LBFGS(), "Huber-TV"),
    "FISTA, ridge": (FISTA(), "ridge"),
}
# Gaps below are near the rounding of F in float32: which iteration meets them is chance.
_SMALLEST_GAP = 1e-4


def iterations() -> dict[str, dict[str, int]]:
    """Iterations of solvers to each gap on a pan of 20×20 pixels at ×2, by name and gap; with Huber-TV where no prior
    is named."""
    case = posed(recorded("camera", scale=2, sensor=_SENSOR, frames=41), Intervals(), validate=False)
    strength = jnp.asarray(case.strength, jnp.float32)
    problems = {name: Problem(case.term, prior, strength) for name, prior in _PRIORS.items()}
    minima = {name: minimum(problem, case.start, FISTA(iterations=300)) for name, problem in problems.items()}
    counted = {}
    for name, (solver, prior) in _SOLVERS.items():
        looks = followed(Entry(solver, problems[prior], case.start, minima[prior]), case.truth, 2, seconds=60.0)
        counted[name] = {
            f"{one['gap']:.0e}": one["iterations"] for one in reached(looks) if one["gap"] >= _SMALLEST_GAP
        }
    return counted


def programs() -> dict[str, dict[str, float]]:
    """Operations and bytes by XLA's cost analysis, bytes held, and fusions of iterations and their parts at 96×128."""
    problem, image = problem_of(_PICTURE)
    fista, condat, pixels = FISTA(), solvers.CondatVu(), image.size
    priors = _PRIORS | {"bounded": Bounded(_PRIORS["Huber-TV"])}
    counted = {
        "FISTA, an iteration": program(iteration, fista, problem, first_state(fista, problem, image)),
        "CondatVu, an iteration": program(iteration, condat, problem, first_state(condat, problem, image)),
        "f and its gradient": program(lambda f, x: f.value_and_gradient(x), problem.data, image),
        "accumulate M and c": program(lambda p: accumulate(p), placed_samples(*_ACCUMULATED)),
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
    """Programs that are compiled for a first `reconstruct`, for one of the same recording again, and for two of other
    recordings of its shape."""
    counted = {}
    for name, seed in (("first", 0), ("again", 0), ("second", 1), ("third", 2)):
        made = recorded("camera", scale=2, sensor=_SENSOR, frames=41, seed=seed)
        with compilations() as seconds:
            reconstruct(made.spikes, scale=2, white_rate=made.white_rate)
        counted[name] = len(seconds)
    return counted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, help="the file that the test compares with")
    options = parser.parse_args()
    counted: dict[str, Any] = {"jax": jax.__version__, "iterations": iterations(), "programs": programs()}
    text = json.dumps(counted, indent=1)
    print(text)
    if options.write is not None:
        options.write.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
