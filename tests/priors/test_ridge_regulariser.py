"""Learned ridge regularisers: their bounds, their proximal step, and the solvers that take them."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.data

import scsr_opt
from scsr_opt.errors import InputError
from scsr_opt.motion import Motion
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.priors import Bounded, HuberTotalVariation, RidgeRegulariser, ridge_regulariser
from scsr_opt.priors.ridge_regulariser import (
    WEIGHTS,
    bank_norm_squared,
    correlate,
    correlate_adjoint,
    profile_and_derivative,
)
from scsr_opt.solvers import FISTA, ISTA, NonlinearCG

KINDS = ("convex", "weakly_convex")


@pytest.fixture(params=KINDS)
def prior(request) -> RidgeRegulariser:
    return RidgeRegulariser.load(request.param)


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def picture(side: int = 40) -> jax.Array:
    return jnp.asarray(skimage.data.camera()[100 : 100 + side, 200 : 200 + side] / 255, jnp.float32)


def test_shipped_files_are_small_and_carry_a_card():
    for kind in KINDS:
        path = WEIGHTS / f"ridge_{kind}.npz"
        assert path.stat().st_size < 50_000
        card = json.loads(path.with_suffix(".json").read_text())
        assert {"steps", "minutes", "patches", "curvature", "concavity"} <= set(card)
        prior = RidgeRegulariser.load(kind)
        assert card["curvature"] == pytest.approx(prior.curvature, rel=1e-4)
        assert card["concavity"] == pytest.approx(prior.concavity, rel=1e-4, abs=1e-9)


def test_convex_has_no_negative_slope_and_the_other_has():
    assert RidgeRegulariser.load("convex").concavity == 0
    weak = RidgeRegulariser.load("weakly_convex")
    assert 0 < weak.concavity < weak.curvature


@pytest.mark.parametrize("shape", [(12, 12), (3, 20), (31, 24)])
def test_adjoint(prior, shape):
    x = jnp.asarray(noise(1, *shape), jnp.float32)
    field = jnp.asarray(noise(2, len(prior.filters), *shape), jnp.float32)
    forward = jnp.sum(correlate(prior.filters, x) * field)
    backward = jnp.sum(x * correlate_adjoint(prior.filters, field))
    # Of a sum of n products of size 1, float32 keeps eps·√n or so of √n.
    assert float(abs(forward - backward)) < 1e-5 * float(jnp.linalg.norm(x) * jnp.linalg.norm(field))


def test_gradient_is_that_of_the_value(prior):
    with jax.enable_x64(True):
        x = jnp.asarray(picture(), jnp.float64)
        direction = jnp.asarray(noise(3, *x.shape) * 0.02)
        step = 1e-4
        slope = (prior.value(x + step * direction) - prior.value(x - step * direction)) / (2 * step)
        # Where a knot is passed within the step, the central difference is off by curvature·step; few are.
        assert float(jnp.sum(prior.gradient(x) * direction)) == pytest.approx(float(slope), rel=1e-4)
        np.testing.assert_allclose(jax.grad(prior.value)(x), prior.gradient(x), atol=1e-9 * prior.curvature)


@pytest.mark.parametrize("shape", [(16, 16), (7, 30), (41, 33)])
def test_norm_is_within_its_bound(prior, shape):
    x = jnp.asarray(noise(4, *shape), jnp.float32)
    bank = np.asarray(prior.filters, np.float64)
    bound = bank_norm_squared(bank)

    @jax.jit
    def normal(x: jax.Array) -> jax.Array:
        return correlate_adjoint(prior.filters, correlate(prior.filters, x))

    for _ in range(60):
        x = x / jnp.linalg.norm(x)
        following = normal(x)
        found, x = float(jnp.sum(x * following)), following
    assert found <= bound * (1 + 1e-5)
    # Not a loose one either: a small picture has few frequencies, so it need not come nearer.
    assert found >= 0.5 * bound


def test_curvature_lies_between_the_bounds(prior):
    """⟨∇Ψ(a) − ∇Ψ(b), a − b⟩ / ‖a − b‖² for pairs near and far: convex, or weakly so with its constant."""
    for seed, size in enumerate((1e-3, 1e-2, 0.1, 1.0)):
        a = picture() + jnp.asarray(size * noise(seed, 40, 40), jnp.float32)
        b = picture() + jnp.asarray(size * noise(seed + 10, 40, 40), jnp.float32)
        bend_along = jnp.sum((prior.gradient(a) - prior.gradient(b)) * (a - b)) / jnp.sum((a - b) ** 2)
        assert -prior.concavity * (1 + 1e-3) <= float(bend_along) <= prior.curvature * (1 + 1e-3)
        between = prior.value((a + b) / 2) - (prior.value(a) + prior.value(b)) / 2
        allowed = prior.concavity / 8 * float(jnp.sum((a - b) ** 2))
        assert float(between) <= allowed + 1e-5 * float(prior.value(a))  # rounding of the three values


def test_weak_convexity_is_reached():
    """A test that a prior without negative slopes would fail: some pair bends downwards."""
    prior = RidgeRegulariser.load("weakly_convex")
    lowest = 0.0
    field = jnp.asarray(noise(0, len(prior.filters), 40, 40), jnp.float32)
    for size in np.geomspace(0.001, 1, 12):
        direction = jnp.asarray(size, jnp.float32) * correlate_adjoint(prior.filters, field)
        change = prior.gradient(1.05 * direction) - prior.gradient(direction)
        lowest = min(lowest, float(jnp.sum(change * direction)))
    assert lowest < 0


@pytest.mark.parametrize("shape", [(39, 41), (9, 31), (43, 3)])
def test_bands_are_the_whole(prior, shape, monkeypatch):
    """Few rows at a time, the last band with rows of the one before. Shapes of no other test: nothing is compiled."""
    monkeypatch.setattr(ridge_regulariser, "_BAND_VALUES", 4 * shape[1] * len(prior.filters))
    x = jnp.asarray(0.05 * noise(9, *shape), jnp.float32)
    value, gradient = prior.value_and_gradient(x)
    profile, derivative = profile_and_derivative(prior.knots, prior.slopes, correlate(prior.filters, x))
    # The same sums in another order.
    assert float(value) == pytest.approx(float(jnp.sum(profile)), rel=1e-5)
    whole = correlate_adjoint(prior.filters, derivative)
    np.testing.assert_allclose(gradient, whole, atol=1e-5 * float(jnp.abs(whole).max()))


def test_profile_is_the_integral_of_its_derivative(prior):
    field = jnp.linspace(-0.2, 0.2, 4001)[None, None] * jnp.ones((len(prior.filters), 1, 1))
    profile, derivative = profile_and_derivative(prior.knots, prior.slopes, field)
    steps = (derivative[..., 1:] + derivative[..., :-1]) / 2 * 1e-4
    found = jnp.cumsum(steps, -1) + profile[..., :1]
    # The rule of trapezes is exact but for the steps that a knot lies in; 4,000 sums are rounded.
    np.testing.assert_allclose(profile[..., 1:], found, atol=1e-3 * float(profile.max()))
    assert float(profile.min()) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("bounded", [False, True])
def test_what_starts_anew_is_accurate(bounded):
    prior = RidgeRegulariser.load()
    given = (Bounded(prior, 0, 1) if bounded else prior).with_inner_iterations(100)
    own = given.prior if isinstance(given, Bounded) else given
    assert isinstance(own, RidgeRegulariser) and float(own.accuracy) < 1e-5 < float(prior.accuracy)


@pytest.mark.parametrize("times", [0.5, 5.0, 50.0])
def test_a_proximal_step_leaves_no_more_than_its_accuracy(times):
    """Accuracy is a share of the distance to the optimum; the start is the picture before noise was added."""
    prior = RidgeRegulariser.load()
    noisy, start = picture() + jnp.asarray(0.05 * noise(10, 40, 40), jnp.float32), picture()
    strength = times / prior.curvature
    exact, _ = prior.with_inner_iterations(1).prox(noisy, strength, prior.initial_state(start))
    rough, _ = prior.prox(noisy, strength, prior.initial_state(start))
    left = float(jnp.linalg.norm(rough - exact) / jnp.linalg.norm(start - exact))
    assert 1e-4 < left <= float(prior.accuracy)


def test_default_by_scale():
    assert isinstance(default_prior(1), RidgeRegulariser) and isinstance(default_prior(3), RidgeRegulariser)
    assert isinstance(default_prior(4), HuberTotalVariation)


def test_does_not_change_with_mirroring(prior):
    x = picture(24)[:, :20]
    for turned in (x[::-1], x[:, ::-1], x[::-1, ::-1]):
        # The sum of 24·20·C values, in another order.
        assert float(prior.value(turned)) == pytest.approx(float(prior.value(x)), rel=1e-4)


def test_proximal_step_meets_its_optimality_condition(prior):
    noisy = picture() + jnp.asarray(0.05 * noise(5, 40, 40), jnp.float32)
    strength = 0.5 / prior.curvature
    patient = RidgeRegulariser(prior.filters, prior.knots, prior.slopes, 1e-9)
    solved, state = patient.prox(noisy, strength, patient.initial_state(noisy))
    slope = solved - noisy + strength * prior.gradient(solved)
    # κ is at most a few: converged to rounding, eps times the size of what is added up.
    assert float(jnp.abs(slope).max()) < 1e-5
    assert float(jnp.abs(solved - noisy).max()) > 1e-3
    np.testing.assert_array_equal(solved, state.image)
    assert float(prior.value_after(solved, state)) == float(state.value)
    value, gradient = prior.value_and_gradient(solved)
    # The same sums, compiled in another program.
    assert float(state.value) == pytest.approx(float(value), rel=1e-5)
    np.testing.assert_allclose(state.gradient, gradient, atol=1e-5 * prior.curvature)


@pytest.mark.parametrize("times", [0.5, 10.0, 200.0])
def test_few_proximal_steps_never_rise_above_their_start(prior, times):
    """With momentum, and without where that would not be certain."""
    noisy = picture() + jnp.asarray(0.05 * noise(6, 40, 40), jnp.float32)
    start = picture()
    strength = times / prior.curvature

    def objective(x: jax.Array) -> float:
        return float(jnp.sum((x - noisy) ** 2) / 2 + strength * prior.value(x))

    solved, _ = prior.prox(noisy, strength, prior.initial_state(start))
    assert objective(solved) < objective(start)


def test_strength_zero_gives_the_picture_back(prior):
    noisy = picture() + jnp.asarray(0.05 * noise(7, 40, 40), jnp.float32)
    solved, _ = prior.prox(noisy, 0.0, prior.initial_state(picture()))
    np.testing.assert_allclose(solved, noisy, atol=1e-6)  # rounding of x − (x − noisy)


def recording(side: int = 16, frames: int = 61) -> np.ndarray:
    """Spikes of a still picture of `side` pixels: integrate and fire, 0.6 spikes a frame at white."""
    seen = (
        skimage.data.camera()[100 : 100 + 2 * side, 200 : 200 + 2 * side].reshape(side, 2, side, 2).mean((1, 3)) / 255
    )
    charge = np.random.default_rng(0).uniform(size=seen.shape) + 0.6 * seen * np.arange(1, frames + 1)[:, None, None]
    return np.diff(np.floor(charge), axis=0, prepend=0).clip(0, 1).astype(np.uint8)


def test_ista_falls_in_every_iteration_and_fista_and_cg_agree_with_it():
    prior = RidgeRegulariser.load("convex")
    given = {"scale": 2, "prior": prior, "strength": 0.004, "motion": Motion.none(16, 16)}
    slow = scsr_opt.reconstruct(recording(), solver=ISTA(60, tolerance=0), **given)
    objectives = np.array([stage.objective for stage in slow.stages])
    # A sum of 45,000 terms in float32, one for each pixel and filter: 24 units of its last place were measured.
    assert (np.diff(objectives) <= 64 * np.finfo(np.float32).eps * objectives[0]).all()
    fast = scsr_opt.reconstruct(recording(), solver=FISTA(300, tolerance=1e-6), **given)
    assert fast.stages[-1].objective <= objectives[-1] * (1 + 64 * np.finfo(np.float32).eps)
    other = scsr_opt.reconstruct(recording(), solver=NonlinearCG(600, tolerance=1e-6), **given)
    # Each stops short of the minimum by what its tolerance allows.
    assert other.stages[-1].objective == pytest.approx(fast.stages[-1].objective, rel=5e-3)


def test_weakly_convex_falls_in_every_iteration_of_ista():
    solution = scsr_opt.reconstruct(
        recording(),
        scale=2,
        prior=RidgeRegulariser.load("weakly_convex"),
        strength=0.004,
        motion=Motion.none(16, 16),
        solver=ISTA(40, 0),
    )
    objectives = np.array([stage.objective for stage in solution.stages])
    assert (np.diff(objectives) <= 64 * np.finfo(np.float32).eps * objectives[0]).all()


def test_scaling(prior):
    x = picture()
    twice = prior.scaled(2.0, finer=3.0)
    assert float(twice.value(x)) == pytest.approx(2 / 3 * float(prior.value(3 * x)), rel=1e-4)
    assert twice.curvature == pytest.approx(6 * prior.curvature, rel=1e-5)
    with pytest.raises(InputError, match="weight"):
        prior.scaled(0.0)


def test_save_and_load(prior, tmp_path):
    prior.save(tmp_path / "p.npz")
    again = RidgeRegulariser.load(tmp_path / "p.npz", accuracy=float(prior.accuracy))
    np.testing.assert_array_equal(again.filters, prior.filters)
    assert (again.curvature, again.concavity) == (prior.curvature, prior.concavity)


def test_damaged_and_foreign_files_are_refused(prior, tmp_path):
    path = tmp_path / "p.npz"
    prior.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged"):
        RidgeRegulariser.load(path)
    path.write_bytes(whole[:200] + bytes(200) + whole[400:])
    with pytest.raises(InputError, match="damaged"):
        RidgeRegulariser.load(path)
    np.savez(path, other=np.zeros(3))
    with pytest.raises(InputError, match="damaged"):
        RidgeRegulariser.load(path)
    with pytest.raises(InputError, match="no ridge regulariser"):
        RidgeRegulariser.load("concave")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f, t, s: (f[:-1], t, s), "row for each"),
        (lambda f, t, s: (f[:, :-1], t, s), "odd"),
        (lambda f, t, s: (f + 0.1, t, s), "sum is not zero"),
        (lambda f, t, s: (f - f[::-1, :, ::-1] * 0.5, t, s), "mirrored"),
        (lambda f, t, s: (f, t[:, ::-1], s), "increasing"),
        (lambda f, t, s: (f, t, s * np.nan), "finite"),
    ],
)
def test_arrays_that_do_not_serve_are_refused(change, message):
    prior = RidgeRegulariser.load("weakly_convex")
    arrays = (np.asarray(v, np.float64) for v in (prior.filters, prior.knots, prior.slopes))
    with pytest.raises(InputError, match=message):
        RidgeRegulariser(*change(*arrays))
    for accuracy in (0, 1.5):
        with pytest.raises(InputError, match="accuracy"):
            RidgeRegulariser.load("convex", accuracy=accuracy)
