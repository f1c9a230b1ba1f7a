"""The solver for scenes at rest, against a general method in float64 and against what it promises of its record."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from scsr_opt.errors import InputError
from scsr_opt.operators import Downsample
from scsr_opt.operators.data_term import DataTerm, Stencil
from scsr_opt.priors import HuberTotalVariation, RidgeRegulariser, TotalVariation
from scsr_opt.solvers import FISTA, DataProximal, Problem, Status, default_solver, lipschitz_bound, run

SCALE, SENSOR = 2, (12, 16)
SHAPE = (24, 32)
KNEE = 0.05
PRIORS = {"Huber-TV": HuberTotalVariation(knee=KNEE, iterations=30), "ridge": RidgeRegulariser.load("convex")}


def at_rest(prior, strength: float) -> Problem:
    """Noisy means of 2×2 pixels, some of them seen less than others, and two not at all."""
    rng = np.random.default_rng(0)
    truth = np.kron(rng.uniform(0.1, 1, (6, 8)), np.ones((4, 4)))
    means = truth.reshape(SENSOR[0], SCALE, SENSOR[1], SCALE).mean((1, 3))
    weight = rng.uniform(0.4, 1, SENSOR)
    weight[4, 5:7] = 0
    value = means + 0.03 * rng.normal(size=SENSOR)
    planes = jnp.zeros((5, *SENSOR), jnp.float32).at[0].set(jnp.asarray(weight, jnp.float32))
    term = DataTerm(
        Stencil(planes),
        jnp.asarray(weight * value, jnp.float32),
        jnp.float32(np.sum(weight * value**2)),
        Downsample(SHAPE, SCALE),
        None,
    )
    return Problem(term, prior, jnp.float32(strength))


def start() -> jax.Array:
    return jnp.full(SHAPE, 0.5)


def objective(problem: Problem, image: jax.Array) -> jax.Array:
    return problem.data.value(image) + problem.strength * problem.prior.value(image)


def least(problem: Problem) -> float:
    """min F of Huber-TV, written out in float64 with NumPy and left to SciPy."""
    weight, c = (np.asarray(v, float) for v in (problem.data.stencil.planes[0], problem.data.target))

    def written_out(x: np.ndarray) -> tuple[float, np.ndarray]:
        x = x.reshape(SHAPE)
        u = x.reshape(SENSOR[0], SCALE, SENSOR[1], SCALE).mean((1, 3))
        down, right = np.diff(x, axis=0, append=x[-1:]), np.diff(x, axis=1, append=x[:, -1:])
        length = np.hypot(down, right)
        huber = np.where(length > KNEE, length - KNEE / 2, length**2 / (2 * KNEE))
        value = 0.5 * np.sum(weight * u**2) - np.sum(c * u) + 0.5 * float(problem.data.energy)
        slope = np.kron(weight * u - c, np.ones((SCALE, SCALE))) / SCALE**2
        p, q = down / np.maximum(length, KNEE), right / np.maximum(length, KNEE)
        away = -p - q
        away[1:] += p[:-1]
        away[:, 1:] += q[:, :-1]
        λ = float(problem.strength)
        return value + λ * np.sum(huber), (slope + λ * away).ravel()

    found = scipy.optimize.minimize(
        written_out, np.full(SHAPE, 0.5).ravel(), jac=True, method="L-BFGS-B", tol=1e-14,
        options={"maxiter": 20_000, "maxfun": 40_000, "gtol": 1e-10},
    )  # fmt: skip
    return float(found.fun)


@pytest.mark.parametrize("strength", [1e-4, 1e-3, 1e-2])
def test_it_finds_the_minimum(strength):
    """To 2e-6: rounding of float32 in f, of ε·Σ ω Y² = 6e-6, over an F of 0.2 to 2 makes as much or more."""
    problem = at_rest(PRIORS["Huber-TV"], strength)
    outcome = run(DataProximal(iterations=3000, tolerance=1e-7), problem, start())
    found, known = float(objective(problem, jnp.asarray(outcome.image))), least(problem)
    slack = 4 * float(np.finfo(np.float32).eps) * float(problem.data.energy)
    assert abs(found - known) <= 2e-6 * known + slack
    assert outcome.stages[-1].objective == pytest.approx(found, abs=slack)


def test_it_ends_where_others_do():
    """With the learned prior, whose minimum is known to no other library."""
    problem = at_rest(PRIORS["ridge"], 1e-3)
    ours = run(DataProximal(iterations=1000, tolerance=1e-7), problem, start())
    theirs = run(FISTA(iterations=1000, tolerance=1e-7), problem, start())
    np.testing.assert_allclose(ours.image, theirs.image, atol=2e-4)


def test_the_data_without_a_prior_take_a_few_steps():
    problem = at_rest(PRIORS["Huber-TV"], 0.0)
    outcome = run(DataProximal(tolerance=1e-6), problem, start())
    assert outcome.status is Status.converged and len(outcome.stages) <= 20
    seen = np.asarray(problem.data.stencil.planes[0]) > 0
    wanted = np.asarray(problem.data.target)[seen] / np.asarray(problem.data.stencil.planes[0])[seen]
    np.testing.assert_allclose(np.asarray(problem.data.blurred(jnp.asarray(outcome.image)))[seen], wanted, atol=1e-4)


@pytest.mark.parametrize("strength", [0.3, 40.0])
def test_the_proximal_step_of_the_data_is_its_minimiser(strength):
    """X + τ∇f(X) = R, and f comes with it."""
    data, image = at_rest(PRIORS["Huber-TV"], 1e-3).data, jax.random.uniform(jax.random.key(0), SHAPE)
    found, value = data.prox(image, jnp.float32(strength))
    np.testing.assert_allclose(found + strength * data.gradient(found), image, atol=1e-6 * (1 + strength))
    assert float(value) == pytest.approx(float(data.value(found)), rel=1e-5)


@pytest.mark.parametrize("name", PRIORS)
def test_the_gradient_of_a_prior_and_its_lipschitz_constant(name):
    """∇Ψ is the derivative of Ψ; between two pictures it changes by no more than the constant allows."""
    prior = PRIORS[name]
    one, other = jax.random.uniform(jax.random.key(1), (2, *SHAPE))
    other = one + 0.02 * other
    np.testing.assert_allclose(prior.gradient(one), jax.grad(prior.value)(one), atol=2e-6)
    change = float(jnp.linalg.norm(prior.gradient(one) - prior.gradient(other)))
    assert 0.02 * prior.lipschitz < change / float(jnp.linalg.norm(one - other)) <= prior.lipschitz


@pytest.mark.parametrize("name", PRIORS)
def test_the_residual_bounds_that_of_fista(name):
    """‖X − G(X)‖/‖X‖ ≤ β‖∇F(X)‖/‖X‖ ≤ the residual, at every picture on the way."""
    problem = at_rest(PRIORS[name], 1e-3)
    outcome = run(DataProximal(iterations=15, tolerance=0), problem, start(), keep_images=True)
    slope = jax.jit(jax.grad(lambda image: objective(problem, image)))
    β = 1 / lipschitz_bound(problem.data)
    for stage in outcome.stages:
        image = jnp.asarray(stage.image)
        size = float(β * jnp.linalg.norm(slope(image)) / jnp.linalg.norm(image))
        assert size <= stage.residual * (1 + 1e-3)
    first, last = outcome.stages[0], outcome.stages[-1]
    assert last.residual < 0.1 * first.residual


def test_steps_below_rounding_are_not_taken_for_the_end():
    """With λ = 10⁶ a step from a flat picture is 10⁻⁹ long, and FISTA is the one to take."""
    outcome = run(DataProximal(iterations=5), at_rest(PRIORS["Huber-TV"], 1e6), start())
    assert outcome.status is Status.iterations_exhausted


def test_what_it_cannot_solve_is_refused(case):
    with pytest.raises(InputError, match="TotalVariation that is not smooth and convex"):
        run(DataProximal(), at_rest(TotalVariation(), 1e-3), start())
    with pytest.raises(InputError, match="RidgeRegulariser that is not smooth and convex"):
        run(DataProximal(), at_rest(RidgeRegulariser.load("weakly_convex"), 1e-3), start())
    moving = eqx.tree_at(lambda p: p.prior, case.problem, PRIORS["Huber-TV"])
    with pytest.raises(InputError, match="it is for scenes at rest: take FISTA"):
        run(DataProximal(), moving, case.start)


def test_it_is_taken_where_it_is_the_faster_one():
    prior = HuberTotalVariation()  # λ·400·16 ≤ 5
    chosen = [default_solver(prior, strength=λ, scale=4, block_diagonal=True) for λ in (7e-4, 9e-4)]
    assert [type(solver) for solver in chosen] == [DataProximal, FISTA]
    assert isinstance(default_solver(prior, strength=7e-4, scale=4, block_diagonal=False), FISTA)
    assert isinstance(default_solver(TotalVariation(), strength=7e-4, scale=4, block_diagonal=True), FISTA)


def test_fista_goes_on_from_its_state_and_it_from_that_of_fista():
    problem = at_rest(PRIORS["Huber-TV"], 1e-3)
    for one, other in ((DataProximal, FISTA), (FISTA, DataProximal)):
        first = run(one(iterations=100, tolerance=1e-6), problem, start())
        second = run(other(tolerance=1e-4), problem, start(), similar=first.state)
        assert len(second.stages) <= 2 and second.status is Status.converged


def test_going_on_is_as_if_it_had_not_stopped_and_compiles_nothing(monkeypatch):
    problem = at_rest(PRIORS["Huber-TV"], 1e-3)
    whole = run(DataProximal(iterations=20, tolerance=0), problem, start())
    run(DataProximal(iterations=1, tolerance=0), problem, start(), state=whole.state)
    traced = []
    original = DataProximal.step
    monkeypatch.setattr(DataProximal, "step", lambda *a: traced.append(a) or original(*a))
    first = run(DataProximal(iterations=10, tolerance=0), problem, start())
    second = run(DataProximal(iterations=10, tolerance=0), problem, start(), state=first.state)
    np.testing.assert_array_equal(second.image, whole.image)
    assert traced == []
