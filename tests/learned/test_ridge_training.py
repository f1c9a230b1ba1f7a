"""Training of ridge regularisers: whatever is learned is a prior with its bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learned.training.ridge import RidgeTraining, bend, initial, parts, pictures, train
from scsr_opt.errors import InputError
from scsr_opt.priors import RidgeRegulariser
from scsr_opt.priors.ridge_regulariser import bank_norm_squared, profile_and_derivative


@pytest.mark.parametrize("weakly", [False, True])
def test_any_parameters_give_a_valid_prior(weakly):
    run = RidgeTraining(weakly=weakly)
    θ = jax.tree.map(lambda v: 2 * v, initial(np.random.default_rng(3), run))
    filters, knots, slopes = parts(θ, run)
    prior = RidgeRegulariser(filters, knots, slopes)
    least = run.weakest if weakly else 0
    assert -least <= float(prior.slopes.min()) and float(prior.slopes.max()) <= 1
    # The bank is divided by its norm on 32 frequencies a side: 1/cos²(6π/32) above it at most, and not below.
    assert 0.999 <= bank_norm_squared(np.asarray(filters, np.float64)) <= 1 / np.cos(6 * np.pi / 32) ** 2 * 1.03


def test_bend_is_the_derivative_of_the_spline():
    prior = RidgeRegulariser.load("weakly_convex")
    shape = (len(prior.filters), 4, 4)
    field = jnp.asarray(np.random.default_rng(8).normal(scale=0.05, size=shape), jnp.float32)

    def derivative(field: jax.Array) -> jax.Array:
        return profile_and_derivative(prior.knots, prior.slopes, field)[1]

    _, slope = jax.jvp(derivative, (field,), (jnp.ones_like(field),))
    np.testing.assert_allclose(bend(prior.knots, prior.slopes, field), slope, rtol=1e-4, atol=1e-4 * prior.curvature)


def test_pictures_come_from_a_folder_or_from_scikit_image(tmp_path):
    assert all(p.ndim == 2 and 0 <= p.min() and p.max() <= 1 for p in pictures(None))
    with pytest.raises(InputError, match="no picture"):
        pictures(tmp_path)


@pytest.mark.slow
def test_training_lowers_the_error(tmp_path):
    lines: list[str] = []
    prior = train(tmp_path / "p.npz", folder=None, minutes=2.0, report=lines.append)
    assert prior.concavity == 0
    scores = [float(line.split("s: ")[1].split(" dB")[0]) for line in lines]
    assert scores[-1] > scores[0] + 0.3
