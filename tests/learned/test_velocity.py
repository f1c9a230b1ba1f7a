"""One velocity per pixel: its directions, what is made with it, and that it is learned from the true motion."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learned.networks.compensation import compensated
from learned.networks.encoder import block_times
from learned.networks.spikesr import SpikeSRConfig, SpikeSRNet, spikesr_loss
from learned.networks.velocity import (
    Moments,
    VelocityConfig,
    VelocityNet,
    base_moments,
    interval_rates,
    refined,
    velocity_loss,
)
from learned.training.data import Examples, Pictures, turned_field
from scsr_opt.errors import InputError

GRAVEL = Pictures.samples(("gravel",))  # texture everywhere
enlarged = jax.jit(
    lambda spikes, rate, velocity: compensated(base_moments(spikes, spikes.shape[0] // 2, rate, 13), velocity, 2).mean
)


refine = jax.jit(refined)
# Of the generators this one compiles quickest.
make_net = eqx.filter_jit(lambda: VelocityNet(4, key=jax.random.key(0, impl="unsafe_rbg")))


def error(example, velocity) -> float:
    made = np.asarray(enlarged(example.spikes, example.white_rate, jnp.asarray(velocity)))
    return float(np.abs(made - example.truth)[16:-16, 16:-16].mean())


@pytest.mark.parametrize("scene", ["translation", "affine"])
@pytest.mark.parametrize("number", range(8))
def test_moments_read_where_the_velocity_says_show_the_key_frame(scene, number):
    """In examples that are turned and flipped, each in its own way: all other directions are worse."""
    example = Examples(2, 41, 32, scenes=(scene,), lights=("day",), pictures=GRAVEL)[number]
    down, right = example.velocity
    true = error(example, example.velocity)
    others = [(-down, -right), (right, down), (down, -right), (-down, right), (0 * down, 0 * right)]
    for other in others:
        if np.abs(np.stack(other) - example.velocity).mean() > 0.02:
            assert true < error(example, np.stack(other))


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("turns", range(4))
def test_arrows_turn_with_the_picture(turns, flipped):
    """An arrow from a mark to another still joins the two when the picture has been turned."""
    marks, start, arrow = np.zeros((9, 9)), (2, 3), (4, -1)
    marks[start], marks[start[0] + arrow[0], start[1] + arrow[1]] = 1, 2
    field = np.broadcast_to(np.array(arrow, float)[:, None, None], (2, 9, 9)) * (marks == 1)
    turned = np.rot90(marks, turns)
    turned = turned[:, ::-1] if flipped else turned
    place = np.argwhere(turned == 1)[0]
    found = turned_field(field, turns, flipped)[:, place[0], place[1]]
    assert (np.argwhere(turned == 2)[0] - place).tolist() == found.tolist()


def test_examples_know_their_velocity():
    pan = Examples(2, 11, 16, scenes=("translation",), pictures=GRAVEL)[1].velocity
    assert pan.dtype == np.float32 and 0.05 <= np.hypot(*pan[:, 0, 0]) <= 0.3 and np.ptp(pan, axis=(1, 2)).max() == 0
    assert not Examples(2, 11, 16, scenes=("static",), pictures=GRAVEL)[0].velocity.any()
    assert np.isnan(Examples(2, 11, 16, scenes=("video",), pictures=GRAVEL)[0].velocity).all()


def test_intervals_by_hand():
    spikes = np.zeros((10, 1, 5), np.uint8)
    for pixel, frames in enumerate(([2, 5, 9], [4], [], range(10), [0, 1, 7])):
        spikes[list(frames), 0, pixel] = 1
    lengths = [
        [3, 3, 3, 3, 3, 3, 4, 4, 4, 4],
        [5, 5, 5, 5, 5, 6, 6, 6, 6, 6],  # one spike: what is seen on either side of it
        [11] * 10,
        [1] * 10,
        [1, 1, 6, 6, 6, 6, 6, 6, 6, 6],  # the last one is at least as long as the one before
    ]
    found = interval_rates(jnp.asarray(spikes))
    np.testing.assert_allclose(1 / np.asarray(found)[:, 0].T, lengths, rtol=1e-6)
    seen = base_moments(jnp.asarray(spikes), 4, 0.5, 3)
    np.testing.assert_allclose(seen.rates[:, 0, 0], [2 / 3, 2 / 3, 1 / 2], rtol=1e-6)
    assert seen.times.tolist() == [-3, 0, 3]


def test_times_follow_the_blocks():
    assert block_times(41, 20, 5, 13, 7).tolist() == [-14, -7, 0, 7, 14]
    assert block_times(41, 2, 3, 5, 4).tolist() == [0, 0, 4]  # moved inwards where the recording begins
    assert block_times(9, 4, 3, 4, 2).tolist() == [-2.5, -0.5, 1.5]


def test_the_loss_by_hand():
    truth = jnp.array([[[0.1, jnp.nan]], [[-0.2, jnp.nan]]])
    found = jnp.array([[[0.2, 9.0]], [[0.1, 9.0]]])
    assert float(velocity_loss(found, truth)) == pytest.approx((0.1 + 0.3) / 2)
    slope = jax.grad(velocity_loss)(found, truth)
    np.testing.assert_allclose(slope, [[[0.5, 0]], [[0.5, 0]]])
    assert float(velocity_loss(found, jnp.full_like(truth, jnp.nan))) == 0


@pytest.mark.parametrize("seed", [0, 1])
def test_the_sweep_finds_a_velocity_before_it_has_learned(seed):
    """Nearer than none to that of a texture that pans; learning is what makes it exact."""
    example = Examples(2, 41, 24, seed=seed, scenes=("translation",), lights=("day",), pictures=GRAVEL)[0]
    estimator = make_net().velocity
    found = np.asarray(eqx.filter_jit(estimator)(jnp.asarray(example.spikes), 20, jnp.asarray(example.white_rate)))
    inner = (slice(None), slice(6, -6), slice(6, -6))
    truth = example.velocity[inner]
    assert np.abs(found).max() <= estimator.search.fastest
    assert np.sum(found[inner] * truth) > 0.25 * np.sum(truth**2)


def test_it_learns_the_true_motion(overfitted):
    example = Examples(2, 41, 20, seed=2, scenes=("translation",), lights=("day",), pictures=GRAVEL)[0]
    spikes, rate, truth = (jnp.asarray(part) for part in (example.spikes, example.white_rate, example.velocity))

    def loss_and_slopes(net):
        def loss(n):
            return velocity_loss(n.velocity(spikes, 20, rate), truth)

        return eqx.filter_value_and_grad(loss)(net)

    losses = overfitted(make_net(), loss_and_slopes, 25)
    assert losses[-1] < 0.25 * losses[0]


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize("scene", ["translation", "affine"])
def test_an_estimate_that_is_near_is_made_exact(scene, number):
    """Off by 0.03 pixels per frame, half a pixel at the ends; where there is texture little of it is left."""
    example = Examples(2, 63, 32, scenes=(scene,), lights=("day",), pictures=GRAVEL)[number]
    seen = base_moments(jnp.asarray(example.spikes), 31, jnp.asarray(example.white_rate), 21)
    off = jnp.asarray(example.velocity) + jnp.array([0.03, -0.02])[:, None, None]
    found = np.asarray(refine(seen, off))[:, 8:-8, 8:-8] - example.velocity[:, 8:-8, 8:-8]
    assert np.abs(found).mean() < 0.006


def test_without_texture_the_velocity_around_is_kept():
    seen = Moments(jnp.full((3, 9, 9), 0.4), jnp.array([-3.0, 0.0, 3.0]))
    found = refine(seen, jnp.full((2, 9, 9), 0.1).at[1].set(-0.2))
    np.testing.assert_allclose(found, np.broadcast_to([[[0.1]], [[-0.2]]], (2, 9, 9)), atol=1e-6)


SIZES = dict(
    blocks=1, length=3, spacing=2, gradient=False, branches=(1,), encoder_channels=2, encoder_blocks=0, channels=2,
    groups=1, proximal_channels=2, proximal_blocks=0, stages=1, moments=3,
)  # fmt: skip


def test_pictures_do_not_teach_the_velocity_and_the_rest_is_the_same_network():
    plain = SpikeSRConfig.small(2, **SIZES)
    guided = dataclasses.replace(plain, velocity_channels=2, deblur_channels=2)
    build = eqx.filter_jit(lambda config: SpikeSRNet(config, key=jax.random.key(0, impl="unsafe_rbg")))
    nets = [build(config) for config in (plain, guided)]
    other = eqx.tree_at(lambda n: (n.velocity, n.deblurring), nets[1], (None, None))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(other), jax.tree.leaves(nets[0]), strict=True))
    spikes = jnp.asarray(np.random.default_rng(0).random((9, 8, 9)) < 0.4)

    @eqx.filter_jit
    def slopes(net):
        def loss(n):
            return spikesr_loss(n(spikes, 4, 0.6).images, jnp.zeros((16, 18)))

        return eqx.filter_grad(loss)(net)

    found = slopes(nets[1])
    assert not any(leaf.any() for leaf in jax.tree.leaves(found.velocity))
    assert found.initialisation.align.mix.weight.any() and found.deblurring.output.weight.any()


def test_sizes_that_cannot_be():
    with pytest.raises(InputError, match="channels is 0"):
        VelocityConfig(channels=0)
    with pytest.raises(InputError, match="odd"):
        VelocityConfig(moments=4)
    with pytest.raises(InputError, match="velocity_channels is -1"):
        SpikeSRConfig.small(2, velocity_channels=-1)
    with pytest.raises(InputError, match="deblur_channels is 4, but velocity_channels is 0"):
        SpikeSRConfig.small(2, deblur_channels=4)
