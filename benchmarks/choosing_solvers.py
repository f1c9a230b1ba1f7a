"""The races of solvers for docs/choosing.md: time to a gap above a minimum that is known."""

import time
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.choosing_cases import Case, Size, seconds_of
from benchmarks.choosing_priors import best
from scsr_opt import priors, solvers
from scsr_opt.priors.prior import Prior
from scsr_opt.solvers import Problem, Solver, run

GAPS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)


class Race(NamedTuple):
    """A problem, `factor` times the best strength of its `prior`, and the `entries`: solvers with how many dual steps
    the prior makes. `patient` finds the minimum."""

    name: str
    scale: int
    prior: Prior
    factor: float
    entries: dict[str, tuple[Solver, int]]
    patient: Solver


def races(size: Size) -> list[Race]:
    fista, admm, condat = solvers.FISTA(), solvers.ADMM(), solvers.CondatVu()
    # Deconvolution overshoots black and white: a minimiser is looked for well beyond them.
    gap = solvers.DualityGap(-1, 2)
    momentum = solvers.FISTA(iterations=size.exact, tolerance=1e-7, stopping=gap)
    splitting = solvers.ADMM(iterations=2 * size.exact, tolerance=1e-7, stopping=gap)
    few: dict[str, tuple[Solver, int]] = {f"FISTA, {steps} dual steps": (fista, steps) for steps in (4, 10, 20)}
    tv = few | {
        "FISTA, 4, Backtracking": (solvers.FISTA(step_size=solvers.Backtracking()), 4),
        "ISTA": (solvers.ISTA(), 4),
        "ADMM": (admm, 4),
        "ChambollePock": (solvers.ChambollePock(), 4),
        "CondatVu": (condat, 4),
        "JaxoptFISTA": (solvers.JaxoptFISTA(), 4),
        "JaxoptISTA": (solvers.JaxoptISTA(), 4),
        "JaxoptADMM": (solvers.JaxoptADMM(), 4),
    }
    splits: dict[str, tuple[Solver, int]] = {"FISTA": (fista, 10), "ADMM": (admm, 10), "CondatVu": (condat, 10)}
    smooth = splits | {"NonlinearCG": (solvers.NonlinearCG(), 10), "LBFGS": (solvers.LBFGS(), 10)}
    usual = priors.TotalVariation()
    every = [
        Race("TV", 2, usual, 1, tv, momentum),
        Race("TV, λ ten times the best", 2, usual, 10, few | {"CondatVu": (condat, 4)}, momentum),
        Race("Huber-TV", 2, priors.HuberTotalVariation(), 1, smooth, momentum),
        Race("wavelet L1", 2, priors.WaveletL1(), 1, splits, splitting),
        Race("TV", 4, usual, 1, tv, momentum),
    ]
    return [race for race in every if race.scale in {scale for scale, _ in size.conditions}]


class Exact(NamedTuple):
    """A problem in float64, the lowest objective that was found, and how far that is above the minimum at most,
    relative to it."""

    problem: Problem
    lowest: float
    certain: float

    def above(self, image: np.ndarray) -> float:
        with jax.enable_x64(True):
            return float(_objective(self.problem, jnp.asarray(image, jnp.float64))) / self.lowest - 1


@eqx.filter_jit
def _objective(problem: Problem, image: Float[Array, "H W"]) -> Float[Array, ""]:
    return problem.data.value(image) + problem.strength * problem.prior.value(image)


def exact(problem: Problem, start: Float[Array, "H W"], patient: Solver) -> Exact:
    """By a solver that measures its duality gap, with long proximal steps."""
    with jax.enable_x64(True):
        double = jax.tree.map(lambda v: v.astype(jnp.float64) if eqx.is_inexact_array(v) else v, problem)
        found = run(patient, _with_steps(double, 20), jnp.asarray(start, jnp.float64))
        lowest = float(_objective(double, jnp.asarray(found.image)))
    return Exact(double, lowest, found.stages[-1].gap)


def _with_steps(problem: Problem, dual_steps: int) -> Problem:
    prior: Any = problem.prior
    return replace(problem, prior=replace(prior, iterations=dual_steps))


def approach(
    solver: Solver, problem: Problem, start: Array, exact: Exact, seconds: float
) -> list[tuple[float, int, float]]:
    """For each gap that is reached in time: the gap there, iterations from the start, the residual there.

    It looks after every iteration at first, later after a twentieth more each time.
    """
    found, done, state, spent = [], 0, None, 0.0
    while len(found) < len(GAPS) and spent < seconds:
        more = max(done // 20, 1)
        begin = time.perf_counter()
        outcome = run(replace(solver, iterations=more), problem, start, state=state, tolerance=0.0)
        spent, done, state = spent + time.perf_counter() - begin, done + more, outcome.state
        above = exact.above(outcome.image)
        while len(found) < len(GAPS) and above <= GAPS[len(found)]:
            found.append((above, done, outcome.stages[-1].residual))
    return found


def race(case: Case, race: Race, seconds: float, rounds: int) -> dict[str, Any]:
    """All solvers on one problem: for each, seconds to compile and a row for each gap that it reached."""
    strength = race.factor * best(case, race.prior, case.strength, race.entries["CondatVu"][0]).strength
    problem = Problem(case.term, race.prior, jnp.asarray(strength, jnp.float32))
    reference = exact(problem, case.start, race.patient)
    jax.clear_caches()
    problems = {name: _with_steps(problem, steps) for name, (_, steps) in race.entries.items()}
    rows: dict[str, Any] = {}
    for name, (solver, _) in race.entries.items():
        first, second = (seconds_of(solver, problems[name], case.start, 21) for _ in range(2))
        found = approach(solver, problems[name], case.start, reference, seconds)
        reached = [
            {"gap": gap, "above": above, "iterations": iterations, "residual": residual, "seconds": []}
            for gap, (above, iterations, residual) in zip(GAPS, found, strict=False)
        ]
        rows[name] = {"compile_seconds": first - second, "reached": reached}
    for _ in range(rounds):
        for name, (solver, _) in race.entries.items():
            for row in rows[name]["reached"]:
                row["seconds"].append(seconds_of(solver, problems[name], case.start, row["iterations"]))
    return {"strength": strength, "minimum": reference.lowest, "certain": reference.certain, "rows": rows}
