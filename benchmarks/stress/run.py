"""One case of `benchmarks.stress`: run twice, and compared with what is required."""

import dataclasses
import functools
import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.methods import PRIORS, SMOOTH, SOLVERS
from benchmarks.stress.bounds import SLACK, UNIT, agreement, analysis_of, chain, ridge_sizes
from benchmarks.stress.cases import Case
from benchmarks.stress.data import (
    WHITE_RATE,
    has_samples,
    in_precision,
    initial_image,
    lens_of,
    picture_shape,
    placed_of,
    problem_of,
    situation,
    stored,
)
from benchmarks.stress.solve import LONG, Finding, Picture, certificate_of, ends_well, first_state, in_its, solve
from scsr_opt import reconstruct
from scsr_opt.errors import InputError
from scsr_opt.motion import Motion
from scsr_opt.operators import accumulate
from scsr_opt.priors import Bounded, RidgeRegulariser
from scsr_opt.solvers import Problem, Solver, implicit_minimiser, lipschitz_bound, run
from scsr_opt.solvers.stopping import misfit

_DESCENT_ITERATIONS = 30
_BATCH_SIZE = 3
# Linux lets a process have 65,530 mappings of memory, and a compiled program takes some tens.
_MANY_MAPPINGS = 20_000


def examine(case: Case) -> Finding:
    """Runs a case. Nothing is raised."""
    finding = Finding(case)
    try:
        _KINDS[case.kind](case, finding)
    except InputError as error:
        finding.outcome, finding.message = "refused", str(error)
        finding.checks["ends well"] = _has_to_be_refused(case)
    except Exception as error:  # whatever it is, it is what was looked for
        finding.outcome, finding.message = "raised", f"{type(error).__name__}: {error}"
        finding.checks["ends well"] = False
    else:
        if _has_to_be_refused(case):
            finding.checks["is refused"] = False
    return finding


def rows_of(group: list[Case]) -> list[dict[str, Any]]:
    """Runs cases that share a program. Returns a row for each, ready for JSON: its axes and what was found."""
    rows = []
    for case in group:
        found = examine(case)
        rows.append(
            {
                "name": case.name(), **dataclasses.asdict(case), "outcome": found.outcome, "passed": found.passed,
                "checks": found.checks, "numbers": found.numbers, "message": found.message,
            }
        )  # fmt: skip
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > _MANY_MAPPINGS:
        jax.clear_caches()
        gc.collect()
    return rows


def _has_to_be_refused(case: Case) -> bool:
    unknown = case.kind == "reconstruct" and case.motion == "not a number"
    return unknown or (case.solver in SMOOTH and not PRIORS[case.prior].smooth)


def _solve(case: Case, finding: Finding) -> None:
    found = solve(case)
    ends_well(finding, found.image, found.result, found.good, found.objectives)
    if case.solver in SMOOTH and found.good:
        before, after = np.asarray(found.objectives[:-1]), np.asarray(found.objectives[1:])
        allowed = SLACK * 2 * UNIT[case.precision] * np.abs(before)
        finding.checks["objective falls"] = bool((after - before <= allowed).all())
    if case.iterations <= LONG:
        again = solve(case)
        finding.checks["is reproducible"] = (
            np.array_equal(found.image, again.image) and found.result == again.result
            and np.array_equal(found.objectives, again.objectives, equal_nan=True)
        )  # fmt: skip
    if case.precision != "float64" and case.iterations <= LONG:
        _agrees(case, finding, found, _exact(dataclasses.replace(case, precision="float64", family="")))


def _agrees(case: Case, finding: Finding, found: Picture, exact: Picture) -> None:
    if found.certificate is None or exact.certificate is None or not (found.good and exact.good):
        return
    distance = float(np.linalg.norm(found.image.astype(float) - exact.image))
    finding.numbers["difference"], share = agreement(found.certificate, exact.certificate, distance)
    # A relative difference says nothing of a minimum that is next to 0 beside what it is added up from.
    least = 1e-6 * max(found.certificate.size, exact.certificate.size)
    if exact.certificate.objective > least:
        finding.numbers["relative difference"] = finding.numbers["difference"] / exact.certificate.objective
    finding.numbers["share of the bound"] = share
    finding.checks["agrees with float64"] = share <= 1


@functools.lru_cache(maxsize=32)
def _exact(case: Case) -> Picture:
    return solve(case)


def _descent(case: Case, finding: Finding) -> None:
    solver = SOLVERS[case.solver]
    with in_its(case):
        problem = problem_of(case)
        image = initial_image(case, problem.data.target.dtype)
        β = jnp.asarray(case.step, image.dtype) / lipschitz_bound(problem.data)
        table, last = (np.asarray(v, float) for v in _followed(solver, problem, image, β))
    objective, excess, size, lost, moved, whole = table
    n = image.size
    unit = UNIT[case.precision]
    rounding = (n + chain(case)) * unit * size
    rounding[1:] += rounding[:-1]
    error = (chain(case) * lost + chain(case) * whole / float(β)) * unit * moved
    rise = np.diff(objective)
    share = rise / np.maximum((excess + rounding + error)[1:], np.finfo(float).tiny)
    good = bool(np.isfinite(table).all())
    ends_well(finding, last, "iterations_exhausted" if good else "non_finite", good, tuple(objective))
    if good:
        finding.numbers["share of the bound"] = float(share.max())
        finding.checks["objective falls"] = bool((share <= 1).all())


@eqx.filter_jit
def _followed(solver: Solver, problem: Problem, image: Float[Array, "H W"], step_size: Float[Array, ""]) -> Any:
    """Follows the first iterations; of each: F, the excess g of its proximal step, Σ of the sizes of the terms of F,
    ‖Bᵀ(M B|X| + c)‖, ‖X' − X‖, ‖X‖ + ‖R‖; and the last picture."""
    data, λ = problem.data, problem.strength

    def of_prior(following: Any) -> tuple[Array, Array, Array]:
        """Returns g, the sizes of the terms of λΨ, and how far rounding may move ∇Ψ, by the same factor as ∇f."""
        if isinstance(problem.prior, RidgeRegulariser):
            of_value, of_gradient = ridge_sizes(problem.prior, following.image)
            size = 2 * problem.prior.value(following.image) + of_value
            return jnp.zeros_like(λ), λ * size, λ * jnp.linalg.norm(of_gradient)
        prior = analysis_of(problem.prior)
        assert prior is not None
        dual = following.prior.prior if isinstance(problem.prior, Bounded) else following.prior
        penalty, off = misfit(prior, prior.analysis(following.image), dual)
        return jnp.maximum(λ * off, 0), 2 * λ * penalty, jnp.zeros_like(λ)

    def one(state: Any, _: None) -> tuple[Any, Array]:
        following, record = solver.step(problem, state)
        excess, size_of_prior, lost_of_prior = of_prior(following)
        u = data.blurred(jnp.abs(following.image))
        spread = data.stencil(u)
        size = jnp.sum(u * (0.5 * spread + data.target)) + 0.5 * data.energy + size_of_prior
        lost = jnp.linalg.norm(data.blurred_adjoint(spread + data.target)) + lost_of_prior
        moved = jnp.linalg.norm(following.image - state.image)
        whole = jnp.linalg.norm(following.image) + jnp.linalg.norm(following.gradient_step)
        row = jnp.stack([record.data + record.prior, excess, size, lost, moved, whole])
        return following, row

    state = solver.init(problem, image)._replace(step_size=step_size)
    state, table = jax.lax.scan(one, state, None, length=_DESCENT_ITERATIONS)
    return table.T, state.image


def _gradient(case: Case, finding: Finding) -> None:
    """The derivatives of a sum over the picture, by the strength and by every sample's value."""
    with in_its(case):
        placed, lens = in_precision(placed_of(case), case.precision), lens_of(case)
        strength = jnp.asarray(case.strength, placed.value.dtype)
        term = stored(accumulate(placed, optics=lens), case.precision)
        image = initial_image(case, placed.value.dtype)
        toward = jnp.asarray(np.random.default_rng(case.seed).normal(size=image.shape), image.dtype)
        problem = Problem(term, PRIORS[case.prior], strength)
        found = [np.asarray(v) for v in _derivatives(problem, placed, strength, image, toward)]
        again = [np.asarray(v) for v in _derivatives(problem, placed, strength, image, toward)]
    picture, *derivatives = found
    ends_well(finding, picture, "iterations_exhausted", True, ())
    finding.checks["gradient is finite"] = all(np.isfinite(v).all() for v in derivatives)
    finding.checks["is reproducible"] = all(
        np.array_equal(a, b, equal_nan=True) for a, b in zip(found, again, strict=True)
    )
    finding.numbers["by strength"] = float(derivatives[0])
    finding.numbers["by samples"] = float(np.abs(derivatives[1]).max())


@eqx.filter_jit
def _derivatives(problem: Problem, placed: Any, strength: Array, image: Array, toward: Array) -> tuple[Array, ...]:
    def loss(strength: Array, value: Array) -> tuple[Array, Array]:
        target = accumulate(eqx.tree_at(lambda p: p.value, placed, value)).target
        at = eqx.tree_at(lambda p: (p.strength, p.data.target), problem, (strength, target))
        found = implicit_minimiser(at, image, iterations=200, adjoint_iterations=200)
        return jnp.sum(toward * found), found

    (by_strength, by_value), picture = jax.grad(loss, argnums=(0, 1), has_aux=True)(strength, placed.value)
    return picture, by_strength, by_value


def _vmap(case: Case, finding: Finding) -> None:
    """Solves several recordings at a time, and compares with one after another."""
    solver = SOLVERS[case.solver]
    with in_its(case):
        made = [problem_of(dataclasses.replace(case, seed=case.seed + k)) for k in range(_BATCH_SIZE)]
        image = initial_image(case, made[0].data.target.dtype)
        numbers, fixed = zip(*(eqx.partition(problem, eqx.is_array) for problem in made), strict=True)
        together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *numbers)
        states, residuals = _batched(solver, together, fixed[0], image, case.iterations)
        alone = [
            run(
                dataclasses.replace(solver, iterations=case.iterations),
                problem,
                image,
                tolerance=0.0,
                state=first_state(case, solver, problem, image),
            )  # fmt: skip
            for problem in made
        ]
    good, agrees = all(outcome.status.usable for outcome in alone), True
    for k, outcome in enumerate(alone):
        state = jax.tree.map(lambda v, k=k: v[k], states)
        picture = np.asarray(solver.image(state))
        same = dataclasses.replace(case, seed=case.seed + k)
        ends_well(finding, picture, outcome.status.name, outcome.status.usable, (outcome.stages[-1].objective,))
        if not finding.checks["ends well"] or not good:
            return
        certificates = []
        for image_of, of, residual in (
            (picture, state, float(residuals[k])),
            (outcome.image, outcome.state, outcome.stages[-1].residual),
        ):
            with in_its(case):
                moved = np.asarray(solver.gradient_step(made[k], of))
            stages = (dataclasses.replace(outcome.stages[-1], residual=residual),) * len(outcome.stages)
            certificates.append(certificate_of(same, solver, of, image_of, moved, stages))
        if None in certificates:
            close = np.allclose(picture, outcome.image, rtol=0, atol=1e3 * UNIT[case.precision] * np.abs(picture).max())
            finding.checks["under vmap as alone"] = agrees = agrees and bool(close)
            continue
        distance = float(np.linalg.norm(picture.astype(float) - outcome.image))
        _, share = agreement(certificates[0], certificates[1], distance)
        finding.numbers["share of the bound"] = max(share, finding.numbers.get("share of the bound", 0.0))
        finding.checks["under vmap as alone"] = agrees = agrees and share <= 1


@eqx.filter_jit
def _batched(solver: Solver, numbers: Any, fixed: Any, image: Array, iterations: int) -> tuple[Any, Array]:
    def one(numbers: Any) -> tuple[Any, Array]:
        problem = eqx.combine(numbers, fixed)

        def step(carry: tuple[Any, Array], _: None) -> tuple[tuple[Any, Array], None]:
            state, record = solver.step(problem, carry[0])
            return (state, record.residual), None

        begin = (solver.init(problem, image), jnp.zeros((), image.dtype))
        return jax.lax.scan(step, begin, None, length=iterations)[0]

    return jax.vmap(one)(numbers)


def _reconstruct(case: Case, finding: Finding) -> None:
    """Runs `reconstruct`, with motion, λ, prior, solver and lens given, or with the recording alone."""
    seen = situation(case)
    given: dict[str, Any] = {}
    if case.kind == "reconstruct":
        solver = dataclasses.replace(SOLVERS[case.solver], iterations=case.iterations)
        motion = Motion.of_velocity(seen.velocity)
        given = {"motion": motion, "strength": case.strength, "prior": PRIORS[case.prior], "solver": solver}
        given["optics"] = lens_of(case)

    def whole() -> Any:
        return reconstruct(
            seen.spikes, scale=case.scale, key=seen.key, frames=case.frames, white_rate=WHITE_RATE,
            bad_pixels=seen.bad, **given,
        )  # fmt: skip

    first, second = whole(), whole()
    objectives = tuple(stage.objective for stage in first.stages)
    ends_well(finding, first.image, first.status.name, first.status.usable, objectives)
    finding.checks["ends well"] &= first.image.shape == picture_shape(case)
    finding.checks["ends well"] &= first.status.name != "no_samples" or not has_samples(seen)
    same = np.array_equal(first.image, second.image) and first.status == second.status
    # Equal, too, where both are not a number.
    finding.checks["is reproducible"] = same and np.array_equal(
        np.array(objectives), np.array([stage.objective for stage in second.stages]), equal_nan=True
    )


_KINDS: dict[str, Callable[[Case, Finding], None]] = {
    "solve": _solve,
    "reconstruct": _reconstruct,
    "defaults": _reconstruct,
    "descent": _descent,
    "gradient": _gradient,
    "vmap": _vmap,
}
