"""Solvers, priors, data terms and precisions: how long to which gap above the minimum, and to which picture.

The full product would be some thousands of runs of which most say the same. So at each scale there are every solver
with the default prior, every prior with the default solver, and windows and float64 with the default solver and ADMM.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from benchmarks.bench.size import Size
from benchmarks.choosing import compared_priors
from benchmarks.methods import SOLVERS
from benchmarks.race import Entry, Minimum, as_float64, minimum, race
from benchmarks.recordings import Posed, posed, recorded
from scsr_opt.camera.sampling_rules import Intervals, SamplingRule, Windows
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.priors import Prior
from scsr_opt.solvers import FISTA, Problem

DEFAULT_SOLVER = "FISTA"
# Frames that spikes are counted over: about twice the interval of a pixel at half the intensity of white.
MEASURINGS: dict[str, SamplingRule] = {"Intervals": Intervals(), "Windows": Windows(8)}
# Solvers that measure a duality gap while they run, which the others do not, and steps that only stress would take.
_LEFT_OUT = ("duality gap", "balance")


class Combination(NamedTuple):
    """A solver, a prior, a data term and a precision by their names. **Fields:** `part`: of the design; `factor`: λ
    over that of the default prior."""

    part: str
    solver: str
    prior: str
    measuring: str = "Intervals"
    precision: str = "float32"
    factor: float = 1.0


def design(scale: int, solvers: tuple[str, ...] | None, priors: tuple[str, ...] | None) -> Iterator[Combination]:
    """All combinations at a scale, of all solvers and priors or those of the names."""
    default = prior_name(default_prior(scale))
    for name in SOLVERS:
        if (solvers is None or name in solvers) and not any(word in name for word in _LEFT_OUT):
            yield Combination("solvers", name, default)
    for name, (_, factor, _) in compared_priors().items():
        if name != default and (priors is None or name in priors):
            yield Combination("priors", DEFAULT_SOLVER, name, factor=factor)
    for name in (DEFAULT_SOLVER,) if solvers is not None else (DEFAULT_SOLVER, "ADMM"):
        yield Combination("data terms", name, default, measuring="Windows")
        yield Combination("precisions", name, default, precision="float64")


def prior_name(prior: Prior) -> str:
    """The name of a prior of this kind among those that are compared."""
    return next(name for name, (other, _, _) in compared_priors().items() if type(other) is type(prior))


def problem_of(combination: Combination, case: Posed) -> Problem:
    """The problem of a combination, in float32."""
    prior = compared_priors()[combination.prior][0]
    return Problem(case.term, prior, jnp.asarray(combination.factor * case.strength, jnp.float32))


def measure(size: Size, seed: int, advance: Callable[[int], None]) -> list[dict[str, Any]]:
    """A row for each combination and scale, ready for JSON: its names, `scale`, `shape`, `strength` and what `race`
    returns."""
    rows: list[dict[str, Any]] = []
    for scale in size.scales:
        rows += _rows(scale, list(design(scale, size.solvers, size.priors)), size, seed)
        advance(1)
    jax.clear_caches()  # programs of two precisions that no other family needs
    return rows


def _rows(scale: int, combinations: list[Combination], size: Size, seed: int) -> list[dict[str, Any]]:
    made = recorded("camera", scale=scale, sensor=size.sensor, seed=seed)
    cases = {
        name: posed(made, MEASURINGS[name], validate=size.careful)
        for name in dict.fromkeys(one.measuring for one in combinations)
    }
    jax.clear_caches()  # programs that validated λ: each row says what its own compilation takes
    minima: dict[tuple[str, str], Minimum | None] = {}
    entries: dict[Combination, Entry] = {}
    for one in combinations:
        case, key = cases[one.measuring], (one.measuring, one.prior)
        problem, start = problem_of(one, case), case.start
        if key not in minima:
            minima[key] = minimum(problem, start, FISTA(iterations=size.exact))
        if one.precision == "float64":
            with jax.enable_x64(True):
                problem, start = as_float64(problem), as_float64(start)
        entries[one] = Entry(SOLVERS[one.solver], problem, start, minima[key])
    found = race(
        entries, made.truth(len(made.spikes) // 2), scale, seconds=size.seconds, rounds=size.rounds, memory=size.careful
    )
    return [
        {**one._asdict(), "scale": scale, "shape": list(entry.start.shape),
         "strength": one.factor * cases[one.measuring].strength, **found[one]}
        for one, entry in entries.items()
    ]  # fmt: skip
