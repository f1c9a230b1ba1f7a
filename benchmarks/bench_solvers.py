"""Solvers, priors, data terms and precisions: how long to which gap above the minimum, and to which picture.

Not the full product: every solver at the default prior, every prior at the default solver, fixed windows and float64
with the default and one splitting method; each at every scale. The minimum of each problem is found in float64, and for
priors with a dual variable a duality gap says how far above the true one it may be, for the ridge regulariser its own
gradient.
"""

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.bench_cases import GAPS, Posed, Size, posed, quality, recorded
from benchmarks.bench_timing import compiling_anew, in_turns, program
from benchmarks.choosing_cases import seconds_of
from benchmarks.choosing_priors import tried
from benchmarks.choosing_solvers import Exact, exact
from benchmarks.stress_methods import SOLVERS
from scsr_opt import priors, solvers
from scsr_opt.camera.sampling_rules import Intervals, Measuring, Windows
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.priors.analysis import Analysis
from scsr_opt.priors.prior import Prior
from scsr_opt.progress import Progress
from scsr_opt.solvers import Problem, Solver, run
from scsr_opt.solvers.stopping import Evidence

DEFAULT_SOLVER = "FISTA"
# Frames that spikes are counted over: about twice the interval of a pixel at half the intensity of white.
WINDOW = 8
# Measured by the duality gap while it runs, which the others are not; or set to steps that only stress would take.
_NO_COMPETITORS = ("duality gap", "balance")
# What is never reached is not waited for longer than this.
_MOST_ITERATIONS = 2000


class Entry(NamedTuple):
    """One solver on one problem. **Fields:** `part`: of the design; the names of what is combined; `factor`: λ over
    that of the default prior."""

    part: str
    solver: str
    prior: str
    measuring: str
    precision: str
    factor: float = 1.0


def design(scale: int, solvers: tuple[str, ...] | None = None, priors: tuple[str, ...] | None = None) -> list[Entry]:
    """What is combined with what at a scale: all solvers and priors, or those of the names."""
    usual_prior = prior_name(default_prior(scale))

    def wanted(name: str, names: tuple[str, ...] | None) -> bool:
        return names is None or name in names

    usual = ("Intervals", "float32")
    competing = [name for name in SOLVERS if not any(w in name for w in _NO_COMPETITORS) and wanted(name, solvers)]
    found = [Entry("solvers", name, usual_prior, *usual) for name in competing]
    for name, _, factor, _ in tried():
        if name != usual_prior and wanted(name, priors):
            found.append(Entry("priors", DEFAULT_SOLVER, name, *usual, factor))
    for name in (DEFAULT_SOLVER, "ADMM"):
        if name == DEFAULT_SOLVER or solvers is None:
            found.append(Entry("data terms", name, usual_prior, "Windows", "float32"))
            found.append(Entry("precisions", name, usual_prior, "Intervals", "float64"))
    return found


def problem_of(entry: Entry, case: Posed) -> Problem:
    """In float32."""
    return Problem(case.term, prior_of(entry.prior), jnp.asarray(entry.factor * case.strength, jnp.float32))


def prior_of(name: str) -> Prior:
    return next(prior for known, prior, _, _ in tried() if known == name)


def prior_name(prior: Prior) -> str:
    """By which name `prior_of` finds a prior of this kind."""
    return next(known for known, other, _, _ in tried() if type(other) is type(prior))


def measuring_of(name: str) -> Measuring:
    return Intervals() if name == "Intervals" else Windows(WINDOW)


def precisely(entry: Entry) -> Any:
    """JAX in the precision of an entry, as a context."""
    return jax.enable_x64(True) if entry.precision == "float64" else contextlib.nullcontext()


def _doubled(tree: Any) -> Any:
    return jax.tree.map(lambda v: v.astype(jnp.float64) if eqx.is_inexact_array(v) else v, tree)


def minimum(problem: Problem, start: Float[Array, "H W"], iterations: int) -> Exact | None:
    """The lowest objective, in float64; None where the prior has none (plug-and-play) or it takes too long (RED)."""
    if isinstance(problem.prior, Analysis):
        patient = solvers.FISTA(iterations=iterations, tolerance=1e-7, stopping=solvers.DualityGap(-1, 2))
        return exact(problem, start, patient)
    if not isinstance(problem.prior, priors.RidgeRegulariser | priors.TotalGeneralizedVariation | priors.Bounded):
        return None
    with jax.enable_x64(True):
        double = _doubled(problem)
        found = run(solvers.FISTA(iterations=iterations, tolerance=1e-8), double, jnp.asarray(start, jnp.float64))
        lowest, certain = min(stage.objective for stage in found.stages), math.nan
        if isinstance(double.prior, priors.RidgeRegulariser):
            certain = float(_gap_by_gradient(double, jnp.asarray(found.image)))
    return Exact(double, lowest, certain)


@eqx.filter_jit
def _gap_by_gradient(problem: Problem, image: Float[Array, "H W"]) -> Float[Array, ""]:
    """F above its minimum at most, relative, for a convex Ψ with a gradient: the duality gap with p = ∇Ψ, g = 0."""
    prior: Any = problem.prior
    slope = problem.data.gradient(image) + problem.strength * prior.gradient(image)
    objective, nothing = problem.data.value(image) + problem.strength * prior.value(image), jnp.zeros(())
    return solvers.DualityGap(-1, 2).gap(Evidence(image, objective, slope, nothing, nothing))


def followed(
    solver: Solver,
    problem: Problem,
    start: Array,
    above: Callable[[np.ndarray], float | None],
    truth: Float[np.ndarray, "H W"],
    scale: int,
    seconds: float,
) -> list[dict[str, Any]]:
    """Gap, PSNR and SSIM of the pictures of a run, until the last gap is reached or its time is up.

    After every iteration at first, later after a twentieth more each time, and after few only where a picture takes
    long. The seconds that looking takes do not count.
    """
    found: list[dict[str, Any]] = []
    done, state, spent = 0, None, 0.0
    while spent < seconds and done < _MOST_ITERATIONS:
        more = max(done // 20, 1)
        begin = time.perf_counter()
        outcome = run(replace(solver, iterations=more), problem, start, state=state, tolerance=0.0)
        if done > 1:  # the first two compile
            spent += time.perf_counter() - begin
        done, state, gap = done + more, outcome.state, above(outcome.image)
        ratio, likeness = quality(truth, outcome.image, scale)
        found.append({"iterations": done, "gap": gap, "psnr": ratio, "ssim": likeness})
        if gap is not None and gap <= GAPS[-1]:
            break
        if not outcome.result.good:
            break
    return found


def reached(looks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The first look at or below each gap."""
    measured = [look for look in looks if look["gap"] is not None]
    firsts = ((gap, next((look["iterations"] for look in measured if look["gap"] <= gap), None)) for gap in GAPS)
    return [{"gap": gap, "iterations": iterations} for gap, iterations in firsts if iterations is not None]


class _Ready(NamedTuple):
    entry: Entry
    solver: Solver
    problem: Problem
    start: Array
    row: dict[str, Any]


def _first_iteration(solver: Solver, problem: Problem, start: Array) -> Any:
    return solver.step(problem, solver.init(problem, start))


def _compile_seconds(solver: Solver, problem: Problem, start: Array) -> float:
    """What the first run of one iteration takes beyond the second; 0 where its program is that of an entry before, or
    of the minimum."""
    with compiling_anew():
        first, second = (seconds_of(solver, problem, start, 1) for _ in range(2))
    return max(first - second, 0.0)


def _prepared(entry: Entry, case: Posed, known: Exact | None, size: Size) -> _Ready:
    """An entry followed once, all that it needs compiled."""
    solver: Solver = SOLVERS[entry.solver]
    problem, start = problem_of(entry, case), case.start
    with precisely(entry):
        if entry.precision == "float64":
            problem, start = _doubled(problem), _doubled(start)
        compiling = _compile_seconds(solver, problem, start)
        memory = program(_first_iteration, solver, problem, start).memory if size.careful else None
        looks = followed(
            solver, problem, start, lambda image: None if known is None else known.above(image), case.truth, case.scale,
            size.seconds,
        )  # fmt: skip
    row = {
        **entry._asdict(), "scale": case.scale, "shape": list(case.start.shape),
        "strength": entry.factor * case.strength,
        "certain": None if known is None or math.isnan(known.certain) else known.certain,
        "compile_seconds": compiling, "memory": memory, "looks": looks, "reached": reached(looks),
    }  # fmt: skip
    return _Ready(entry, solver, problem, start, row)


def measure(size: Size, seed: int, progress: Progress) -> list[dict[str, Any]]:
    """A row for each entry and scale, ready for JSON."""
    designs = {scale: design(scale, size.solvers, size.priors) for scale in size.scales}
    rows = []
    progress.start(sum(map(len, designs.values())), "solvers")
    try:
        for scale, entries in designs.items():
            made = recorded("camera", scale=scale, sensor=size.sensor, seed=seed)
            measurings = dict.fromkeys(entry.measuring for entry in entries)
            cases = {name: posed(made, measuring_of(name), careful=size.careful) for name in measurings}
            jax.clear_caches()  # of what was compiled for the strength: each entry is to say what it takes
            minima: dict[Any, Exact | None] = {}
            ready = []
            for entry in entries:
                case, asked = cases[entry.measuring], (entry.measuring, entry.prior)
                if asked not in minima:
                    minima[asked] = minimum(problem_of(entry, case), case.start, size.exact)
                ready.append(_prepared(entry, case, minima[asked], size))
                progress.advance(1)
            _time(ready, size.rounds)
            rows += [one.row for one in ready]
    finally:
        progress.finish()
    return rows


def _time(ready: list[_Ready], rounds: int) -> None:
    """Puts the seconds of runs to each gap, and to the last look, into the rows; all in turns."""

    def call(one: _Ready, iterations: int) -> Callable[[], float]:
        def timed() -> float:
            with precisely(one.entry):
                return seconds_of(one.solver, one.problem, one.start, iterations)

        return timed

    calls = {}
    for number, one in enumerate(ready):
        wanted = {1, one.row["looks"][-1]["iterations"], *(gap["iterations"] for gap in one.row["reached"])}
        for iterations in sorted(wanted):
            calls[number, iterations] = call(one, iterations)
    taken = in_turns(calls, rounds)
    for number, one in enumerate(ready):
        for gap in one.row["reached"]:
            gap["seconds"] = taken[number, gap["iterations"]]
        own = sorted((iterations, float(np.median(t))) for (n, iterations), t in taken.items() if n == number)
        at, seconds = zip(*own, strict=True)
        for look in one.row["looks"]:
            look["seconds"] = float(np.interp(look["iterations"], at, seconds))
        last = max(at)
        most = np.asarray(taken[number, last]) - (np.asarray(taken[number, 1]) if last > 1 else 0)
        one.row["iteration_seconds"] = (most / max(last - 1, 1)).tolist()
