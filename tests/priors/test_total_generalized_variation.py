"""TGV: what costs nothing, its value and its proximal step against dense matrices and ADMM in X and w together."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.errors import InputError
from scsr_opt.priors import TotalGeneralizedVariation, TotalVariation

SHAPE = (7, 9)
RATIO = 1.5
FEW, MANY = TotalGeneralizedVariation(RATIO, 10, 50), TotalGeneralizedVariation(RATIO, 6000, 6000)
SLOPE = 0.3 + 0.05 * np.arange(7)[:, None] - 0.08 * np.arange(9)


@eqx.filter_jit
def step(prior: TotalGeneralizedVariation, image: jax.Array, strength: jax.Array, state: Any):
    return prior.prox(image, strength, state)


@eqx.filter_jit
def value(prior: TotalGeneralizedVariation, image: Any) -> jax.Array:
    return prior.value(image)


def prox(prior: TotalGeneralizedVariation, image: np.ndarray, strength: float, state: Any = None):
    given = jnp.asarray(image)
    state = prior.initial_state(given) if state is None else state
    return step(prior, given, jnp.asarray(strength, given.dtype), state)


def matrices(oracle, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(X, w) ↦ ∇X − w, and ↦ E w with the mixed part times √2, from differences of what lies inside the picture."""
    rows, columns = shape
    size = rows * columns
    down, right = oracle.differences(shape)
    edges = np.hstack([np.vstack([down, right]), -np.eye(2 * size)])
    number = np.arange(size).reshape(shape)
    bends = np.zeros((3 * size, 3 * size))
    for (r, c), at in np.ndenumerate(number):
        first, second = size + at, 2 * size + at  # w's parts at this pixel; X comes before them
        if 0 < r < rows - 1:
            bends[at, [first, first - columns]] = 1, -1
        if 0 < c < columns - 1:
            bends[size + at, [second, second - 1]] = 1, -1
        if r < rows - 1 and c < columns - 1:
            bends[2 * size + at, [first + 1, first]] = 0.5**0.5, -(0.5**0.5)
            bends[2 * size + at, [second + columns, second]] = 0.5**0.5, -(0.5**0.5)
    return edges, bends


def lengths(v: np.ndarray, parts: int) -> float:
    return float(np.sqrt((v.reshape(parts, -1) ** 2).sum(axis=0)).sum())


def test_affine_pictures_cost_nothing_and_stay(double):
    # Up to the border. w has to be found: the value falls towards 0 with the number of steps.
    size = float(TotalVariation().value(jnp.asarray(SLOPE)))
    assert value(MANY, SLOPE) < 1e-4 * size
    x, _ = prox(MANY, SLOPE, 0.2)
    np.testing.assert_allclose(x, SLOPE, rtol=0, atol=1e-4)
    assert value(FEW, np.full(SHAPE, 0.4)) == 0


def test_prox_and_value_against_admm(double, oracle):
    f, strength = oracle.picture() + SLOPE, 0.1
    edges, bends = matrices(oracle, SHAPE)
    blocks = [
        (edges, oracle.soft_vectors(strength, 2)),
        (bends, oracle.soft_vectors(strength * RATIO, 3)),
    ]
    exact = oracle.solve(f, 2 * f.size, blocks)
    exact_value = lengths(edges @ exact, 2) + RATIO * lengths(bends @ exact, 3)
    x, state = prox(MANY, f, strength)
    np.testing.assert_allclose(np.asarray(x).ravel(), exact[: f.size], rtol=0, atol=1e-3)
    # At the exact X the exact w is the minimiser too: the value is that of the pair, from above.
    found = value(MANY, exact[: f.size].reshape(SHAPE))
    assert exact_value * (1 - 1e-6) <= found <= exact_value * (1 + 1e-3)
    assert found <= value(FEW, exact[: f.size].reshape(SHAPE)) <= 1.1 * found
    joint = np.concatenate([v.ravel() for v in (x, *state.slope)])

    def objective(u: np.ndarray) -> float:
        data = 0.5 * float(np.sum((u[: f.size] - f.ravel()) ** 2))
        return data + strength * (lengths(edges @ u, 2) + RATIO * lengths(bends @ u, 3))

    assert objective(exact) - 1e-6 <= objective(joint) <= objective(exact) * (1 + 1e-4)
    # Warm: ten steps at a time end there too, and another strength finds a good start in the same state.
    warm = None
    for _ in range(200):
        near, warm = prox(FEW, f, strength, warm)
    np.testing.assert_allclose(near, x, rtol=0, atol=3e-3)
    other = np.asarray(prox(MANY, f, 1.2 * strength)[0])
    cold = np.linalg.norm(prox(FEW, f, 1.2 * strength)[0] - other)
    assert np.linalg.norm(prox(FEW, f, 1.2 * strength, warm)[0] - other) < 0.5 * cold


def test_value_is_a_seminorm_below_total_variation(double, oracle):
    f, g = oracle.picture(SHAPE, 1), oracle.picture(SHAPE, 2)
    of_f, of_g = (float(value(MANY, v)) for v in (f, g))
    assert of_f <= float(TotalVariation().value(jnp.asarray(f))) * (1 + 1e-6)
    assert float(value(MANY, -2.5 * f + 7)) == pytest.approx(2.5 * of_f, rel=1e-6)
    assert float(value(MANY, f + SLOPE)) == pytest.approx(of_f, rel=1e-3)
    assert value(MANY, f + g) <= of_f + of_g
    # The steps take no notice of the unit, so this holds for few of them as well.
    assert float(value(FEW, 1e4 * f)) == pytest.approx(1e4 * float(value(FEW, f)), rel=1e-9)


def test_exchanging_rows_and_columns_exchanges_them(double, oracle):
    f = oracle.picture()
    np.testing.assert_allclose(prox(FEW, f.T, 0.1)[0], prox(FEW, f, 0.1)[0].T, rtol=0, atol=1e-12)
    assert float(value(FEW, f.T)) == pytest.approx(float(value(FEW, f)), rel=1e-12)


def test_gradient_of_the_value(double, oracle):
    # Where w is the minimiser, the derivative at fixed w is that of Ψ: within a step along a direction of the
    # subgradient inequality on either side.
    f, direction = oracle.picture(), np.random.default_rng(3).normal(size=SHAPE)
    slope = float(np.vdot(jax.jit(jax.grad(MANY.value))(jnp.asarray(f)), direction))
    h = 1e-2
    before, at, after = (float(value(MANY, f + t * direction)) for t in (-h, 0, h))
    assert (at - before) / h - 0.02 * abs(slope) <= slope <= (after - at) / h + 0.02 * abs(slope)


def test_derivatives_are_finite_and_zero_strength_changes_nothing():
    flat = np.zeros(SHAPE, np.float32)
    flat[:3] = 1

    @jax.jit
    def slopes(image, strength):
        def loss(image, strength):
            return jnp.sum(FEW.prox(image, strength, FEW.initial_state(image))[0] ** 2)

        return jax.grad(FEW.value)(image), *jax.grad(loss, argnums=(0, 1))(image, strength)

    for image in (flat, 0 * flat):
        for strength in (0.0, 0.1, 100.0):
            assert all(np.all(np.isfinite(v)) for v in slopes(image, jnp.float32(strength)))
        _, state = prox(FEW, flat, 0.1)
        x, kept = prox(FEW, image, 0.0, state)
        np.testing.assert_array_equal(x, image)
        assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(kept), jax.tree.leaves(state), strict=True))


def test_precisions_and_small_pictures(oracle):
    results = {}
    for dtype in (np.float32, np.float64):
        with jax.enable_x64(dtype == np.float64):
            x, state = prox(FEW, oracle.picture().astype(dtype), 0.1)
            assert {v.dtype for v in (x, *jax.tree.leaves(state), value(FEW, x))} == {np.dtype(dtype)}
            results[dtype] = np.asarray(x, np.float64)
    np.testing.assert_allclose(results[np.float32], results[np.float64], rtol=0, atol=1e-5)
    for shape in ((1, 1), (1, 2), (2, 2)):
        f = np.random.default_rng(0).random(shape).astype(np.float32)
        x, _ = prox(FEW, f, 0.05)
        # Two pixels in a row are a slope.
        assert x.shape == shape and np.isfinite(value(FEW, x))
        np.testing.assert_allclose(np.mean(x), np.mean(f), rtol=1e-5)


@pytest.mark.parametrize(
    "arguments", [{"ratio": 0}, {"ratio": float("nan")}, {"iterations": 0}, {"value_iterations": 0}]
)
def test_refuses_what_makes_no_sense(arguments):
    with pytest.raises(InputError, match="TotalGeneralizedVariation was given"):
        TotalGeneralizedVariation(**arguments)
