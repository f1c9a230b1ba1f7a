"""Robust losses: what they are, that reweighting minimises them, and that liars lose their say."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.camera.samples import Samples
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Trajectory
from scsr_opt.operators.losses import Huber, Loss, Welsch, residuals, robust_factors
from scsr_opt.operators.sampling import PlacedSamples, accumulate, place

LOSSES = [Huber(), Huber(0.7), Welsch(), Welsch(1.5)]
SIZE = 6


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def measured(each: int = 40, liars: float = 0.0, noise: float = 0.02) -> tuple[PlacedSamples, np.ndarray, np.ndarray]:
    """Many samples of every pixel of a picture at rest, scale 1: the picture is their location estimate."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 0.8, (SIZE, SIZE))
    row, column = (np.tile(v.ravel(), each).astype(np.int32) for v in np.indices((SIZE, SIZE)))
    lies = rng.random(row.size) < liars
    value = truth[row, column] + noise * rng.standard_normal(row.size) + np.where(lies, 0.5, 0)
    ones = np.ones(row.size)
    samples = jax.tree.map(jnp.asarray, Samples(row, column, 0 * ones, ones, value, ones))
    position = np.indices((SIZE, SIZE)).astype(float)[None]
    path = Trajectory(jnp.asarray(0.0), jnp.asarray(position), jnp.ones((1, SIZE, SIZE)))
    return place(samples, path, scale=1, shape=(SIZE, SIZE)), truth, lies


def solved(placed: PlacedSamples, robust=None) -> jax.Array:
    """Without a prior, at rest and at scale 1 M is diagonal."""
    term = accumulate(placed, robust=robust)
    return term.target / term.stencil.planes[0]


@pytest.mark.parametrize("loss", LOSSES, ids=str)
def test_weights_are_the_slope_over_the_residual(loss: Loss):
    e = jnp.asarray(np.concatenate([np.linspace(-9, -0.01, 50), np.linspace(0.01, 9, 50)]))
    slope = jax.vmap(jax.grad(lambda x: loss.value(x)))(e)
    np.testing.assert_allclose(loss.weights(e), slope / e, rtol=1e-9, atol=1e-14)
    assert float(loss.weights(jnp.asarray(0.0))) == 1 and float(loss.value(jnp.asarray(0.0))) == 0
    assert np.all(np.diff(loss.weights(e[50:])) <= 1e-15)  # what majorise–minimise needs
    np.testing.assert_allclose(loss.value(jnp.asarray(1e-3)), 0.5e-6, rtol=1e-4)


def test_huber_keeps_pulling_and_welsch_lets_go():
    far = jnp.asarray([10.0, 100.0])
    np.testing.assert_allclose(Huber(2.0).weights(far) * far, 2.0)
    assert np.all(np.asarray(Welsch(2.0).weights(far) * far) < 1e-9)


@pytest.mark.parametrize("loss", LOSSES, ids=str)
def test_reweighting_lowers_the_robust_objective_to_a_stationary_point(loss: Loss):
    placed, _, _ = measured(liars=0.1)
    deviation = jnp.full(placed.value.shape, 0.02)
    term = accumulate(placed)

    def objective(image: jax.Array) -> jax.Array:
        return jnp.sum(placed.weight * loss.value(residuals(placed, term.blurred(image)) / deviation))

    image = solved(placed)
    values = [float(objective(image))]
    for _ in range(60):
        image = solved(placed, robust_factors(loss, placed, term.blurred(image), deviation=deviation))
        values.append(float(objective(image)))
    assert all(after <= before * (1 + 1e-12) for before, after in zip(values[:-1], values[1:], strict=True))
    assert values[-1] < values[0]
    start, end = (float(jnp.abs(jax.grad(objective)(at)).max()) for at in (solved(placed), image))
    assert end < 1e-3 * start


@pytest.mark.parametrize("loss", [Huber(), Welsch()], ids=str)
@pytest.mark.parametrize("known", [True, False])
def test_liars_lose_their_say(loss: Loss, known: bool):
    placed, truth, lies = measured(liars=0.1)
    term, image = accumulate(placed), solved(placed)
    deviation = jnp.full(placed.value.shape, 0.02) if known else None
    factors = jnp.ones_like(placed.value)
    for _ in range(10):
        factors = robust_factors(loss, placed, term.blurred(image), deviation=deviation)
        image = solved(placed, factors)
    assert np.mean(factors[lies]) < 0.2 and np.mean(factors[~lies]) > 0.9
    # A tenth lies by 0.5: the mean is off by 0.05; Huber lets a liar pull as much as 3 deviations, 0.06 · 0.1.
    assert float(jnp.abs(solved(placed) - truth).mean()) > 0.04
    assert float(jnp.abs(image - truth).mean()) < 0.012


def test_without_liars_hardly_anything_changes():
    placed, _, _ = measured()
    for loss in (Huber(), Welsch()):
        factors = robust_factors(loss, placed, accumulate(placed).blurred(solved(placed)))
        assert np.mean(factors) > 0.95


def test_samples_without_weight_do_not_count():
    placed, _, lies = measured(liars=0.4)
    silent = eqx.tree_at(lambda p: p.weight, placed, placed.weight * jnp.asarray(1.0 - lies))
    factors = robust_factors(Welsch(), silent, accumulate(silent).blurred(solved(silent)))
    assert np.all(np.isfinite(factors)) and np.mean(factors[~lies]) > 0.9
    np.testing.assert_array_equal(factors[lies], 1)


def test_no_noise_at_all():
    placed, _, _ = measured(noise=0.0)
    dark = eqx.tree_at(lambda p: p.value, placed, jnp.zeros_like(placed.value))
    factors = robust_factors(Huber(), dark, jnp.zeros((SIZE, SIZE)))
    np.testing.assert_array_equal(factors, 1)


@pytest.mark.parametrize("kind", [Huber, Welsch])
@pytest.mark.parametrize("threshold", [0, -1.0, float("nan")])
def test_thresholds_that_cannot_be(kind, threshold):
    with pytest.raises(InputError, match=f"{kind.__name__} was given the threshold .* above 0, in standard deviations"):
        kind(threshold)
