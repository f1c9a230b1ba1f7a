"""SpikeSR-Net as a whole: sizes, gradients, what can be left out of it, and that it learns."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from learned.networks.spikesr import Iterates, SpikeSRConfig, SpikeSRNet, parameter_count, spikesr_loss
from scsr_opt.errors import InputError

TINY = SpikeSRConfig.small(
    2,
    blocks=3,
    length=3,
    spacing=2,
    branches=(1, 3),
    encoder_channels=4,
    encoder_blocks=1,
    channels=4,
    proximal_channels=4,
    proximal_blocks=1,
    groups=1,
    working_scale=2,
    stages=2,
    share_stages=False,
)
SENSOR = (5, 7)  # odd, so that the halvings of the alignment do not divide it

# Of the generators this one compiles quickest.
build = eqx.filter_jit(lambda config: SpikeSRNet(config, key=jax.random.key(0, impl="unsafe_rbg")))
run = eqx.filter_jit(lambda net, spikes, *more: net(spikes, 4, 0.6, *more))


def shapes(config: SpikeSRConfig) -> SpikeSRNet:
    return eqx.filter_eval_shape(lambda: SpikeSRNet(config, key=jax.random.key(0)))


@eqx.filter_jit
def loss_and_slopes(net: SpikeSRNet, spikes: jax.Array, truth: jax.Array):
    return eqx.filter_value_and_grad(lambda n: spikesr_loss(n(spikes, 4, 0.6).images, truth))(net)


@pytest.fixture(scope="module")
def spikes() -> jax.Array:
    return jnp.asarray(np.random.default_rng(0).random((9, *SENSOR)) < 0.3)


@pytest.fixture(scope="module")
def truth() -> jax.Array:
    return jnp.asarray(np.random.default_rng(1).random((2 * SENSOR[0], 2 * SENSOR[1])), jnp.float32)


@pytest.fixture(scope="module")
def net() -> SpikeSRNet:
    return build(TINY)


@pytest.fixture(scope="module")
def one_stage() -> SpikeSRNet:
    """For gradients: those of two stages take twice as long to compile and hold nothing new."""
    return build(dataclasses.replace(TINY, stages=1))


@pytest.mark.parametrize(("scale", "working_scale"), [(1, 1), (2, 1), (2, 2), (3, 3), (4, 1), (4, 2)])
def test_every_scale_gives_a_picture_a_stage(scale: int, working_scale: int):
    config = dataclasses.replace(TINY, scale=scale, working_scale=working_scale)

    def pictures(spikes: jax.Array) -> Iterates:
        return SpikeSRNet(config, key=jax.random.key(0))(spikes, 4)

    found = eqx.filter_eval_shape(pictures, jnp.zeros((9, *SENSOR), jnp.uint8))
    for iterates in found:
        assert iterates.shape == (2, scale * SENSOR[0], scale * SENSOR[1]) and iterates.dtype == jnp.float32


def test_the_stages_follow_each_other(net: SpikeSRNet, spikes: jax.Array):
    """Encoder, X^(0) and Eq. 6 by hand; and a start that is given takes the place of X^(0)."""

    @eqx.filter_jit
    def by_hand(net: SpikeSRNet, spikes: jax.Array):
        seen = net.encode(spikes, 4, 0.6)
        first = net.initial(seen)
        step, image = net.stage(1)(first, seen.latent)
        return seen.base, first, (step, image), net.stage(2)(image, seen.latent)

    base, first, one, two = by_hand(net, spikes)
    found = run(net, spikes)
    # Intensities near 1 in float32, in another order of the same sums.
    for place, (step, image) in enumerate((one, two)):
        np.testing.assert_allclose(found.gradient_steps[place], step, atol=1e-5)
        np.testing.assert_allclose(found.images[place], image, atol=1e-5)
    frames = [1, 2, 3, 3, 4, 5, 5, 6, 7]  # three blocks of three, 2 apart, around frame 4
    rate = jnp.asarray(np.asarray(spikes)[frames].mean(0) / 0.6, jnp.float32)
    np.testing.assert_allclose(base, jax.image.resize(rate, base.shape, "cubic"), atol=1e-5)
    np.testing.assert_allclose(run(net, spikes, first).images, found.images, atol=1e-5)
    assert float(jnp.abs(run(net, spikes, first + 0.5).images - found.images).min()) > 0.1


def test_gradients_are_finite_and_reach_every_parameter(one_stage: SpikeSRNet, spikes: jax.Array, truth: jax.Array):
    """At the start all but the layers before the offset convolutions, which are zero so that alignment starts at none;
    away from the start all."""
    slopes = loss_and_slopes(one_stage, spikes, truth)[1]
    silent = 0
    for path, slope in jax.tree_util.tree_leaves_with_path(slopes):
        name = jax.tree_util.keystr(path)
        assert np.all(np.isfinite(slope)), name
        behind_zeros = ".coarser" in name or ".finer" in name
        silent += behind_zeros
        assert bool(jnp.any(slope != 0)) != behind_zeros, name
    assert silent == 12  # weights and biases of two layers, in the initialisation and both alignments of the stage

    rng = np.random.default_rng(2)
    moved = jax.tree.map(lambda x: x + jnp.asarray(0.1 * rng.standard_normal(x.shape), x.dtype), one_stage)
    for path, slope in jax.tree_util.tree_leaves_with_path(loss_and_slopes(moved, spikes, truth)[1]):
        assert np.all(np.isfinite(slope)) and np.any(slope != 0), jax.tree_util.keystr(path)


def test_a_step_of_adam_lowers_the_loss(one_stage: SpikeSRNet, spikes: jax.Array, truth: jax.Array):
    optimiser = optax.adam(1e-3)
    loss, slopes = loss_and_slopes(one_stage, spikes, truth)
    with jax.numpy_dtype_promotion("standard"):  # optax counts its steps in integers
        updates, _ = jax.jit(lambda s: optimiser.update(s, optimiser.init(s)))(slopes)
    assert loss_and_slopes(eqx.apply_updates(one_stage, updates), spikes, truth)[0] < loss


def test_calculating_again_gives_the_same_gradient(one_stage: SpikeSRNet, spikes: jax.Array, truth: jax.Array):
    again = build(dataclasses.replace(TINY, stages=1, rematerialise=True))  # the same weights: the key is the same
    loss, slopes = loss_and_slopes(one_stage, spikes, truth)
    other_loss, other_slopes = loss_and_slopes(again, spikes, truth)
    assert float(other_loss) == pytest.approx(float(loss), rel=1e-5)
    for one, other in zip(jax.tree.leaves(slopes), jax.tree.leaves(other_slopes), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)


def test_shared_stages_are_equal_stages(spikes: jax.Array):
    config = dataclasses.replace(TINY, working_scale=1)
    shared = build(dataclasses.replace(config, share_stages=True))
    twice = jax.tree.map(lambda x: jnp.concatenate([x, x]), shared.stages)
    repeated = eqx.tree_at(lambda n: n.stages, build(config), twice)
    assert parameter_count(repeated) > parameter_count(shared)
    np.testing.assert_allclose(run(repeated, spikes).images, run(shared, spikes).images, atol=1e-5)


@pytest.mark.parametrize(
    "part",
    ["pase", pytest.param("gradient", marks=pytest.mark.slow), pytest.param("alignment", marks=pytest.mark.slow),
     "proximal"],
)  # fmt: skip
def test_each_part_can_be_left_out(part: str, spikes: jax.Array):
    config = dataclasses.replace(TINY, stages=1, working_scale=1)
    without = dataclasses.replace(config, **{part: False})
    assert parameter_count(shapes(without)) < parameter_count(shapes(config))
    found = run(build(without), spikes)
    assert np.all(np.isfinite(found.images))
    if part == "proximal":
        np.testing.assert_array_equal(found.images, found.gradient_steps)


def test_sizes():
    """The published network has 3.34 M parameters; small ones have at most 0.4 M."""
    for scale in (2, 4):
        assert parameter_count(shapes(SpikeSRConfig.full(scale))) == pytest.approx(3.34e6, rel=0.05)
        assert parameter_count(shapes(SpikeSRConfig.small(scale))) <= 0.4e6
    assert parameter_count({"a": jnp.zeros((2, 3)), "b": jnp.zeros(4, jnp.int32)}) == 6


def test_the_loss_by_hand():
    truth = jnp.zeros((2, 2))
    images = jnp.stack([jnp.full((2, 2), v) for v in (1.0, -2.0, 3.0)])
    assert float(spikesr_loss(images, truth)) == pytest.approx(0.1 * (1 + 2) + 3)
    assert float(spikesr_loss(images[:1], truth)) == pytest.approx(1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scale": 0}, "scale is 0"),
        ({"working_scale": 3}, "working_scale is 3"),
        ({"groups": 3}, "groups is 3"),
        ({"stages": 0}, "stages is 0"),
        ({"levels": -1}, "levels is -1"),
        ({"blocks": 2}, "odd"),
        ({"length": 0}, "length 0"),
        ({"branches": (2,)}, "odd"),
        ({"gradient": False, "proximal": False}, "leave out one only"),
    ],
)
def test_sizes_that_cannot_be(changes, message):
    with pytest.raises(InputError, match=message):
        dataclasses.replace(TINY, **changes)


def test_calls_that_cannot_be(net: SpikeSRNet, spikes: jax.Array):
    with pytest.raises(InputError, match="has 2 frames"):
        net(spikes[:2], 0)
    with pytest.raises(InputError, match="start has shape"):
        net(spikes, 4, 0.6, jnp.zeros(SENSOR))
    with pytest.raises(InputError, match="no stage 3"):
        net.stage(3)
