"""The duality gap is a bound, and what the tolerance is held against is what was asked for."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.errors import InputError
from scsr_opt.priors import Bounded, HuberTotalVariation, PlugAndPlay, TotalVariation
from scsr_opt.solvers import ADMM, FISTA, CondatVu, DualityGap, JaxoptFISTA, Problem, Status, run

SOLVERS = {"FISTA": FISTA, "ADMM": ADMM, "Condat–Vũ": CondatVu}


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def in_double(problem: Problem) -> Problem:
    return jax.tree.map(lambda v: jnp.asarray(v, jnp.float64) if eqx.is_inexact_array(v) else v, problem)


@pytest.mark.parametrize("solver", [FISTA(), JaxoptFISTA()])
def test_a_picture_may_become_black(solver, case):
    """A change over nothing is a number, and no reason to call the picture one that is not finite."""
    dark = eqx.tree_at(lambda d: d.target, case.problem.data, -jnp.ones_like(case.problem.data.target))
    problem = Problem(dark, Bounded(TotalVariation(), 0, 1), case.problem.strength)
    outcome = run(solver, problem, jnp.full_like(case.start, 0.01))
    assert outcome.status.usable
    np.testing.assert_array_equal(outcome.image, 0)
    assert all(math.isfinite(stage.residual) for stage in outcome.stages)


@pytest.mark.parametrize("name", SOLVERS)
def test_the_gap_is_an_upper_bound_that_vanishes(name, case, minimum, double):
    """In float64, where rounding does not hide it. The reference is 5e-9 above the minimum at most."""
    problem, start = in_double(case.problem), jnp.asarray(case.start, jnp.float64)
    assert 0 <= minimum.min() and minimum.max() <= 1.2  # so that the bound is certain
    solver = SOLVERS[name](iterations=300, tolerance=0, stopping=DualityGap(upper=1.2))
    outcome = run(solver, problem, start)
    least = float(problem.data.value(jnp.asarray(minimum))) + case.penalty(minimum)
    above = np.array([stage.objective for stage in outcome.stages]) / least - 1
    gaps = np.array([stage.gap for stage in outcome.stages])
    # Relative to its own objective, which is less than the least one divides by.
    assert np.all(gaps * (1 + above) >= above - 1e-8)
    assert gaps[-1] < 1e-2 * gaps[9] and gaps[-1] < 2e-3


def test_a_gap_met_ends_the_run(case):
    outcome = run(FISTA(tolerance=2e-2, stopping=DualityGap(upper=1.2)), case.problem, case.start)
    assert outcome.status is Status.converged
    gaps = [stage.gap for stage in outcome.stages]
    assert gaps[-1] <= 2e-2 < min(gaps[:-1])


def test_without_being_asked_for_there_is_no_gap(case):
    outcome = run(FISTA(iterations=2), case.problem, case.start)
    assert all(math.isnan(stage.gap) for stage in outcome.stages)


def test_a_conjugate_that_is_not_a_norm_s(case, double):
    """Huber's function, whose conjugate is not zero: the gap vanishes only if that is in it."""
    problem = eqx.tree_at(lambda p: p.prior, in_double(case.problem), HuberTotalVariation(knee=0.05))
    outcome = run(
        FISTA(iterations=300, tolerance=0, stopping=DualityGap(upper=1.2)),
        problem,
        jnp.asarray(case.start, jnp.float64),
    )
    objectives = np.array([stage.objective for stage in outcome.stages])
    gaps = np.array([stage.gap for stage in outcome.stages])
    assert np.all(gaps >= 1 - objectives[-1] / objectives - 1e-12) and gaps[-1] < 1e-4


def test_a_prior_without_a_conjugate_has_no_gap(case):
    problem = eqx.tree_at(lambda p: p.prior, case.problem, PlugAndPlay(lambda image, σ: image))
    for make in SOLVERS.values():
        with pytest.raises(InputError, match="PlugAndPlay, whose conjugate is not known"):
            run(make(stopping=DualityGap()), problem, case.start)


@pytest.mark.parametrize(("lower", "upper"), [(1, 1), (0, math.inf), (math.nan, 1)])
def test_bounds_that_make_no_sense(lower, upper):
    with pytest.raises(InputError, match="lower="):
        DualityGap(lower=lower, upper=upper)
