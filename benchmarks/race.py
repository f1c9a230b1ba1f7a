"""Solvers on one problem: how long each takes to which gap above a minimum that is known."""

import contextlib
import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.recordings import quality
from benchmarks.timing import compiling_anew, in_turns, program
from scsr_opt import priors, solvers
from scsr_opt.priors.analysis import Analysis
from scsr_opt.solvers import Problem, Solver, run
from scsr_opt.solvers.stopping import Evidence

GAPS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
# A gap that is not reached in as many iterations is not waited for.
MOST_ITERATIONS = 2000
# Deconvolution overshoots black and white: a minimiser is looked for well beyond them.
_DUALITY_GAP = solvers.DualityGap(-1, 2)
_DUAL_STEPS_FOR_MINIMUM = 20


class Minimum(NamedTuple):
    """A `problem` in float64, the `lowest` objective that was found, and how far that is above the minimum at most,
    relative to it (`certain`; not a number where nothing certifies it)."""

    problem: Problem
    lowest: float
    certain: float

    def gap(self, image: Float[np.ndarray, "H W"]) -> float:
        """Returns F(image) above the lowest objective, relative to it."""
        with jax.enable_x64(True):
            return float(_objective(self.problem, jnp.asarray(image, jnp.float64))) / self.lowest - 1


@eqx.filter_jit
def _objective(problem: Problem, image: Float[Array, "H W"]) -> Float[Array, ""]:
    return problem.data.value(image) + problem.strength * problem.prior.value(image)


def minimum(problem: Problem, start: Float[Array, "H W"], solver: Solver) -> Minimum | None:
    """Runs a solver of many iterations in float64; None where the prior has no objective (plug-and-play) or takes too
    long (RED). A duality gap, or for the ridge regulariser its gradient, certifies the result."""
    kinds = (priors.RidgeRegulariser, priors.TotalGeneralizedVariation, priors.Bounded)
    with jax.enable_x64(True):
        double = as_float64(problem)
        if isinstance(problem.prior, Analysis):
            patient = replace(solver, tolerance=1e-7, stopping=_DUALITY_GAP)
            found = run(patient, with_dual_steps(double, _DUAL_STEPS_FOR_MINIMUM), as_float64(start))
            return Minimum(double, float(_objective(double, jnp.asarray(found.image))), found.stages[-1].gap)
        if not isinstance(problem.prior, kinds):
            return None
        found = run(replace(solver, tolerance=1e-8), double, as_float64(start))
        certain = math.nan
        if isinstance(double.prior, priors.RidgeRegulariser):
            certain = float(_gap_by_gradient(double, jnp.asarray(found.image)))
    return Minimum(double, min(stage.objective for stage in found.stages), certain)


@eqx.filter_jit
def _gap_by_gradient(problem: Problem, image: Float[Array, "H W"]) -> Float[Array, ""]:
    """F above its minimum at most, relative, for a convex Ψ with a gradient: the duality gap with p = ∇Ψ, g = 0."""
    prior: Any = problem.prior
    slope, zero = problem.data.gradient(image) + problem.strength * prior.gradient(image), jnp.zeros(())
    return _DUALITY_GAP.gap(Evidence(image, _objective(problem, image), slope, zero, zero))


def as_float64(tree: Any) -> Any:
    """A copy with all real arrays in float64, to be made where JAX is set to it."""
    return jax.tree.map(lambda v: v.astype(jnp.float64) if eqx.is_inexact_array(v) else v, tree)


def with_dual_steps(problem: Problem, dual_steps: int) -> Problem:
    """The problem with another number of dual steps in each proximal step of its prior."""
    prior: Any = problem.prior
    return replace(problem, prior=replace(prior, iterations=dual_steps))


class Entry(NamedTuple):
    """A solver that takes part in a race, its problem and first picture (in the precision it is to run in), and the
    minimum of the problem, None where there is none."""

    solver: Solver
    problem: Problem
    start: Float[Array, "H W"]
    minimum: Minimum | None


def race(
    entries: Mapping[Any, Entry],
    truth: Float[np.ndarray, "H W"],
    scale: int,
    *,
    seconds: float,
    rounds: int,
    memory: bool = False,
) -> dict[Any, dict[str, Any]]:
    """Follows each entry once, then times all in turns.

    **Arguments:** `seconds`: in which a solver has to reach a gap. `rounds`: of timing. `memory`: whether the bytes of
    an iteration's program are looked at, which takes a compilation more.

    **Returns:** for each entry a row, ready for JSON: `compile_seconds`; `memory`, bytes or None; `looks`, the pictures
    that were looked at (`iterations`, `gap`, `residual`, `psnr`, `ssim`, `seconds` to it); `reached`, the first look at
    or below each of `GAPS`, with the `seconds` of each round; `iteration_seconds` of each round; `certain`, to which
    the minimum is known, or None.
    """
    rows: dict[Any, dict[str, Any]] = {}
    for name, entry in entries.items():
        with _precision(entry):
            compiling = _compile_seconds(entry)
            first = (entry.solver, entry.problem, entry.start)
            held = program(lambda s, p, x: s.step(p, s.init(p, x)), *first).memory if memory else None
            looks = followed(entry, truth, scale, seconds)
        known = None if entry.minimum is None or math.isnan(entry.minimum.certain) else entry.minimum.certain
        rows[name] = {
            "compile_seconds": compiling, "memory": held, "looks": looks, "reached": reached(looks), "certain": known,
        }  # fmt: skip
    _time(entries, rows, rounds)
    return rows


def _precision(entry: Entry) -> contextlib.AbstractContextManager[None]:
    return jax.enable_x64(entry.problem.data.target.dtype == jnp.float64)


def _compile_seconds(entry: Entry) -> float:
    """Seconds that the first run of one iteration takes beyond the second; 0 where its program is that of an entry
    before, or of the minimum."""
    with compiling_anew():
        first, second = (_seconds(entry, 1) for _ in range(2))
    return max(first - second, 0.0)


def _seconds(entry: Entry, iterations: int) -> float:
    begin = time.perf_counter()
    run(replace(entry.solver, iterations=iterations), entry.problem, entry.start, tolerance=0.0)
    return time.perf_counter() - begin


def followed(entry: Entry, truth: Float[np.ndarray, "H W"], scale: int, seconds: float) -> list[dict[str, Any]]:
    """Pictures of a run, until the last gap is reached or its time is up.

    After every iteration at first, later after a twentieth more each time, and after few only where a picture takes
    long. The seconds that it takes to look at pictures do not count.
    """
    looks: list[dict[str, Any]] = []
    done, state, spent = 0, None, 0.0
    while spent < seconds and done < MOST_ITERATIONS:
        more = max(done // 20, 1)
        begin = time.perf_counter()
        outcome = run(replace(entry.solver, iterations=more), entry.problem, entry.start, state=state, tolerance=0.0)
        if done > 1:  # the first two compile
            spent += time.perf_counter() - begin
        done, state = done + more, outcome.state
        gap = None if entry.minimum is None else entry.minimum.gap(outcome.image)
        psnr, ssim = quality(truth, outcome.image, scale)
        residual = outcome.stages[-1].residual
        looks.append({"iterations": done, "gap": gap, "residual": residual, "psnr": psnr, "ssim": ssim})
        if not outcome.status.usable or (gap is not None and gap <= GAPS[-1]):
            break
    return looks


def reached(looks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The first look at or below each gap: that `gap`, how far it is `above` the minimum, `iterations`, `residual`."""
    rows = []
    for gap in GAPS:
        first = next((look for look in looks if look["gap"] is not None and look["gap"] <= gap), None)
        if first is not None:
            rows.append(
                {"gap": gap, "above": first["gap"], "iterations": first["iterations"], "residual": first["residual"]}
            )
    return rows


def _time(entries: Mapping[Any, Entry], rows: dict[Any, dict[str, Any]], rounds: int) -> None:
    """Puts the seconds of runs to each gap, and to the last look, into the rows; all in turns."""

    def timed(entry: Entry, iterations: int) -> None:
        with _precision(entry):
            _seconds(entry, iterations)

    calls = {}
    for name, row in rows.items():
        wanted = {1, row["looks"][-1]["iterations"], *(gap["iterations"] for gap in row["reached"])}
        for iterations in sorted(wanted):
            calls[name, iterations] = lambda entry=entries[name], n=iterations: timed(entry, n)
    taken = in_turns(calls, rounds)
    for name, row in rows.items():
        own = {iterations: seconds for (other, iterations), seconds in taken.items() if other == name}
        for gap in row["reached"]:
            gap["seconds"] = own[gap["iterations"]]
        for look in row["looks"]:
            look["seconds"] = float(np.interp(look["iterations"], list(own), [np.median(s) for s in own.values()]))
        last = max(own)
        beyond_first = np.asarray(own[last]) - (np.asarray(own[1]) if last > 1 else 0)
        row["iteration_seconds"] = (beyond_first / max(last - 1, 1)).tolist()
