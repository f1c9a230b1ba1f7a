"""Pictures are the true ones here, so that what is measured is the motion's half of the alternation alone."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from scsr_opt.camera.samples import Samples, spike_intervals
from scsr_opt.errors import InputError
from scsr_opt.motion.estimators.parametric import generators
from scsr_opt.motion.trajectory import Layers, Motion, trajectory_of
from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.sampling import PlacedSamples, place
from scsr_opt.pipeline.motion_refinement import refine

SCALE, KEY, SIDE = 2, 50, 100


def placed(samples: Samples, motion: Motion) -> PlacedSamples:
    path = trajectory_of(motion, key=KEY, start=0, stop=101)
    return place(samples, path, scale=SCALE, shape=(SCALE * SIDE, SCALE * SIDE))


@pytest.fixture
def given(recording):
    """(B X, samples, true motion) of a scene by its name."""

    @cache
    def one(name: str) -> tuple[jax.Array, Samples, Motion]:
        made = recording(name)
        samples = jax.tree.map(jnp.asarray, spike_intervals(made.spikes, shortest=4).padded())
        truth = jnp.asarray(made.truth(KEY), jnp.float32)
        return Aperture((SCALE * SIDE, SCALE * SIDE), SCALE)(truth), samples, Motion.of_velocity(made.velocity(KEY))

    return one


def refined(motion: Motion, picture: jax.Array, samples: Samples, times: int = 1) -> Motion:
    for _ in range(times):
        motion = refine(motion, picture, samples, placed(samples, motion), key=KEY)
    return motion


def worst(found: Motion, true: Motion) -> float:
    """Largest error of the velocity over 50 frames, HR pixels."""
    return SCALE * 50 * float(np.hypot(*(found.velocity - true.velocity)).max())


# The wrong numbers are off by 1 HR px at the recording's ends; 0.05 is what `parametric` reaches in daylight.
def test_a_translation_is_found_from_a_pixel_off(given):
    picture, samples, true = given("translate0.3")
    wrong = Motion.of_velocity(true.velocity + np.array([0.01, -0.008])[:, None, None])
    assert worst(wrong, true) > 1
    found = refined(wrong, picture, samples, times=2)
    assert worst(found, true) < 0.05
    # Numbers that were 0 stay 0.
    assert np.ptp(found.velocity, axis=(1, 2)).max() == 0 and not found.acceleration.any()
    assert found.velocity.dtype == np.float32


def test_refinement_does_not_depend_on_jax_being_in_double_precision(given):
    picture, samples, true = given("translate0.3")
    wrong = Motion.of_velocity(true.velocity + np.array([0.01, -0.008], np.float32)[:, None, None])
    single = refined(wrong, picture, samples)
    places = placed(samples, wrong)
    with jax.enable_x64(True):
        double = refine(wrong, picture, samples, places, key=KEY)
    assert double.velocity.dtype == np.float32
    assert worst(double, single) < 0.01  # steps end where they are small, not at the same number


def test_an_affine_motion_is_found_from_a_pixel_off(given):
    picture, samples, true = given("affine")
    fields = generators(np.mgrid[0:SIDE, 0:SIDE].astype(np.float32), SIDE, SIDE)
    off = np.einsum("p,pchw->chw", 0.01 * np.array([0.5, -0.5, 1, -1, 1, 1]), fields[:6])
    # The scene turns: its paths bend, which the numbers allow for.
    wrong = Motion(
        np.asarray(true.velocity + off, np.float32), np.einsum("p,pchw->chw", np.full(6, 1e-6, np.float32), fields[:6]),
        true.confidence,
    )  # fmt: skip
    assert worst(wrong, true) > 1
    assert worst(refined(wrong, picture, samples, times=2), true) < 0.1


def test_a_velocity_for_each_pixel_comes_nearer(given):
    picture, samples, true = given("translate0.3")
    bump = gaussian_filter(np.random.default_rng(0).normal(size=(2, SIDE, SIDE)), (0, 12, 12))
    wrong = Motion.of_velocity(true.velocity + 0.006 * bump / np.abs(bump).max())
    found = refined(wrong, picture, samples, times=3)

    # Flat parts of the picture know nothing of their motion and keep what they have.
    texture = gaussian_filter(np.square(np.gradient(np.asarray(picture))), (0, 4, 4)).min(0)[::SCALE, ::SCALE]
    textured = texture[10:-10, 10:-10] > np.median(texture)

    def error(motion: Motion) -> float:
        return float(np.sqrt(((motion.velocity - true.velocity)[:, 10:-10, 10:-10][:, textured] ** 2).mean()))

    assert error(found) < 0.5 * error(wrong)
    # No step goes further than half a sensor pixel at the farthest moment.
    assert np.hypot(*(found.velocity - wrong.velocity)).max() <= 3 * 0.5 / 49 + 1e-6


def test_layers_move_apart_from_each_other(given):
    picture, samples, true = given("translate0.3")
    label = np.zeros((SIDE, SIDE), np.int32)
    label[:, SIDE // 2 :] = 1
    both = np.stack([true.velocity, true.velocity + 0.004]).astype(np.float32)
    layers = Layers(both, np.zeros_like(both), label, np.array([1, 0], np.int32))
    found = refined(Motion.of_layers(layers, true.confidence), picture, samples, times=3)
    assert found.layers is not None
    left, right = slice(15, SIDE // 2 - 15), slice(SIDE // 2 + 15, SIDE - 15)
    assert np.abs(np.median((found.velocity - true.velocity)[:, 15:-15, right])) < 0.002
    assert np.abs(np.median((found.velocity - true.velocity)[:, 15:-15, left])) < 0.001
    np.testing.assert_array_equal(found.velocity[:, :, :1], found.layers.velocity[0][:, :, :1])


def test_what_stands_still_is_left_alone(given):
    picture, samples, _ = given("static")
    still = Motion.none(SIDE, SIDE)
    assert refine(still, picture, samples, placed(samples, still), key=KEY) is still


def test_a_picture_that_is_no_number_changes_nothing_for_the_worse(given):
    picture, samples, true = given("translate0.3")
    found = refine(true, picture * jnp.nan, samples, placed(samples, true), key=KEY)
    np.testing.assert_array_equal(found.velocity, true.velocity)


def test_what_does_not_belong_together_is_refused(given):
    picture, samples, true = given("translate0.3")
    there = placed(samples, true)
    with pytest.raises(InputError, match="picture"):
        refine(true, picture[1:], samples, there, key=KEY)
    fewer = jax.tree.map(lambda values: values[1:], samples)
    with pytest.raises(InputError, match="samples"):
        refine(true, picture, fewer, there, key=KEY)
