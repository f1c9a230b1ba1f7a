"""optimistix's methods on a smooth objective, against a solver that knows nothing of gradients of the prior."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.errors import InputError
from scsr_opt.priors import HuberTotalVariation, TotalVariation
from scsr_opt.solvers import FISTA, LBFGS, NonlinearCG, Status, lipschitz_bound, run

SOLVERS = {"NonlinearCG": NonlinearCG, "L-BFGS": LBFGS}
PRIOR = HuberTotalVariation(knee=0.05)


@pytest.fixture(scope="module")
def problem(case):
    return eqx.tree_at(lambda p: p.prior, case.problem, PRIOR)


@pytest.fixture(scope="module")
def least(problem, case) -> float:
    patient = eqx.tree_at(lambda p: p.prior, problem, HuberTotalVariation(knee=0.05, iterations=30))
    return run(FISTA(iterations=300, tolerance=0), patient, case.start).stages[-1].objective


def objective(problem, image) -> jax.Array:
    return problem.data.value(image) + problem.strength * problem.prior.value(image)


@pytest.mark.parametrize("name", SOLVERS)
def test_they_find_the_minimum(name, problem, case, least):
    """To 1e-4: rounding is 2e-5, and the line search stops there."""
    outcome = run(SOLVERS[name](iterations=200, tolerance=0), problem, case.start)
    stage = outcome.stages[-1]
    assert abs(stage.objective / least - 1) < 1e-4
    image = jnp.asarray(outcome.image)
    # Here F is written out as a difference of sums of squares, which is known to a few ε of these.
    rounding = 4 * float(np.finfo(np.float32).eps) * float(problem.data.energy)
    assert stage.objective == pytest.approx(float(objective(problem, image)), abs=rounding)
    assert stage.prior == pytest.approx(float(problem.strength * PRIOR.value(image)), rel=1e-5)


@pytest.mark.parametrize("name", SOLVERS)
def test_the_record_is_that_of_the_picture(name, problem, case):
    """The first iteration looks at the start; the residual is β‖∇F‖/‖X‖ with ∇F by differentiation; F never rises."""
    outcome = run(SOLVERS[name](iterations=12, tolerance=0), problem, case.start, keep_images=True)
    first = outcome.stages[0]
    np.testing.assert_array_equal(first.image, case.start)
    slope = jax.jit(jax.grad(lambda image: objective(problem, image)))
    for stage in outcome.stages[::4]:
        image = jnp.asarray(stage.image)
        size = float(jnp.linalg.norm(slope(image)) / lipschitz_bound(problem.data) / jnp.linalg.norm(image))
        assert stage.residual == pytest.approx(size, rel=1e-3)
        # R = X + βλ∇Ψ(X): a gradient step from X, with ∇F added.
        assert stage.gradient_step is not None
        pull = jnp.asarray(stage.gradient_step) - image + stage.step_size * problem.data.gradient(image)
        np.testing.assert_allclose(pull, stage.step_size * slope(image), atol=2e-6)
    objectives = np.array([stage.objective for stage in outcome.stages])
    assert np.diff(objectives).max() <= 4e-7 * float(problem.data.energy)


@pytest.mark.parametrize("name", SOLVERS)
def test_tolerance_state_and_compilation(name, problem, case, monkeypatch):
    whole = run(SOLVERS[name](iterations=20, tolerance=0), problem, case.start)
    run(SOLVERS[name](iterations=1, tolerance=0), problem, case.start, state=whole.state)
    traced = []  # both programs are compiled: the one that begins and the one that goes on
    original = SOLVERS[name].step
    monkeypatch.setattr(SOLVERS[name], "step", lambda *a: traced.append(name) or original(*a))
    first = run(SOLVERS[name](iterations=10, tolerance=0), problem, case.start)
    second = run(SOLVERS[name](iterations=10, tolerance=0), problem, case.start, state=first.state)
    np.testing.assert_array_equal(second.image, whole.image)
    similar = eqx.tree_at(lambda p: p.strength, problem, jnp.float32(0.03))
    outcome = run(SOLVERS[name](tolerance=2e-3), similar, case.start, similar=first.state)
    assert outcome.status is Status.converged and outcome.stages[-1].residual <= 2e-3
    assert traced == []


@pytest.mark.parametrize(("name", "strength"), [("NonlinearCG", 0.02), ("L-BFGS", 0.02), ("L-BFGS", 0.2)])
def test_the_usual_tolerance_is_met_in_single_precision(name, strength, problem, case):
    problem = eqx.tree_at(lambda p: p.strength, problem, jnp.float32(strength))
    assert run(SOLVERS[name](), problem, case.start).status is Status.converged


def test_rounding_of_the_objective_does_not_end_the_search(problem, case):
    """Here f is 1.5 % of ½Σωy². Where values of F alone decide, it ends at 1e-4."""
    outcome = run(LBFGS(iterations=200, tolerance=0), problem, case.start)
    assert min(stage.residual for stage in outcome.stages) < 5e-5


@pytest.mark.parametrize("name", SOLVERS)
def test_kinks_are_refused(name, case):
    problem = eqx.tree_at(lambda p: p.prior, case.problem, TotalVariation())
    with pytest.raises(InputError, match="TotalVariation, which has kinks; it needs .* HuberTotalVariation.* FISTA"):
        run(SOLVERS[name](), problem, case.start)


@pytest.mark.parametrize("name", SOLVERS)
def test_single_precision_under_jax_in_double_is_refused(name, problem, case):
    with jax.enable_x64(True), pytest.raises(InputError, match="a problem in float32, but jax_enable_x64 is on"):
        run(SOLVERS[name](), problem, case.start)


def test_a_history_of_none_makes_no_sense():
    with pytest.raises(InputError, match="0 pairs of history"):
        LBFGS(history=0)
