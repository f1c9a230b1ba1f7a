"""A prior about a picture that is at hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt import InputError, reconstruct
from scsr_opt.priors import Bounded, Centred, HuberTotalVariation, RidgeRegulariser, TotalVariation

PRIORS = {"tv": TotalVariation(iterations=2000), "huber": HuberTotalVariation(), "ridge": RidgeRegulariser.load()}


def pictures(shape=(9, 11)):
    return (jnp.asarray(np.random.default_rng(seed).random(shape), jnp.float32) for seed in (0, 1))


@pytest.mark.parametrize("name", PRIORS)
def test_what_is_at_the_centre_costs_nothing(name):
    centre, image = pictures()
    prior = Centred(PRIORS[name], centre)
    assert float(prior.value(centre)) == 0
    assert float(prior.value(image)) == pytest.approx(float(PRIORS[name].value(image - centre)))
    found, state = prior.prox(centre, 0.3, prior.initial_state(centre))
    np.testing.assert_allclose(found, centre, atol=1e-6)
    assert float(prior.value_after(found, state)) == pytest.approx(0, abs=1e-4)


def test_proximal_step_against_admm(double, oracle):
    f = oracle.picture()
    centre = np.random.default_rng(3).random(f.shape)
    blocks = [(np.vstack(oracle.differences(f.shape)), oracle.soft_vectors(0.1, 2))]
    expected = centre + oracle.solve(f - centre, 0, blocks).reshape(f.shape)
    prior, given = Centred(TotalVariation(iterations=3000), centre), jnp.asarray(f)
    found, _ = prior.prox(given, 0.1, prior.initial_state(given))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)


def test_bounds_go_outside():
    centre, image = pictures()
    prior = Bounded(Centred(HuberTotalVariation(), 2 * centre), 0, 0.7)
    found, _ = prior.prox(image, 0.1, prior.initial_state(image))
    assert float(found.min()) >= 0 and float(found.max()) <= np.float32(0.7)


def test_eq_4_about_a_picture():
    """The objective falls, and much of the prior keeps the picture at the centre."""
    spikes = (np.random.default_rng(0).random((41, 10, 12)) < 0.3).astype(np.uint8)
    centre = np.full((20, 24), 0.4, np.float32) + 0.1 * np.indices((20, 24)).sum(0) % 0.2
    found = {
        strength: reconstruct(spikes, scale=2, prior=Centred(RidgeRegulariser.load(), centre), strength=strength)
        for strength in (1e-4, 1.0)
    }
    for solution in found.values():
        objectives = np.array([stage.objective for stage in solution.stages])
        assert solution.status.usable and (np.diff(objectives) <= 1e-5 * objectives[0]).all()
    near, far = (float(np.ptp(found[strength].image - centre)) for strength in (1.0, 1e-4))
    assert near < 0.02 < far


def test_what_is_refused():
    centre, image = pictures()
    with pytest.raises(InputError, match=r"a prior that is Bounded, .* Bounded\(Centred"):
        Centred(Bounded(HuberTotalVariation()), centre)
    with pytest.raises(InputError, match="1 values that are not finite"):
        Centred(HuberTotalVariation(), centre.at[0, 0].set(jnp.nan))
    with pytest.raises(InputError, match="a centre of shape \\(3,\\)"):
        Centred(HuberTotalVariation(), np.array([1, 2, 3]))
    with pytest.raises(InputError, match=r"a centre of shape \(1, 11\), but the picture has shape \(9, 11\)"):
        Centred(HuberTotalVariation(), centre[:1]).value(image)
    with pytest.raises(InputError, match=r"a centre of shape \(9, 11\), but the picture has shape \(8, 11\)"):
        Centred(HuberTotalVariation(), centre).initial_state(image[1:])
    spikes = np.ones((5, 6, 7), np.uint8)
    with pytest.raises(InputError, match="Centred has no relative_strength by which it could be found"):
        reconstruct(spikes, scale=2, prior=Centred(HuberTotalVariation(), np.zeros((12, 14))))
