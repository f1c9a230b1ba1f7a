"""Solves of `benchmarks.stress`, and the certificates of their pictures."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.methods import BOUNDED_STEPS, PRIORS, SMOOTH, SOLVERS
from benchmarks.stress.bounds import Certificate, analysis_of, certificate, measure
from benchmarks.stress.cases import Case
from benchmarks.stress.data import initial_image, problem_of
from scsr_opt.priors import Bounded, RidgeRegulariser
from scsr_opt.solvers import ChambollePock, CondatVu, Problem, Solver, lipschitz_bound, run
from scsr_opt.solvers.admm import ADMMState
from scsr_opt.solvers.jaxopt_gradient import JaxoptFISTA, JaxoptISTA
from scsr_opt.solvers.loop import strongly_typed
from scsr_opt.solvers.proximal_gradient import FISTA, ISTA

# Runs of more iterations are not made twice, and have no tolerance to end by.
LONG = 1000
# First pictures whose squares float32 does not hold, or hardly.
ABSURD = ("1e12", "1e30")


@dataclass
class Finding:
    """The outcome of a case. **Fields:** `outcome`: the name of a `Result`, "refused" (an `InputError`) or "raised".
    `checks`: requirements, and whether they hold. `numbers`: what was measured. `message`: an error's sentence."""

    case: Case
    outcome: str = ""
    checks: dict[str, bool] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)
    message: str = ""

    @property
    def passed(self) -> bool:
        return all(self.checks.values())


class Picture(NamedTuple):
    """A solve's `image`, `result` (its name), whether that is `good`, `objectives` of all stages, and its
    `certificate`; None where none is known."""

    image: Float[np.ndarray, "H W"]
    result: str
    good: bool
    objectives: tuple[float, ...]
    certificate: Certificate | None


def ends_well(finding: Finding, image: np.ndarray, result: str, good: bool, objectives: tuple[float, ...]) -> None:
    """A picture is finite in any case; with a good result so are all numbers recorded with it. Only where the step is
    above its bound, the first picture is absurd, or M was rounded to what no solve can end with, may it fail."""
    finding.outcome = result
    finite = bool(np.isfinite(image).all())
    long = (finding.case.step or 0) > 1 and finding.case.solver in BOUNDED_STEPS
    # F ≥ 0, as long as M has no negative eigenvalue; with one F has no minimum, unless Ψ holds the picture.
    fallen = min((value for value in objectives if value < 0), default=0.0)
    unbounded = finding.case.precision == "bfloat16" and fallen < -abs((*objectives, 0.0)[0])
    may_fail = good or result == "no_samples" or long or unbounded or finding.case.start in ABSURD
    finding.checks["ends well"] = finite and may_fail and (not good or all(math.isfinite(v) for v in objectives))
    if objectives:
        finding.numbers["objective"] = objectives[-1]
    finding.numbers["iterations"] = len(objectives)


def in_its(case: Case) -> Any:
    """The context in which JAX works in the case's precision."""
    return jax.enable_x64(case.precision == "float64")


def solve(case: Case) -> Picture:
    """Solves a case by `run`, from the state of a first picture or, with start "other", of quite another problem."""
    solver = SOLVERS[case.solver]
    solver = dataclasses.replace(solver, iterations=case.iterations)
    if case.iterations > LONG:
        solver = dataclasses.replace(solver, tolerance=0.0)
    with in_its(case):
        problem = problem_of(case)
        image = initial_image(case, problem.data.target.dtype)
        state = first_state(case, solver, problem, image)
        if case.start == "other":
            other = eqx.tree_at(
                lambda p: (p.data.target, p.strength),
                problem,
                (-100 * problem.data.target, jnp.full_like(problem.strength, 1e4)),
            )
            first = first_state(case, solver, other, image)
            before = run(dataclasses.replace(solver, iterations=10), other, image, state=first).state
            state = strongly_typed(solver.warm(problem, before))
        if case.step is not None:
            state = _with_step(case.step, state, problem)
        outcome = run(solver, problem, image, state=state)
        gradient_step = np.asarray(solver.gradient_step(problem, outcome.state))
        certified = outcome.status.usable and bool(np.isfinite(gradient_step).all())
        stages = outcome.stages
    objectives = tuple(stage.objective for stage in stages)
    known = certificate_of(case, solver, outcome.state, outcome.image, gradient_step, stages) if certified else None
    return Picture(outcome.image, outcome.status.name, outcome.status.usable, objectives, known)


def _with_step(step: float, state: Any, problem: Problem) -> Any:
    """The state with β a multiple of 1/L, or with ADMM's ρ a multiple of its first one."""
    if isinstance(state, ADMMState):
        return state._replace(penalty=step * state.penalty)
    return state._replace(step_size=jnp.asarray(step, state.image.dtype) / lipschitz_bound(problem.data))


def first_state(case: Case, solver: Solver, problem: Problem, image: Float[Array, "H W"]) -> Any:
    """The first state, operation by operation, as compiling it would take as long as compiling all that follows; but
    compiled where there are loops, each of which would be compiled every time."""
    solver = dataclasses.replace(solver, iterations=1, tolerance=0.0)
    if case.lens is not None or case.prior == "bilateral TV":
        return _compiled_first(solver, problem, image)
    return strongly_typed(solver.init(problem, image))


@eqx.filter_jit
def _compiled_first(solver: Solver, problem: Problem, image: Float[Array, "H W"]) -> Any:
    return strongly_typed(solver.init(problem, image))


def certificate_of(
    case: Case, solver: Solver, state: Any, image: np.ndarray, gradient_step: np.ndarray, stages: tuple[Any, ...]
) -> Certificate | None:
    """Certifies a picture by the state that its solver ended in, measured in float64; None where the prior, or
    what the solver keeps of it, has no dual variable that certifies anything."""
    prior = PRIORS[case.prior]
    analysis = analysis_of(prior)
    proximal = isinstance(solver, ISTA | FISTA)
    foreign = solver.inner_iterations if isinstance(solver, JaxoptISTA | JaxoptFISTA) else 0
    # Its own gradient certifies a ridge regulariser's picture, as a proximal or a gradient step leaves it.
    ridge = isinstance(prior, RidgeRegulariser) and (proximal or foreign > 0 or case.solver in SMOOTH)
    if not ridge and (analysis is None or (isinstance(prior, Bounded) and not proximal)):
        return None
    exactly = dataclasses.replace(case, precision="float64")
    with jax.enable_x64(True):
        problem, origin = problem_of(exactly), initial_image(exactly, jnp.dtype("float64"))
        image64, moved = (jnp.asarray(v, jnp.float64) for v in (image, gradient_step))
        primal_dual = isinstance(solver, CondatVu | ChambollePock)
        β = jnp.asarray(1 / state.lipschitz if primal_dual else np.asarray(state.step_size), jnp.float64)
        if ridge:
            dual = None
        elif foreign:
            dual = _dual_of(prior.with_inner_iterations(foreign), moved, β * problem.strength)
        elif case.solver in SMOOTH:
            dual = _slope_of(analysis, image64)
        else:
            own = state.prior if proximal else state.dual.field
            own = own.prior if isinstance(prior, Bounded) else own
            dual = jax.tree.map(lambda v: jnp.asarray(np.asarray(v), jnp.float64), own)
        seen = measure(problem, image64, origin, moved, β, dual)
    if not math.isfinite(float(seen.objective)):
        return None
    carried = len(stages) if isinstance(solver, FISTA) else 0
    return certificate(
        case, seen, residual=stages[-1].residual, step_size=float(np.asarray(β).min()), iterations=carried,
        inexact=bool(foreign) or (ridge and proximal),
    )  # fmt: skip


@eqx.filter_jit
def _dual_of(prior: Any, image: Array, strength: Array) -> Any:
    """The dual variable of a proximal step that starts from nothing."""
    return prior.prox(image, strength, prior.initial_state(image))[1]


@eqx.filter_jit
def _slope_of(prior: Any, image: Array) -> Any:
    """∇φ(KX), where φ has one."""
    return jax.grad(lambda field: jnp.sum(prior.penalties(field)))(prior.analysis(image))
