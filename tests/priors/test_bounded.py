"""Bounds on the picture: inside the dual steps, and by alternation where there are none."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.priors import Bounded, HuberTotalVariation, PlugAndPlay, Prior, TotalGeneralizedVariation, TotalVariation
from scsr_opt.priors.total_variation import gradient, gradient_adjoint

SHAPE = (7, 9)
STRENGTH = 0.1
LOWER, UPPER = 0.1, 0.8  # both are active, in about half of the pixels
MANY = 3000


class Hidden(Prior[Any]):
    """Total variation of which only the proximal step is to be seen."""

    inner: TotalVariation

    def value(self, image):
        return self.inner.value(image)

    def initial_state(self, image):
        return self.inner.initial_state(image)

    def prox(self, image, strength, state):
        return self.inner.prox(image, strength, state)


@eqx.filter_jit
def step(prior: Prior, image: jax.Array, strength: jax.Array, state: Any):
    return prior.prox(image, strength, state)


def prox(prior: Prior, image: np.ndarray, strength: float, state: Any = None):
    given = jnp.asarray(image)
    state = prior.initial_state(given) if state is None else state
    return step(prior, given, jnp.asarray(strength, given.dtype), state)


def exact(oracle, f: np.ndarray, upper: float) -> np.ndarray:
    d = np.vstack(oracle.differences(SHAPE))
    blocks = [(d, oracle.soft_vectors(STRENGTH, 2)), (np.eye(f.size), lambda v, t: np.clip(v, LOWER, upper))]
    return oracle.solve(f, 0, blocks).reshape(SHAPE)


@pytest.mark.parametrize("upper", [UPPER, None])
def test_prox_against_admm(double, oracle, upper):
    f = oracle.picture()
    expected = exact(oracle, f, np.inf if upper is None else upper)
    inside, _ = prox(Bounded(TotalVariation(iterations=MANY), LOWER, upper), f, STRENGTH)
    np.testing.assert_allclose(inside, expected, rtol=0, atol=1e-4)
    # Ten dual steps and one round of alternation at a time, from the state of the last call.
    outside = Bounded(Hidden(TotalVariation(iterations=10)), LOWER, upper, rounds=1)
    state = None
    for _ in range(400):
        alternated, state = prox(outside, f, STRENGTH, state)
    np.testing.assert_allclose(alternated, expected, rtol=0, atol=2e-3)
    # Clipping afterwards would be something else.
    clipped = np.clip(prox(TotalVariation(iterations=MANY), f, STRENGTH)[0], LOWER, upper)
    assert np.abs(clipped - expected).max() > 5e-3


def test_optimality(double, oracle):
    # f − X − λ∇*p is in the normal cone of the box at X: not negative at the upper bound, not positive at the lower
    # one, 0 between; and p is a subgradient of the norm at ∇X.
    f = oracle.picture()
    x, state = prox(Bounded(TotalVariation(iterations=MANY), LOWER, UPPER), f, STRENGTH)
    held = np.asarray(f - x - STRENGTH * gradient_adjoint(state.prior))
    x = np.asarray(x)
    at_lower, at_upper = x == LOWER, x == UPPER
    assert at_lower.sum() > 5 and at_upper.sum() > 5
    assert held[at_lower].max() <= 0 and held[at_upper].min() >= 0
    np.testing.assert_allclose(held[~at_lower & ~at_upper], 0, rtol=0, atol=1e-14)
    slope = gradient(jnp.asarray(x))
    products = float(jnp.sum(slope.down * state.prior.down + slope.right * state.prior.right))
    assert products == pytest.approx(float(TotalVariation().value(jnp.asarray(x))), rel=1e-4)


@pytest.mark.parametrize(
    "inner",
    [TotalVariation(iterations=12), HuberTotalVariation(iterations=12), TotalGeneralizedVariation(iterations=12)],
    ids=lambda p: type(p).__name__,
)
def test_always_within_and_finite_and_the_same_where_bounds_are_far(oracle, inner):
    f = (3 * oracle.picture()).astype(np.float32)
    for strength in (0.0, 0.05, 10.0):
        x, _ = prox(Bounded(inner, LOWER, UPPER), f, strength)
        # Compared as float32: 0.1 is not the same number there.
        assert x.dtype == jnp.float32 and x.min() >= np.float32(LOWER) and x.max() <= np.float32(UPPER)
    np.testing.assert_array_equal(
        prox(Bounded(inner, LOWER, UPPER), f, 0.0)[0], np.clip(f, np.float32(LOWER), np.float32(UPPER))
    )
    far, _ = prox(Bounded(inner, -100.0, 100.0, rounds=1), f, 0.05)
    np.testing.assert_allclose(far, prox(inner, f, 0.05)[0], rtol=0, atol=1e-6)
    # The value is that of the prior, finite outside too.
    assert Bounded(inner).value(jnp.asarray(f - 5)) == inner.value(jnp.asarray(f - 5))
    assert not Bounded(inner).smooth


def test_non_negative_by_default_with_any_denoiser(oracle):
    prior = Bounded(PlugAndPlay(lambda image, sigma: image - sigma), rounds=1)
    f = oracle.picture().astype(np.float32)
    x, _ = prox(prior, f, 0.04)
    np.testing.assert_allclose(x, np.maximum(f - 0.2, 0), rtol=0, atol=1e-6)
    assert prior.value(x) == 0


def test_precision_is_kept(double, oracle):
    for inner in (TotalVariation(iterations=12), TotalGeneralizedVariation(iterations=12)):
        x, state = prox(Bounded(inner, 0, 1), oracle.picture(), STRENGTH)
        assert {v.dtype for v in (x, *jax.tree.leaves(state))} == {np.dtype(np.float64)}


def test_derivatives_are_finite(oracle):
    f = jnp.asarray(oracle.picture().astype(np.float32))
    for inner in (TotalVariation(iterations=12), Hidden(TotalVariation(iterations=12))):
        prior = Bounded(inner, LOWER, UPPER)

        def loss(image, strength, prior=prior):
            return jnp.sum(prior.prox(image, strength, prior.initial_state(image))[0] ** 2)

        for found in jax.jit(jax.grad(loss, argnums=(0, 1)))(f, jnp.float32(0.0)):
            assert np.all(np.isfinite(found))
