"""How strong a prior is beside total variation: what an edge costs."""

import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.priors import (
    RED,
    BilateralTotalVariation,
    Bounded,
    HuberTotalVariation,
    PlugAndPlay,
    TotalGeneralizedVariation,
    TotalVariation,
    WaveletL1,
    bilateral,
)


@pytest.mark.parametrize(
    "prior",
    [
        HuberTotalVariation(),
        TotalGeneralizedVariation(),
        WaveletL1(1),
        WaveletL1(2),
        WaveletL1(3),
        BilateralTotalVariation(),
        BilateralTotalVariation(1, 1.0),
        BilateralTotalVariation(3, 0.5),
        Bounded(WaveletL1(2)),
    ],
    ids=lambda prior: f"{type(prior).__name__}",
)
def test_a_disc_costs_as_much_by_every_prior(prior):
    """Edges of all directions, straight beside the priors' reach. The formulas leave out how total variation counts an
    oblique edge on the grid, and the wavelet's bands across both axes: together less than a fifth."""
    y, x = np.mgrid[-40:41, -40:41]
    disc = jnp.asarray(np.clip(25.5 - np.hypot(y, x), 0, 1), jnp.float32)
    usual = TotalVariation().value(disc)
    assert float(prior.relative_strength * prior.value(disc) / usual) == pytest.approx(1, abs=0.2)


def test_denoisers_are_another_matter():
    assert PlugAndPlay(bilateral()).relative_strength is None
    assert Bounded(PlugAndPlay(bilateral())).relative_strength is None
    assert RED(bilateral(), sigma=0.05).relative_strength == pytest.approx(30)
