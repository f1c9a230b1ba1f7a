"""Priors φ(K X): what each promises as a class of its own, and the proximal step against dense matrices and ADMM."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.priors import Analysis, BilateralTotalVariation, HuberTotalVariation, TotalVariation, WaveletL1

SHAPE = (7, 9)
STRENGTH = 0.15
FEW, MANY = 12, 3000  # more than 10 are not unrolled, which is quick to compile
KNEE, DECAY = 0.1, 0.6


class Case(NamedTuple):
    """A prior with a given number of iterations; K as a matrix made another way; φ and its proximal step in NumPy."""

    prior: Callable[[int], Analysis]
    matrix: Callable[[Any, tuple[int, int]], np.ndarray]
    value: Callable[[np.ndarray], float]
    shrink: Callable[[Any], Callable[[np.ndarray, float], np.ndarray]]


def gradient_matrix(oracle, shape):
    return np.vstack(oracle.differences(shape))


def lengths(v: np.ndarray) -> np.ndarray:
    return np.hypot(*v.reshape(2, -1))


def huber(v: np.ndarray) -> float:
    r = lengths(v)
    return float(np.where(r <= KNEE, r**2 / (2 * KNEE), r - KNEE / 2).sum())


def huber_shrink(v: np.ndarray, t: float) -> np.ndarray:
    r = np.tile(lengths(v), 2)
    return v * np.where(r <= KNEE + t, KNEE / (KNEE + t), 1 - t / np.maximum(r, 1e-300))


def bilateral_matrix(radius: int):
    """A row for each unordered pair of pixels in reach: each shift and its opposite give the same pairs."""

    def matrix(_, shape):
        rows = []
        pixels = list(np.ndindex(shape))
        for i, p in enumerate(pixels):
            for j, q in enumerate(pixels[:i]):
                distance = abs(p[0] - q[0]), abs(p[1] - q[1])
                if max(distance) <= radius:
                    row = np.zeros(len(pixels))
                    row[i], row[j] = DECAY ** sum(distance), -(DECAY ** sum(distance))
                    rows.append(row)
        return np.array(rows)

    return matrix


def wavelet_matrix(levels: int):
    """One period of the mirrored picture, transformed with a periodic border; φ is a quarter of it, weighted."""

    def bands(image: np.ndarray) -> np.ndarray:
        means = np.pad(image, [(0, n) for n in image.shape], mode="symmetric")
        found = []
        for level in range(1, levels + 1):

            def halves(v, axis, apart=2 ** (level - 1)):
                other = np.roll(v, -apart, axis)
                return (v + other) / 2, (v - other) / 2

            (low, high), weight = halves(means, 0), 4.0 ** (-level - 1)
            means, right = halves(low, 1)
            down, both = halves(high, 1)
            found += [weight * down, weight * right, weight * both]
        return np.concatenate([band.ravel() for band in found])

    def matrix(_, shape):
        return np.stack([bands(unit.reshape(shape)) for unit in np.eye(shape[0] * shape[1])], axis=1)

    return matrix


def l1(v: np.ndarray) -> float:
    return float(np.abs(v).sum())


# `TotalVariation` has a module of tests of its own.
CASES = {
    "huber": Case(lambda n: HuberTotalVariation(KNEE, n), gradient_matrix, huber, lambda o: huber_shrink),
    "bilateral": Case(lambda n: BilateralTotalVariation(2, DECAY, n), bilateral_matrix(2), l1, lambda o: o.soft(1.0)),
    "wavelet": Case(lambda n: WaveletL1(2, n), wavelet_matrix(2), l1, lambda o: o.soft(1.0)),
}


@pytest.fixture(params=CASES)
def case(request) -> Case:
    return CASES[request.param]


@eqx.filter_jit
def step(prior: Analysis, image: jax.Array, strength: jax.Array, state: Any):
    result, state = prior.prox(image, strength, state)
    return result, state, prior.gap(image, strength, state)


def prox(prior: Analysis, image: np.ndarray, strength: float, state: Any = None):
    given = jnp.asarray(image)
    state = prior.initial_state(given) if state is None else state
    return step(prior, given, jnp.asarray(strength, given.dtype), state)


def random_like(tree: Any, seed: int, size: float = 1.0) -> Any:
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda v: jnp.asarray(size * rng.normal(size=v.shape).astype(v.dtype)), tree)


def inner(a: Any, b: Any) -> float:
    return sum(float(np.vdot(v, w)) for v, w in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


# K


@pytest.mark.parametrize("shape", [SHAPE, (1, 1), (1, 4)])
def test_adjoint(double, case, shape):
    prior = case.prior(FEW)
    x, y = random_like((jnp.zeros(shape), jnp.zeros(shape)), 0)
    # What belongs to no pair of pixels does not count: a field is K of something, or a dual variable made from such.
    field = jax.tree.map(lambda z, v: jnp.where(z == 0, 0, v), prior.analysis(x), random_like(prior.analysis(y), 1))
    assert inner(prior.analysis(x), field) == pytest.approx(inner(x, prior.adjoint(field)), rel=1e-12, abs=1e-13)


def test_norm_is_bounded_and_the_bound_is_near(double, case):
    prior = case.prior(FEW)
    image = random_like(jnp.zeros((16, 16)), 2)
    normal = jax.jit(lambda v: prior.adjoint(prior.analysis(v)))
    for _ in range(100):
        image = normal(image)
        size = float(jnp.linalg.norm(image))
        image = image / size
    assert size <= prior.norm_squared * (1 + 1e-12)
    # The largest dual step that is allowed; half of it would be a waste. A sum of shifts is the loosest.
    assert size > 0.55 * prior.norm_squared


def test_value_against_matrices(double, oracle, case):
    prior, matrix = case.prior(FEW), case.matrix(oracle, SHAPE)
    for seed in range(3):
        image = oracle.picture(SHAPE, seed) * 0.2 * (seed + 1)
        assert float(prior.value(jnp.asarray(image))) == pytest.approx(case.value(matrix @ image.ravel()), rel=1e-12)
    assert float(prior.value(jnp.full(SHAPE, 0.7))) == pytest.approx(0, abs=1e-13)


# φ


def test_penalties_and_conjugates_are_conjugate(double, case):
    # Fenchel and Young: φ(z) + φ*(p) ≥ ⟨z, p⟩ for any p that conjugate_prox returns, with equality for the shrunk
    # field and the dual variable that belong together.
    prior, t = case.prior(FEW), jnp.asarray(0.3)
    field = random_like(prior.analysis(jnp.zeros(SHAPE)), 3, 0.4)
    dual = prior.conjugate_prox(jax.tree.map(lambda v: v / t, field), 1 / t)
    shrunk = prior.shrink(field, t)

    def young(z: Any) -> float:
        return float(jnp.sum(prior.penalties(z)) + jnp.sum(prior.conjugates(dual))) - inner(z, dual)

    assert young(shrunk) == pytest.approx(0, abs=1e-10)
    for seed in range(5):
        assert young(random_like(field, 10 + seed)) > 0

    def objective(z: Any) -> float:
        away = jax.tree.map(jnp.subtract, z, field)
        return 0.5 * inner(away, away) + float(t * jnp.sum(prior.penalties(z)))

    for seed in range(5):
        other = jax.tree.map(jnp.add, shrunk, random_like(field, 20 + seed, 1e-3))
        # The objective is 1-strongly convex.
        distance = jax.tree.map(jnp.subtract, other, shrunk)
        assert objective(other) >= objective(shrunk) + 0.5 * inner(distance, distance) - 1e-12


# The proximal step


@pytest.mark.parametrize("strength", [0.03, 0.4])
def test_prox_against_admm(double, oracle, case, strength):
    f, matrix = oracle.picture(), case.matrix(oracle, SHAPE)
    shrink = case.shrink(oracle)
    exact = oracle.solve(f, 0, [(matrix, lambda v, t: shrink(v, t * strength))])
    x, state, gap = prox(case.prior(MANY), f, strength)

    def objective(x: np.ndarray) -> float:
        return 0.5 * float(np.sum((x.ravel() - f.ravel()) ** 2)) + strength * case.value(matrix @ x.ravel())

    # Both converge sublinearly; ½‖x − prox‖² ≤ gap.
    assert 0 <= gap + 1e-12 and gap < 1e-6
    np.testing.assert_allclose(np.asarray(x).ravel(), exact, rtol=0, atol=2e-4)
    assert objective(np.asarray(x)) <= objective(exact) + 1e-6
    assert 1e-2 < np.abs(np.asarray(x) - f).max()  # strong enough to be a test
    # The gap is that between the two objectives.
    conjugates = float(jnp.sum(case.prior(MANY).conjugates(state)))
    dual = 0.5 * np.sum(f**2) - 0.5 * np.sum(np.asarray(x) ** 2) - strength * conjugates
    assert float(gap) == pytest.approx(objective(np.asarray(x)) - dual, abs=1e-10)


def test_few_steps_from_a_warm_start_end_where_many_do(double, oracle, case):
    few, f = case.prior(FEW), oracle.picture()
    exact, _, _ = prox(case.prior(MANY), f, STRENGTH)
    cold, state, cold_gap = prox(few, f, STRENGTH)
    for _ in range(60):
        warm, state, gap = prox(few, f, STRENGTH, state)
    assert gap < 0.02 * cold_gap
    np.testing.assert_allclose(warm, exact, rtol=0, atol=3e-3)
    # It stays a good start for another strength.
    _, _, other = prox(few, f, 1.2 * STRENGTH, state)
    assert other < 0.6 * prox(few, f, 1.2 * STRENGTH)[2]


@pytest.mark.parametrize("shape", [(1, 1), (2, 3)])
def test_small_pictures(case, shape):
    f = np.random.default_rng(0).random(shape).astype(np.float32)
    x, state, gap = prox(case.prior(FEW), f, 0.05)
    assert x.shape == shape and np.all(np.isfinite(x)) and np.isfinite(gap)
    # No prior here knows how bright a picture is.
    np.testing.assert_allclose(np.mean(x), np.mean(f), rtol=1e-5)


def test_precisions(oracle, case):
    prior, results = case.prior(FEW), {}
    for dtype in (np.float32, np.float64):
        with jax.enable_x64(dtype == np.float64):
            x, state, gap = prox(prior, oracle.picture().astype(dtype), STRENGTH)
            value = prior.value(x)
            assert {v.dtype for v in (x, *jax.tree.leaves(state), gap, value)} == {np.dtype(dtype)}
            results[dtype] = np.asarray(x, np.float64)
    np.testing.assert_allclose(results[np.float32], results[np.float64], rtol=0, atol=1e-5)


def test_derivatives_are_finite_and_zero_strength_changes_nothing(case):
    prior = case.prior(FEW)
    flat = np.zeros(SHAPE, np.float32)
    flat[:3] = 1

    @jax.jit
    def slopes(image, strength):
        def loss(image, strength):
            return jnp.sum(prior.prox(image, strength, prior.initial_state(image))[0] ** 2)

        return jax.grad(prior.value)(image), *jax.grad(loss, argnums=(0, 1))(image, strength)

    for image in (flat, 0 * flat):
        for strength in (0.0, 0.1, 100.0):
            found = slopes(image, jnp.float32(strength))
            assert all(np.all(np.isfinite(v)) for v in found)
        noisy = random_like(jnp.asarray(image), 0)
        _, state, _ = prox(prior, noisy, 0.1)
        x, kept, _ = prox(prior, image, 0.0, state)
        np.testing.assert_array_equal(x, image)
        for a, b in zip(jax.tree.leaves(kept), jax.tree.leaves(state), strict=True):
            # A vector of length 1 is divided by its length again: a rounding in each of the steps.
            np.testing.assert_allclose(a, b, atol=FEW * 2**-23)


def test_another_prior_of_the_same_settings_compiles_nothing(case):
    traces = []

    @eqx.filter_jit
    def run(prior, image, strength, state):
        traces.append(None)
        return prior.prox(image, strength, state)

    image = jnp.ones(SHAPE, jnp.float32)
    for strength in (0.1, 0.2):
        prior = case.prior(FEW)
        image, _ = run(prior, image, jnp.float32(strength), prior.initial_state(image))
    assert len(traces) == 1


# What each is apart from that


def test_only_the_smooth_one_says_so():
    assert {name for name, case in CASES.items() if case.prior(FEW).smooth} == {"huber"}


def test_gradient_of_huber(double, oracle):
    prior, matrix, f = HuberTotalVariation(KNEE), gradient_matrix(oracle, SHAPE), oracle.picture()
    slope = matrix @ f.ravel()
    expected = matrix.T @ (slope / np.maximum(np.tile(lengths(slope), 2), KNEE))
    gradient = jax.jit(jax.grad(prior.value))
    np.testing.assert_allclose(np.asarray(gradient(f)).ravel(), expected, rtol=0, atol=1e-12)
    for seed in range(5):  # 8/δ-Lipschitz
        other = f + 0.05 * np.random.default_rng(seed).normal(size=SHAPE)
        assert jnp.linalg.norm(gradient(f) - gradient(other)) <= 8 / KNEE * np.linalg.norm(f - other)


def test_huber_lies_below_total_variation(double, oracle):
    f = jnp.asarray(oracle.picture())
    total = float(TotalVariation().value(f))
    assert total - KNEE / 2 * f.size <= float(HuberTotalVariation(KNEE).value(f)) <= total
    assert float(HuberTotalVariation(1e-9).value(f)) == pytest.approx(total, rel=1e-6)


@pytest.mark.parametrize("levels", [1, 2, 4])
def test_wavelet_bands_and_means_are_parseval(double, oracle, levels):
    # The means that are left belong to the mirrored picture's period, a quarter of which counts.
    f = oracle.picture()
    means = np.pad(f, [(0, n) for n in SHAPE], mode="symmetric")
    for level in range(levels):
        for axis in (0, 1):
            means = (means + np.roll(means, -(2**level), axis)) / 2
    bands = WaveletL1(levels).analysis(jnp.asarray(f))
    assert float(jnp.sum(bands**2)) + (means**2).sum() / 4 == pytest.approx((f**2).sum(), rel=1e-12)


def test_priors_do_not_depend_on_which_way_is_down(double, oracle, case):
    # Turned over, mirrored, or rows and columns exchanged; isotropic differences have a preferred corner.
    prior, f = case.prior(FEW), oracle.picture()
    value = float(prior.value(jnp.asarray(f)))
    assert float(prior.value(jnp.asarray(f.T))) == pytest.approx(value, rel=1e-12)
    if not isinstance(prior, HuberTotalVariation):
        assert float(prior.value(jnp.asarray(f[::-1]))) == pytest.approx(value, rel=1e-12)
        assert float(prior.value(jnp.asarray(f[:, ::-1]))) == pytest.approx(value, rel=1e-12)
