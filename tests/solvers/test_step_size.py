"""Step sizes: what they promise, and what solvers make of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.errors import InputError
from scsr_opt.priors import Bounded, TotalVariation, WaveletL1
from scsr_opt.solvers import (
    FISTA,
    ISTA,
    Backtracking,
    Balance,
    CondatVu,
    Fixed,
    NormBound,
    Separable,
    SpectralNorm,
    lipschitz_bound,
    run,
    with_bound,
)
from scsr_opt.solvers import problem as posed


@pytest.fixture(scope="module")
def steepest(case) -> float:
    """L, from the dense matrix."""
    return float(np.linalg.eigvalsh((case.matrix.T * case.weight) @ case.matrix)[-1])


def test_bounds_are_at_least_the_norm(case, steepest):
    bound = float(NormBound().first(case.problem))
    # Two applications of Collatz' bound: within 10 % where weights vary as they do here.
    assert 0.9 <= bound * steepest <= 1 + 1e-5
    probable = float(SpectralNorm(iterations=200).first(case.problem))
    # The margin over the estimate: exp(ln(824 √768) / 399) = 1.025.
    assert 0.96 <= probable * steepest <= 1 + 1e-5
    loose = float(SpectralNorm(iterations=10).first(case.problem))
    assert loose < probable
    assert float(Fixed(0.25).first(case.problem)) == 0.25


def test_steps_of_each_pixel_are_as_long_as_a_majorant_allows(case):
    """diag(1/β) − BᵀMB has no negative eigenvalue, though some β are above 1/L."""
    β = np.asarray(Separable().first(case.problem), np.float64)
    normal = (case.matrix.T * case.weight) @ case.matrix
    left = np.linalg.eigvalsh(np.diag(1 / β.ravel()) - normal)
    assert left[0] >= -1e-6 * left[-1]  # the rounding of β in float32
    assert β.max() > 1.5 * float(NormBound().first(case.problem))
    assert β.max() <= 10 * β.min() * (1 + 1e-6)
    narrow = Separable(widest=1).first(case.problem)
    assert float(jnp.max(narrow)) == pytest.approx(β.min(), rel=1e-6) == float(jnp.min(narrow))


def test_all_pixels_have_one_step_where_the_prior_or_the_grid_knows_one(case):
    other = eqx.tree_at(lambda p: p.prior, case.problem, WaveletL1(), is_leaf=lambda leaf: leaf is case.problem.prior)
    assert Separable().first(other).shape == () and Separable().needs_bound(other)
    assert not Separable().needs_bound(case.problem)
    bounded = eqx.tree_at(
        lambda p: p.prior, case.problem, Bounded(TotalVariation()), is_leaf=lambda leaf: leaf is case.problem.prior
    )
    assert Separable().first(bounded).shape == case.start.shape


@pytest.mark.parametrize("make", [ISTA, FISTA])
def test_steps_of_each_pixel_lead_to_the_same_picture(make, case, minimum):
    outcome = run(make(iterations=200, tolerance=0, step_size=Separable()), case.problem, case.start)
    assert -1e-7 <= case.objective(outcome.image) / case.objective(minimum) - 1 <= 2e-5
    if make is ISTA:
        objectives = np.array([stage.objective for stage in outcome.stages])
        assert np.diff(objectives).max() <= 8e-7 * float(case.problem.data.energy)  # rounding, as of one step size
    β = Separable().first(case.problem)
    assert {stage.step_size for stage in outcome.stages} == {float(jnp.min(β))}


def test_where_less_was_seen_steps_of_each_pixel_need_fewer_iterations(case):
    """A twentieth of the data below the first third of the picture."""
    data = case.problem.data
    share = jnp.where(jnp.arange(data.target.shape[0]) < 8, 1.0, 0.05)[:, None].astype(jnp.float32)
    thin = eqx.tree_at(
        lambda d: (d.stencil.planes, d.target), data, (data.stencil.planes * share[None], data.target * share)
    )
    problem = eqx.tree_at(lambda p: p.data, case.problem, thin, is_leaf=lambda leaf: leaf is data)
    found = run(FISTA(step_size=NormBound(), iterations=1000, tolerance=0), problem, case.start).image

    def needed(solver: FISTA) -> int:
        pictures = [stage.image for stage in run(solver, problem, case.start, keep_images=True).stages]
        off = [float(np.linalg.norm(picture - found)) for picture in pictures if picture is not None]
        return int(np.argmax(np.array(off) <= 3e-3 * np.linalg.norm(found))) + 1

    one = needed(FISTA(step_size=NormBound(), iterations=100, tolerance=0))
    each = needed(FISTA(iterations=100, tolerance=0))
    print(f"{one} iterations with one step size, {each} with one for each pixel")
    assert 1 < each < one < 100


def test_what_is_kept_of_a_state_does_without_its_steps(case):
    """They are found anew for the problem that the state goes on with."""
    state = run(FISTA(iterations=5, tolerance=0), case.problem, case.start).state
    kept = FISTA().kept(state)
    assert state.step_size.shape == case.start.shape and kept.step_size is kept.image
    whole, less = (run(FISTA(iterations=5, tolerance=0), case.problem, case.start, similar=of) for of in (state, kept))
    np.testing.assert_array_equal(whole.image, less.image)


def test_steps_of_each_pixel_have_limits():
    with pytest.raises(InputError, match="widest=0.5; it is a finite factor of at least 1"):
        Separable(widest=0.5)


def test_a_bound_that_is_known_is_not_found_again(case, monkeypatch):
    """And stays that of another target, as `with_exposure` makes it."""
    known = with_bound(case.problem.data)
    assert known.bound is not None
    assert float(known.bound) == pytest.approx(float(lipschitz_bound(case.problem.data)), rel=1e-6)
    monkeypatch.setattr(posed, "norm_bound", lambda *_, **__: pytest.fail("calculated again"))
    other = eqx.tree_at(lambda data: data.target, known, 2 * known.target)
    problem = eqx.tree_at(lambda p: p.data, case.problem, other, is_leaf=lambda leaf: leaf is case.problem.data)
    assert float(NormBound().first(problem)) == pytest.approx(1 / float(known.bound), rel=1e-6)


@pytest.mark.parametrize("make", [ISTA, FISTA])
def test_backtracking_makes_steps_that_decrease_enough(make, case, minimum):
    """f(X) ≤ f(A) + ⟨∇f(A), d⟩ + ‖d‖²/2β in every iteration; begun with a β that is far too long."""
    solver = make(step_size=Backtracking())
    state = solver.init(case.problem, case.start)
    state = state._replace(step_size=50 * state.step_size)
    data = case.problem.data
    step = jax.jit(lambda state: solver.step(case.problem, state)[0])
    for _ in range(40):
        ahead, state = state.ahead, step(state)
        moved, β = state.image - ahead, state.step_size
        curvature = float(jnp.sum(moved * data.normal(moved)) / jnp.sum(moved**2))
        assert curvature * float(β) <= 1 + 1e-3
    assert case.objective(np.asarray(state.image)) / case.objective(minimum) - 1 < 1e-3


def test_backtracking_finds_longer_steps_than_the_bound(case):
    outcome = run(ISTA(iterations=40, tolerance=0, step_size=Backtracking()), case.problem, case.start)
    longest = max(stage.step_size for stage in outcome.stages)
    assert longest > 1.05 * float(NormBound().first(case.problem))


@pytest.mark.parametrize("step_size", [Separable(), NormBound(), SpectralNorm(), Backtracking()])
def test_without_samples_a_step_is_an_ordinary_number(step_size, case):
    """f is 0 then, and any step serves: but 1e38 would overflow in whatever it is multiplied with."""
    nothing = jax.tree.map(jnp.zeros_like, case.problem.data)
    problem = eqx.tree_at(lambda p: p.data, case.problem, nothing)
    assert (np.asarray(step_size.first(problem)) == 1).all()
    outcome = run(FISTA(step_size=step_size), problem, case.start + jnp.eye(*case.start.shape))
    assert outcome.status.usable and np.isfinite(outcome.image).all()


def test_a_fixed_step_is_what_the_record_says(case):
    outcome = run(FISTA(iterations=2, step_size=Fixed(0.125)), case.problem, case.start)
    assert [stage.step_size for stage in outcome.stages] == [0.125, 0.125]


@pytest.mark.parametrize("ratio", [0.2, 1, 5.0])
def test_balanced_steps_meet_the_condition_of_convergence(ratio, case):
    """1/τ − σ‖K‖² ≥ L/2 and α < 2 − (L/2)/(1/τ − σ‖K‖²) (Condat, 2013)."""
    solver = CondatVu(balance=Balance(ratio))
    lipschitz, norm_squared = 0.7, 8.0
    σ = float(Balance(ratio).dual(jnp.float32(lipschitz), norm_squared))
    left = 1 / float(solver._primal(jnp.float32(lipschitz))) - σ * norm_squared
    assert left >= lipschitz / 2
    assert solver._over < 2 - lipschitz / 2 / left
