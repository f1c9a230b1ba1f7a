"""ADMM and the primal–dual methods against the same independent solution as the proximal-gradient methods."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.errors import InputError
from scsr_opt.priors import Prior, TotalVariation
from scsr_opt.solvers import (
    ADMM,
    ChambollePock,
    CondatVu,
    ConjugateGradients,
    JaxoptADMM,
    JaxoptConjugateGradients,
    Outcome,
    Problem,
    Status,
    lipschitz_bound,
    run,
)

SOLVERS = {"ADMM": ADMM, "jaxopt ADMM": JaxoptADMM, "Condat–Vũ": CondatVu, "Chambolle–Pock": ChambollePock}
# Enough for what is asked below; Condat and Vũ's iterations are the cheapest and the most.
ITERATIONS = {"ADMM": 150, "jaxopt ADMM": 150, "Condat–Vũ": 400, "Chambolle–Pock": 300}


class ByProx(Prior[Any]):
    """Total variation that shows nothing but its proximal step."""

    inner: TotalVariation = TotalVariation(iterations=100)

    def value(self, image):
        return self.inner.value(image)

    def initial_state(self, image):
        return self.inner.initial_state(image)

    def prox(self, image, strength, state):
        return self.inner.prox(image, strength, state)


@pytest.fixture(scope="module")
def solved(case) -> dict[str, Outcome]:
    return {
        name: run(make(iterations=ITERATIONS[name], tolerance=0), case.problem, case.start)
        for name, make in SOLVERS.items()
    }


@pytest.mark.parametrize("name", SOLVERS)
def test_they_find_the_minimum(name, case, minimum, solved):
    """To 1e-4 of it: rounding alone is 2e-5 (as for ISTA and FISTA)."""
    least = case.objective(minimum)
    assert -1e-7 <= case.objective(solved[name].image) / least - 1 <= 1e-4
    last = solved[name].stages[-1]
    assert last.objective == pytest.approx(case.objective(solved[name].image), rel=4e-5)
    assert last.prior == pytest.approx(case.penalty(solved[name].image), rel=1e-5)


@eqx.filter_jit
def further(problem: Problem, image: jax.Array) -> jax.Array:
    """prox(X − β∇f(X)) with the proximal step solved to the end."""
    step = 1 / lipschitz_bound(problem.data)
    prior = TotalVariation(iterations=1000)
    return prior.prox(image - step * problem.data.gradient(image), step * problem.strength, prior.initial_state(image))[
        0
    ]


def check_residuals(case, outcome: Outcome, exact: float) -> None:
    """They are upper bounds of what one exact proximal-gradient step changes."""
    for number in (3, 10, 25):
        stage = outcome.stages[number - 1]
        assert stage.image is not None
        changed = np.linalg.norm(further(case.problem, jnp.asarray(stage.image)) - stage.image)
        assert changed / np.linalg.norm(stage.image) <= stage.residual + exact
    assert outcome.stages[24].residual < outcome.stages[2].residual


@pytest.mark.parametrize("name", SOLVERS)
def test_the_residual_is_an_upper_bound(name, case):
    outcome = run(SOLVERS[name](iterations=25, tolerance=0), case.problem, case.start, keep_images=True)
    # 1000 dual steps leave 2e-5 in the step that is compared with.
    check_residuals(case, outcome, 2e-5)


@pytest.mark.parametrize("name", ["ADMM", "Condat–Vũ", "Chambolle–Pock"])
def test_a_prior_that_has_a_proximal_step_only(name, case, minimum):
    """K is the identity then: the same minimum, and the residual is a bound as far as the proximal step is exact."""
    problem = eqx.tree_at(lambda p: p.prior, case.problem, ByProx())
    outcome = run(SOLVERS[name](iterations=80, tolerance=0), problem, case.start, keep_images=True)
    assert case.objective(outcome.image) / case.objective(minimum) - 1 <= 1e-3
    check_residuals(case, outcome, 1e-4)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_tolerance_met_ends_the_run(name, case):
    outcome = run(SOLVERS[name](tolerance=4e-3), case.problem, case.start)
    assert outcome.status is Status.converged
    residuals = [stage.residual for stage in outcome.stages]
    assert residuals[-1] <= 4e-3 < min(residuals[:-1])


@pytest.mark.parametrize("name", SOLVERS)
def test_going_on_and_beginning_again(name, case, solved):
    """From a state: the same trajectory. From that of a similar problem: much nearer than from the start."""
    first = run(SOLVERS[name](iterations=10, tolerance=0), case.problem, case.start)
    second = run(SOLVERS[name](iterations=10, tolerance=0), case.problem, case.start, state=first.state)
    both = [stage.objective for stage in first.stages + second.stages]
    assert both == [stage.objective for stage in solved[name].stages[:20]]
    other = eqx.tree_at(lambda p: p.strength, case.problem, case.problem.strength * 1.2)
    cold = run(SOLVERS[name](iterations=3, tolerance=0), other, case.start)
    warm = run(SOLVERS[name](iterations=3, tolerance=0), other, case.start, similar=solved[name].state)
    assert warm.stages[-1].residual < 0.5 * cold.stages[-1].residual


@pytest.mark.parametrize("name", SOLVERS)
def test_another_problem_of_the_same_shape_compiles_nothing(name, case, solved, monkeypatch):
    traced = []
    original = SOLVERS[name].step

    def counted(self, problem, state):
        traced.append(name)
        return original(self, problem, state)

    monkeypatch.setattr(SOLVERS[name], "step", counted)
    other = eqx.tree_at(lambda p: p.strength, case.problem, jnp.float32(0.01))
    run(SOLVERS[name](iterations=30, tolerance=1e-2), other, case.start + 0.1)
    assert traced == []


@pytest.mark.parametrize("name", SOLVERS)
def test_without_a_prior_it_is_least_squares(name, case):
    problem = eqx.tree_at(lambda p: p.strength, case.problem, jnp.float32(0))
    outcome = run(SOLVERS[name](iterations=80, tolerance=0), problem, case.start)
    assert outcome.stages[-1].prior == 0
    slope = [float(jnp.linalg.norm(case.problem.data.gradient(jnp.asarray(v)))) for v in (case.start, outcome.image)]
    assert slope[1] < 0.02 * slope[0]


@pytest.mark.parametrize("name", SOLVERS)
def test_a_value_that_is_not_finite_ends_the_run(name, case):
    broken = eqx.tree_at(lambda p: p.data.target, case.problem, case.problem.data.target.at[3, 4].set(jnp.nan))
    outcome = run(SOLVERS[name](), broken, case.start)
    assert outcome.status is Status.non_finite and len(outcome.stages) == 1
    np.testing.assert_array_equal(outcome.image, case.start)


def test_conjugate_gradients_solve_a_system():
    """Exactly, after as many steps as the matrix has different eigenvalues; and 0 for 0."""
    diagonal = jnp.asarray([[1.0, 2.0, 5.0], [2.0, 1.0, 5.0]])
    wanted = jnp.arange(1.0, 7.0).reshape(2, 3)
    for method in (ConjugateGradients(steps=3), JaxoptConjugateGradients(steps=3, tolerance=0)):
        found = method(lambda x: diagonal * x, wanted)
        np.testing.assert_allclose(found, wanted / diagonal, rtol=1e-5)
        np.testing.assert_array_equal(method(lambda x: diagonal * x, 0 * wanted), 0 * wanted)
    one = ConjugateGradients(steps=1)(lambda x: diagonal * x, wanted)
    along = jnp.sum(wanted**2) / jnp.sum(diagonal * wanted**2)
    np.testing.assert_allclose(one, along * wanted, rtol=1e-6)


def test_jaxopt_s_conjugate_gradients_of_next_to_nothing():
    """Whose squares float32 cannot hold: a black recording, late in a run."""
    diagonal = jnp.asarray([[1.0, 2.0, 5.0]])
    wanted = jnp.asarray([[1.0, 2.0, 3.0]])
    found = JaxoptConjugateGradients(steps=3, tolerance=0)(lambda x: diagonal * x, 1e-25 * wanted)
    np.testing.assert_allclose(1e25 * found, wanted / diagonal, rtol=1e-5)


def test_the_penalty_is_balanced_at_first_only(case):
    """Begun a thousand times too large, ρ comes down; after 40 iterations it stays."""
    solver = ADMM(iterations=70, tolerance=0)
    state = solver.init(case.problem, case.start)
    outcome = run(solver, case.problem, case.start, state=state._replace(penalty=1000 * state.penalty))
    penalties = np.array([1 / stage.step_size for stage in outcome.stages])
    assert penalties[45] < 0.1 * penalties[0]
    assert np.all(penalties[41:] == penalties[41])


@pytest.mark.parametrize("make", [ADMM, JaxoptADMM, ChambollePock])
@pytest.mark.parametrize("relaxation", [0, 2, float("nan")])
def test_relaxations_that_make_no_sense(make, relaxation):
    with pytest.raises(InputError, match=f"relaxation={relaxation}"):
        make(relaxation=relaxation)


@pytest.mark.parametrize("make", [ConjugateGradients, JaxoptConjugateGradients])
def test_no_steps_make_no_sense(make):
    with pytest.raises(InputError, match="0 steps"):
        make(steps=0)


def test_jaxopt_s_admm_differs_in_its_linear_solve_only():
    native = dataclasses.replace(JaxoptADMM(), linear_solve=ConjugateGradients())
    assert [getattr(native, f.name) for f in dataclasses.fields(ADMM)] == [
        getattr(ADMM(), f.name) for f in dataclasses.fields(ADMM)
    ]
