"""The solvers against an independent float64 solution of one small problem, and the loop around them."""

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt import solvers
from scsr_opt.errors import InputError
from scsr_opt.priors import Bounded, HuberTotalVariation, TotalVariation
from scsr_opt.solvers import (
    FISTA,
    ISTA,
    JaxoptFISTA,
    JaxoptISTA,
    NormBound,
    Outcome,
    Problem,
    Status,
    lipschitz_bound,
    run,
)
from scsr_opt.solvers import loop as loop

# One step size for all pixels, so that what is said of a step is easily made anew; the others are in test_step_size.py.
SOLVERS = {
    "ISTA": ISTA,
    "FISTA": partial(FISTA, step_size=NormBound()),
    "jaxopt ISTA": JaxoptISTA,
    "jaxopt FISTA": JaxoptFISTA,
}


# Of a sum of some thousand numbers in float32, relative to the sum of their absolute values.
ROUNDING = 4e-7


@pytest.fixture(scope="module")
def solved(case) -> dict[str, Outcome]:
    """Each solver run for 200 iterations, whatever the residual."""
    return {name: run(make(iterations=200, tolerance=0), case.problem, case.start) for name, make in SOLVERS.items()}


# How far above the minimum each ends, relative. ISTA and FISTA keep the dual: the rounding of float32 is what is left
# (1e-7 · Σ ω Y² ≈ 60, over an objective of about 1.5). jaxopt's proximal step has 100 dual steps from nothing, whose
# error, O(λβ/100)², does not go away with more iterations.
CLOSE = {"ISTA": 2e-5, "FISTA": 2e-5, "jaxopt ISTA": 3e-4, "jaxopt FISTA": 3e-4}


@pytest.mark.parametrize("name", SOLVERS)
def test_all_solvers_find_the_same_minimum(name, case, minimum, solved):
    least = case.objective(minimum)
    above = case.objective(solved[name].image) / least - 1
    assert -1e-7 <= above <= CLOSE[name]
    objectives = np.array([stage.objective for stage in solved[name].stages])
    within = int(np.argmax(objectives / least - 1 < 1e-3)) + 1
    print(f"{name}: {above:.1e} above the minimum after 200 iterations, within 0.1 % after {within}")
    assert within <= 40


def test_the_problem_itself_is_the_written_out_one(case, minimum):
    value = float(case.problem.data.value(jnp.asarray(minimum, jnp.float32))) + case.penalty(minimum)
    assert value == pytest.approx(case.objective(minimum), rel=2e-5)


@pytest.mark.parametrize(
    "make", [ISTA, FISTA, JaxoptISTA, JaxoptFISTA, solvers.ADMM, solvers.JaxoptADMM, solvers.CondatVu,
             solvers.ChambollePock, solvers.LBFGS, solvers.NonlinearCG]
)  # fmt: skip
def test_without_samples_the_prior_makes_a_picture_of_the_first_one(make, case):
    """L is 0 then. A step that were 1/L would overflow in λ·step, however small λ is."""
    nothing = jax.tree.map(jnp.zeros_like, case.problem.data)
    first = jnp.asarray(np.random.default_rng(0).random(case.start.shape), jnp.float32)
    outcome = run(make(iterations=40), Problem(nothing, HuberTotalVariation(), jnp.float32(1e-3)), first)
    assert outcome.status.usable and np.isfinite(outcome.image).all()
    assert outcome.stages[-1].objective < outcome.stages[0].objective or outcome.status is Status.converged


@pytest.mark.parametrize("name", ["ISTA", "jaxopt ISTA"])
def test_the_objective_of_ista_never_rises(name, case, solved):
    """But for the rounding of two float32 sums: a few 1e-7 of Σ ω Y² each, as f is a difference of numbers so large."""
    objectives = np.array([stage.objective for stage in solved[name].stages])
    rounding = 2 * ROUNDING * float(case.problem.data.energy)
    assert np.diff(objectives).max() <= rounding
    assert np.all(np.diff(objectives[:10]) < 0)


def one_step_further(problem: Problem, image: np.ndarray) -> np.ndarray:
    """prox(X − β∇f(X)) with the proximal step solved to the end."""

    @eqx.filter_jit
    def further(problem: Problem, image: jax.Array) -> jax.Array:
        step = 1 / lipschitz_bound(problem.data)
        prior = TotalVariation(iterations=1000)
        ahead = image - step * problem.data.gradient(image)
        return prior.prox(ahead, step * problem.strength, prior.initial_state(image))[0]

    return np.asarray(further(problem, jnp.asarray(image)))


def change(after: np.ndarray, before: np.ndarray) -> float:
    return float(np.linalg.norm(after - before) / np.linalg.norm(before))


@pytest.mark.parametrize("name", SOLVERS)
def test_the_solution_is_a_fixed_point(name, case, solved):
    image = solved[name].image
    assert change(one_step_further(case.problem, image), image) < (5e-5 if "jaxopt" not in name else 5e-4)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_tolerance_met_means_what_it_says(name, case):
    outcome = run(SOLVERS[name](tolerance=1e-3), case.problem, case.start)
    assert outcome.status is Status.converged and outcome.status.usable
    residuals = [stage.residual for stage in outcome.stages]
    assert len(residuals) < 100 and residuals[-1] <= 1e-3 < min(residuals[:-1])
    # A step from X changes no more than the step that led to X, up to what their proximal steps are inexact by.
    assert change(one_step_further(case.problem, outcome.image), outcome.image) <= 1.3e-3


@pytest.mark.parametrize("name", SOLVERS)
def test_records_are_those_of_the_pictures(name, case):
    outcome = run(SOLVERS[name](iterations=6, tolerance=0), case.problem, case.start, keep_images=True)
    plain = run(SOLVERS[name](iterations=6, tolerance=0), case.problem, case.start)
    assert [stage.number for stage in outcome.stages] == [1, 2, 3, 4, 5, 6]
    start = np.asarray(case.start)
    for stage, without in zip(outcome.stages, plain.stages, strict=True):
        assert stage.image is not None and stage.gradient_step is not None and without.image is None
        assert stage.objective == stage.data + stage.prior
        assert stage.prior == pytest.approx(case.penalty(stage.image), rel=1e-5)
        assert stage.objective == pytest.approx(case.objective(stage.image), rel=4e-5)
        assert stage.objective == pytest.approx(without.objective, rel=1e-6)
        assert stage.step_size == pytest.approx(1 / float(lipschitz_bound(case.problem.data)), rel=1e-6)
        assert 0 < stage.seconds
    first = outcome.stages[0]
    assert first.image is not None and first.gradient_step is not None
    step = start - first.step_size * np.asarray(case.problem.data.gradient(case.start))
    np.testing.assert_allclose(first.gradient_step, step, atol=1e-6)
    assert first.residual == pytest.approx(
        float(np.linalg.norm(first.image - start) / np.linalg.norm(first.image)), 1e-4
    )
    np.testing.assert_array_equal(outcome.stages[-1].image, outcome.image)


@pytest.mark.parametrize("name", SOLVERS)
def test_going_on_from_a_state_is_the_same_trajectory_bit_for_bit(name, case, solved):
    first = run(SOLVERS[name](iterations=10, tolerance=0), case.problem, case.start)
    assert first.status is Status.iterations_exhausted and first.status.usable
    second = run(SOLVERS[name](iterations=10, tolerance=0), case.problem, case.start, state=first.state)
    both = [stage.objective for stage in first.stages + second.stages]
    assert both == [stage.objective for stage in solved[name].stages[:20]]
    whole = run(SOLVERS[name](iterations=20, tolerance=0), case.problem, case.start)
    np.testing.assert_array_equal(second.image, whole.image)


@pytest.mark.parametrize("name", SOLVERS)
def test_what_is_kept_of_a_state_is_all_that_a_similar_solve_begins_with(name, case, solved):
    solver, state = SOLVERS[name](iterations=5, tolerance=0), solved[name].state
    whole, kept = (run(solver, case.problem, case.start, similar=of) for of in (state, solver.kept(state)))
    np.testing.assert_array_equal(kept.image, whole.image)
    assert [stage.objective for stage in kept.stages] == [stage.objective for stage in whole.stages]


@pytest.mark.parametrize("name", SOLVERS)
def test_a_value_that_is_not_finite_ends_the_run(name, case):
    term = eqx.tree_at(lambda t: t.target, case.problem.data, case.problem.data.target.at[3, 4].set(jnp.nan))
    outcome = run(SOLVERS[name](), eqx.tree_at(lambda p: p.data, case.problem, term), case.start)
    assert outcome.status is Status.non_finite and not outcome.status.usable
    assert len(outcome.stages) == 1 and not math.isfinite(outcome.stages[0].objective)
    np.testing.assert_array_equal(outcome.image, case.start)


def test_the_last_finite_picture_is_returned_when_numbers_overflow_later(case):
    """A step size far too long: the picture grows without bound, until it is not finite."""
    solver = ISTA(iterations=100, tolerance=0)
    state = solver.init(case.problem, case.start)
    outcome = run(solver, case.problem, case.start, state=state._replace(step_size=jnp.float32(1e3)))
    assert outcome.status is Status.non_finite and 1 < len(outcome.stages) < 100
    assert np.isfinite(outcome.image).all()
    assert all(math.isfinite(stage.objective) for stage in outcome.stages[:-1])


@pytest.mark.parametrize("name", SOLVERS)
def test_without_a_prior_it_is_least_squares(name, case):
    problem = eqx.tree_at(lambda p: p.strength, case.problem, jnp.float32(0))
    outcome = run(SOLVERS[name](iterations=40, tolerance=0), problem, case.start)
    last = outcome.stages[-1]
    assert last.prior == 0 and last.objective == last.data
    off = case.matrix @ np.asarray(outcome.image, float).ravel() - case.value
    rounding = ROUNDING * float(problem.data.energy)
    assert last.data == pytest.approx(0.5 * case.weight @ off**2, rel=1e-4, abs=rounding)
    slope = case.matrix.T @ (case.weight * off)
    at_start = case.matrix.T @ (case.weight * (case.matrix @ np.asarray(case.start, float).ravel() - case.value))
    assert np.linalg.norm(slope) < 0.02 * np.linalg.norm(at_start)


class Watcher:
    def __init__(self):
        self.calls: list[Any] = []

    def start(self, total: int | None, what: str) -> None:
        self.calls.append((what, total))

    def advance(self, done: int) -> None:
        self.calls.append(done)

    def finish(self) -> None:
        self.calls.append("finish")


def test_progress_is_told_by_chunks(case):
    watcher = Watcher()
    run(FISTA(iterations=50, tolerance=0), case.problem, case.start, progress=watcher)
    assert watcher.calls == [("solving, at most 50 iterations", None), 20, 20, 10, "finish"]


def test_progress_is_finished_when_the_work_fails(case):
    class Stopped(Watcher):
        def advance(self, done: int) -> None:
            raise KeyboardInterrupt

    watcher = Stopped()
    with pytest.raises(KeyboardInterrupt):
        run(FISTA(tolerance=0), case.problem, case.start, progress=watcher)
    assert watcher.calls == [(f"solving, at most {FISTA().iterations} iterations", None), "finish"]


@pytest.mark.parametrize("name", SOLVERS)
def test_a_second_problem_of_the_same_shape_compiles_nothing(name, case, solved, monkeypatch):
    traced, kind = [], type(SOLVERS[name]())
    original = kind.step

    def counted(self, problem, state):
        traced.append(name)
        return original(self, problem, state)

    monkeypatch.setattr(kind, "step", counted)
    other = eqx.tree_at(
        lambda p: (p.strength, p.data.target), case.problem, (jnp.float32(0.01), case.problem.data.target * 2)
    )
    run(SOLVERS[name](iterations=30, tolerance=1e-2), other, case.start + 0.1)
    assert traced == []  # the runs of `solved` did


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"iterations": 0}, "0 iterations"), ({"tolerance": -1}, "tolerance -1"), ({"tolerance": math.nan}, "nan")],
)
def test_limits_that_make_no_sense(name, wrong, message):
    with pytest.raises(InputError, match=message):
        SOLVERS[name](**wrong)


@pytest.mark.parametrize("name", ["jaxopt ISTA", "jaxopt FISTA"])
def test_inner_iterations_that_make_no_sense(name):
    with pytest.raises(InputError, match="0 inner_iterations"):
        SOLVERS[name](inner_iterations=0)


def test_more_inner_iterations_where_a_prior_has_few():
    prior = TotalVariation(isotropic=False, iterations=3)
    more = prior.with_inner_iterations(70)
    assert more == TotalVariation(isotropic=False, iterations=70)
    assert prior.with_inner_iterations(2) is prior
    assert Bounded(prior, 0.1, None, rounds=3).with_inner_iterations(70) == Bounded(more, 0.1, None, rounds=3)


def test_a_state_of_another_solver_or_size_is_refused(case):
    with pytest.raises(InputError, match="a state of type JaxoptState"):
        run(FISTA(), case.problem, case.start, state=JaxoptFISTA().init(case.problem, case.start))
    state = FISTA().init(case.problem, case.start)
    with pytest.raises(InputError, match=r"shape \(3, 4\)"):
        run(FISTA(), case.problem, case.start, similar=state._replace(image=jnp.zeros((3, 4))))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_an_initial_image_that_is_not_finite_is_refused(value, case):
    """Nothing finite could be returned."""
    image = case.start.at[2, 3].set(value)
    with pytest.raises(InputError, match="FISTA was given an initial image, or a state, with 1 values"):
        run(FISTA(), case.problem, image)
    state = FISTA().init(case.problem, image)
    with pytest.raises(InputError, match="FISTA was given an initial image, or a state, with 1 values"):
        run(FISTA(), case.problem, case.start, state=state)
    with pytest.raises(InputError, match="FISTA was given an initial image, or a state, with 1 values"):
        run(FISTA(), case.problem, case.start, similar=state)


def test_the_loop_is_shared():
    assert all(isinstance(solver(), loop.Solver) for solver in SOLVERS.values())


@pytest.mark.parametrize("make", [FISTA, solvers.ADMM, solvers.JaxoptADMM, solvers.CondatVu, solvers.ChambollePock])
def test_the_picture_is_within_bounds_however_early_it_ends(make, case):
    prior = Bounded(TotalVariation(), 0.3, 0.6)
    image = run(make(iterations=3), Problem(case.problem.data, prior, case.problem.strength), case.start).image
    assert (image.min(), image.max()) == (np.float32(0.3), np.float32(0.6))
