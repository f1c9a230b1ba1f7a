"""A network for one scale as the start of one for another."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learned.networks.rescaling import rescaled
from learned.networks.spikesr import SpikeSRConfig, SpikeSRNet
from learned.training import checkpoint
from scsr_opt.errors import InputError

TINY = SpikeSRConfig.full(
    2, blocks=1, length=3, branches=(1,), encoder_channels=2, encoder_blocks=0, channels=2, proximal_channels=3,
    degradation_blocks=0, refinement_blocks=0, proximal_blocks=0, groups=1, levels=0, stages=1,
)  # fmt: skip


def net(scale: int, key: int = 0, **changes: int) -> SpikeSRNet:
    config = dataclasses.replace(TINY, scale=scale, working_scale=scale, **changes)
    return SpikeSRNet(config, key=jax.random.key(key))


@pytest.fixture(scope="module")
def pair() -> tuple[SpikeSRNet, SpikeSRNet]:
    two = net(2)
    flat = eqx.tree_at(
        lambda n: [getattr(n.stages.gradient, name).weight for name in ("up", "residual_up", "down")],
        two,
        replace_fn=lambda kernel: jnp.broadcast_to(kernel.mean((-2, -1), keepdims=True), kernel.shape),
    )
    return flat, rescaled(flat, net(4, key=1))


def test_layers_that_do_not_depend_on_the_scale_are_the_same(pair):
    two, four = pair
    for part in (lambda n: n.encoder, lambda n: n.stages.proximal, lambda n: n.stages.gradient.fusion):
        assert eqx.tree_equal(part(two), part(four))


def test_a_constant_keeps_its_mean(pair):
    two, four = (n.stage(1).gradient for n in pair)
    for name in ("up", "residual_up"):
        one = jnp.ones((1, 9, 9))
        a, b = (getattr(g, name)(one)[:, 4 * s : 5 * s, 4 * s : 5 * s].mean((1, 2)) for g, s in ((two, 2), (four, 4)))
        np.testing.assert_allclose(a, b, rtol=1e-5)
    a, b = (g.down(jnp.ones((2, 6 * s, 6 * s)))[:, 3, 3] for g, s in ((two, 2), (four, 4)))
    np.testing.assert_allclose(a, b, rtol=1e-5)


def test_a_pixel_has_the_weights_of_the_one_at_its_place(pair):
    two, four = (n.initialisation.output.bias[:, 0, 0] for n in pair)
    np.testing.assert_array_equal(four.reshape(4, 4), jnp.repeat(jnp.repeat(two.reshape(2, 2), 2, 0), 2, 1))


def test_other_sizes_are_refused():
    with pytest.raises(InputError, match="A network for ×2 has weights of shape"):
        rescaled(net(2), net(4, proximal_channels=4))


def test_training_starts_from_another_scale(tmp_path, monkeypatch, pair):
    two, four = pair
    card = checkpoint.Card("spikesr", {"scale": 2, "network": {}}, "none", 1, "none", {})
    monkeypatch.setattr(checkpoint, "load", lambda path: (two, card))
    assert eqx.tree_equal(checkpoint.grafted(net(4, key=1), str(tmp_path / "two.scsr"))[0], four)
