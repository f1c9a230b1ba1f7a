"""Moments brought to the key frame, by hand; and what sharpens them: starts as no change, hears motion and light."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learned.networks.compensation import CompensationConfig, Deblurring, base_loss, compensated
from learned.networks.velocity import Moments, moments
from learned.training.data import Example
from learned.training.registry import trainable
from scsr_opt.errors import InputError

together = jax.jit(compensated, static_argnames="scale")
sharpened = eqx.filter_jit(lambda layers, *given: layers(*given))


def test_without_motion_the_mean_is_enlarged():
    rng = np.random.default_rng(0)
    seen = moments(jnp.asarray(rng.random((9, 7, 8)) < 0.4), 4, 0.5, count=3, length=3, spacing=3)
    assert seen.times.tolist() == [-3, 0, 3]
    found = together(seen, jnp.zeros((2, 7, 8)), 3).mean
    wanted = jax.image.resize(jnp.mean(seen.rates, axis=0), (21, 24), "cubic")
    # Outside the sensor the edge is repeated here, left out there.
    np.testing.assert_allclose(found[6:-6, 6:-6], wanted[6:-6, 6:-6], atol=1e-5)


def test_what_has_left_the_sensor_is_left_out():
    rates = jnp.stack([jnp.full((6, 6), value) for value in (0.0, 1.0)])
    seen = moments(jnp.zeros((3, 6, 6), jnp.uint8), 1, 1.0, count=1, length=3, spacing=1)
    seen = seen._replace(rates=rates, times=jnp.array([0.0, 10.0]))
    found = together(seen, jnp.full((2, 6, 6), 0.31).at[1].set(0.0), 1).mean
    np.testing.assert_allclose(found[:2], 0.5, atol=1e-6)
    np.testing.assert_array_equal(found[3:], 0)


def test_near_samples_by_hand():
    """At ×2 and at rest a pixel's middle is a quarter of a pixel away from its four points, along either axis."""
    rates = jnp.asarray(np.random.default_rng(0).random((1, 5, 6)), jnp.float32)
    found = together(Moments(rates, jnp.zeros(1)), jnp.zeros((2, 5, 6)), 2)
    away = np.array([0.25, 0.75]) ** 2
    weights = np.exp(-0.5 * (away[:, None] + away[None, :]) / 0.2**2)
    four = np.asarray(rates[0, 1:3, 1:3])  # around the point at row 1.25, column 1.25
    np.testing.assert_allclose(found.nearness[3, 3], weights.sum(), rtol=1e-5)
    np.testing.assert_allclose(found.near[3, 3], (weights * four).sum() / weights.sum(), rtol=1e-5)


def test_near_samples_follow_the_motion():
    """Half a pixel down the edge's sample would count twice if its repetition did; 30 frames later all have left."""
    rates = jnp.asarray(np.random.default_rng(0).random((3, 5, 6)), jnp.float32)
    velocity = jnp.full((2, 5, 6), 1.0).at[1].set(0.0)
    found = together(Moments(rates, jnp.array([0.0, 1.0, 30.0])), velocity, 1)
    np.testing.assert_allclose(found.nearness[:4, 1:5], 2, atol=1e-4)  # the point itself, twice
    np.testing.assert_allclose(found.near[2, 2], (rates[0, 2, 2] + rates[1, 3, 2]) / 2, rtol=1e-4)
    np.testing.assert_allclose(found.nearness[4], 1, atol=1e-4)
    np.testing.assert_allclose(found.way[:, 2, 2], [30, 0])


def test_the_nearest_moment_reaches_beyond_the_edge():
    """With the key frame at an end no moment is at it, and a motion outwards would leave nothing."""
    found = together(Moments(jnp.full((1, 4, 5), 0.3), jnp.array([-1.0])), jnp.full((2, 4, 5), 0.4), 4)
    np.testing.assert_allclose(found.mean, 0.3, rtol=1e-5)


def test_moments_that_are_the_same_count_once():
    rates = jnp.asarray(np.random.default_rng(1).random((3, 5, 6)), jnp.float32)
    times, velocity = jnp.array([0.0, 3.0, 6.0]), jnp.full((2, 5, 6), 0.1)
    twice = Moments(rates[jnp.array([0, 0, 1, 2, 2])], times[jnp.array([0, 0, 1, 2, 2])])
    for once, other in zip(together(Moments(rates, times), velocity, 2), together(twice, velocity, 2), strict=True):
        np.testing.assert_allclose(other, once, atol=1e-6)


@pytest.mark.parametrize("light", [1.3, 50.0])
def test_bright_light_has_no_spread_of_its_own(light):
    found = together(Moments(jnp.full((21, 4, 5), light), jnp.arange(21.0)), jnp.full((2, 4, 5), 0.03), 2)
    assert found.spread.max() < 1e-5 * light


def test_spread_is_that_of_the_moments():
    rates = np.random.default_rng(1).random((7, 4, 5)).astype(np.float32)
    found = together(Moments(jnp.asarray(rates), jnp.arange(7.0)), jnp.zeros((2, 4, 5)), 1)
    np.testing.assert_allclose(found.mean, rates.mean(0), rtol=1e-5)
    np.testing.assert_allclose(found.spread, rates.std(0), rtol=1e-4)


@functools.cache
def layers() -> Deblurring:
    return Deblurring(2, key=jax.random.key(0, impl="unsafe_rbg"))


def seen(speed: float):
    rates = np.random.default_rng(2).random((3, 6, 7)).astype(np.float32)
    return together(Moments(jnp.asarray(rates), jnp.array([-3.0, 0.0, 3.0])), jnp.full((2, 6, 7), speed), 2)


def test_sharpening_starts_as_no_change():
    given = seen(0.1)
    np.testing.assert_array_equal(sharpened(layers(), given, 0.6), given.mean)


@pytest.mark.parametrize("change", ["way", "spread", "nearness", "near", "white_rate"])
def test_sharpening_hears(change):
    """Each input that a picture is sharpened by changes the result, which stays finite at its extremes."""
    some = eqx.tree_at(lambda n: n.output.weight, layers(), replace_fn=lambda w: w + 0.1)
    given, white_rate = seen(0.1), jnp.float32(0.6)
    before = sharpened(some, given, white_rate)
    for factor in (0.0, 1e6):
        if change == "white_rate":
            after = sharpened(some, given, white_rate * factor + 1e-6)
        else:
            after = sharpened(some, given._replace(**{change: getattr(given, change) * factor}), white_rate)
        assert np.isfinite(after).all() and np.abs(after - before).max() > 1e-4


def test_it_learns_to_sharpen():
    """A few steps downhill, each as long for every weight, on one picture."""
    given = seen(0.1)
    truth = 2 * given.mean - given.near
    learning = eqx.filter_jit(
        eqx.filter_value_and_grad(lambda net: base_loss(net(given, 0.6), truth)),
    )
    net = layers()
    first, slope = learning(net)
    loss = first
    for _ in range(20):
        net = eqx.apply_updates(net, jax.tree.map(lambda leaf: -0.01 * jnp.sign(leaf), slope))
        loss, slope = learning(net)
    assert loss < 0.9 * first and all(jnp.isfinite(leaf).all() and leaf.any() for leaf in jax.tree.leaves(slope))


def test_it_can_be_trained_alone():
    task = trainable("compensation", 2, {"velocity_channels": 2, "deblur_channels": 2, "moments": 3})
    net = eqx.filter_eval_shape(task.build, jax.random.key(0))
    example = Example(*(jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in [
        ((9, 8, 9), jnp.uint8), ((16, 18), jnp.float32), ((), jnp.float32), ((2, 8, 9), jnp.float32),
    ]))  # fmt: skip
    assert eqx.filter_eval_shape(task.picture, net, example.spikes, example.white_rate).shape == (16, 18)
    assert eqx.filter_eval_shape(task.loss, net, example).shape == ()


def test_sizes_of_the_part_that_cannot_be():
    with pytest.raises(InputError, match="deblur_channels is 0"):
        CompensationConfig(2, deblur_channels=0)
    with pytest.raises(InputError, match="odd"):
        CompensationConfig(2, moments=4)
