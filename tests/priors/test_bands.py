"""Proximal steps of large pictures by bands of rows: the same picture."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.priors import HuberTotalVariation, TotalVariation, bands

PRIORS = [HuberTotalVariation(), HuberTotalVariation(iterations=2), TotalVariation(), TotalVariation(isotropic=False)]

pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.mark.parametrize("prior", PRIORS, ids=lambda prior: f"{type(prior).__name__} {prior.iterations}")
@pytest.mark.parametrize("shape", [(97, 31), (200, 8)])
def test_bands_of_rows_give_what_the_whole_gives(prior, shape, monkeypatch):
    keys = jax.random.split(jax.random.key(3), 2)
    image, before = (jax.random.uniform(key, shape) for key in keys)
    _, state = prior.prox(before, 0.1, prior.initial_state(before))
    whole = prior.prox(image, 0.1, state)
    seen = []

    def watched(image, strength, state, nearest):
        seen.append(image.shape[0])
        return within(image, strength, state, nearest)

    within = prior.prox_within
    monkeypatch.setattr(type(prior), "prox_within", lambda self, *arguments: watched(*arguments))
    monkeypatch.setattr(bands, "_PIXELS", image.size // 4)
    banded = prior.prox(image, 0.1, state)
    assert max(seen) < shape[0]  # it was cut
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(banded), strict=True):
        # The same operations, but compiled for other shapes: a rounding or two of numbers up to 1.
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_bands_can_be_differentiated(monkeypatch):
    prior = HuberTotalVariation()
    image = jax.random.uniform(jax.random.key(0), (60, 10))
    state = prior.initial_state(image)

    def total(strength):
        return jnp.sum(prior.prox(image, strength, state)[0] ** 2)

    whole = jax.grad(total)(0.1)
    monkeypatch.setattr(bands, "_PIXELS", 150)
    assert jax.grad(total)(0.1) == pytest.approx(float(whole), rel=1e-4)
