from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from skimage import data

from scsr_opt.camera.scenes import Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.motion.estimators import parametric as module
from scsr_opt.motion.estimators.frames import MotionFrames, motion_frames
from scsr_opt.motion.estimators.parametric import generators, parametric
from scsr_opt.motion.estimators.settings import ParametricSettings
from scsr_opt.motion.inversion import bilinear, inverse
from scsr_opt.motion.settings import DEFAULTS, MotionSettings

HEIGHT, WIDTH = 60, 80
AFTER = np.linspace(-48, 48, 17).astype(np.float32)


def drawn(velocity: np.ndarray, acceleration: np.ndarray | None = None, noise: float = 0.003) -> MotionFrames:
    """Pictures of a hand-made texture under a motion, without a sensor."""
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[0 : HEIGHT + 60, 0 : WIDTH + 60]
    key = sum(
        a * np.sin(2 * np.pi * (f * rows + g * columns) + φ)
        for a, f, g, φ in zip(
            rng.normal(size=60),
            rng.uniform(-0.12, 0.12, 60),
            rng.uniform(0, 0.12, 60),
            rng.uniform(0, 7, 60),
            strict=True,
        )
    )
    key = jnp.asarray(0.5 + 0.05 * np.asarray(key), jnp.float32)
    acceleration = np.zeros_like(velocity) if acceleration is None else acceleration
    origin = inverse(jnp.asarray(velocity, jnp.float32), jnp.asarray(acceleration, jnp.float32), jnp.asarray(AFTER))
    shown = np.stack([np.asarray(bilinear(key[None], q[0] + 30, q[1] + 30)[0]) for q in origin])
    shown += rng.normal(0, noise, shown.shape)
    return MotionFrames(jnp.asarray(shown, jnp.float32), jnp.asarray(AFTER))


def fields() -> np.ndarray:
    return generators(np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32), HEIGHT, WIDTH)


def worst(found: np.ndarray, true: np.ndarray) -> float:
    """Largest error at the farthest moment, sensor pixels, but for a border that moves out of view."""
    return 48 * float(np.hypot(*(found - true))[8:-8, 8:-8].max())


def test_generators_are_those_of_a_homography():
    # (A p + t) / (1 + g·p) for small A − I, t, g, p about the picture's middle over its longer side; what is left is of
    # second order, 10⁻⁸ to 10⁻⁷ here.
    rng = np.random.default_rng(0)
    small = 1e-4 * rng.normal(size=8)
    row, column = rng.uniform(0, 59, 20), rng.uniform(0, 79, 20)
    p = np.stack([(row - 29.5) / 80, (column - 39.5) / 80])
    t, a, g = small[:2], small[2:6].reshape(2, 2), small[6:]
    moved = (p + a @ p + t[:, None]) / (1 - g @ p)
    numbers = np.array([*t, *a.ravel(), *g])
    found = np.einsum("p,pcn->cn", numbers, generators(np.stack([row, column]), 60, 80))
    np.testing.assert_allclose(found, moved - p, atol=3e-7)


def test_a_translation_is_exactly_that():
    true = np.broadcast_to(np.array([0.15, -0.2])[:, None, None], (2, HEIGHT, WIDTH))
    # Noise above what the interpolation of `drawn` adds to the motion.
    motion = parametric(drawn(true, noise=0.02))
    assert np.ptp(motion.velocity, axis=(1, 2)).max() == 0
    assert not motion.acceleration.any()
    assert worst(motion.velocity, true) < 0.02


def test_the_light_may_be_dim():
    # Shot noise, intervals of ten frames and more: not of the kind that any test of significance was derived for.
    picture = np.random.default_rng(0).random((240, 240))
    picture = gaussian_filter(picture, 2)
    picture = (picture - picture.min()) / np.ptp(picture)
    spikes = simulate(Translation(picture, (0.1, -0.15)), scale=2, sensor=Sensor(white_rate=0.15, photons=50.0)).spikes
    motion = parametric(motion_frames(spikes, key=50, white_rate=0.15))
    assert np.ptp(motion.velocity, axis=(1, 2)).max() == 0 and not motion.acceleration.any()


def test_what_fires_seldom_does_not_hold_a_bright_scene_back():
    """A dim pan of a picture with dark parts, which fire once in 3 to 14 pixels of motion and look as if they were
    slower: the fit was 0.033 px per frame off, and gave the dark parts a motion of their own."""
    picture = data.camera()[48:368, 96:416] / 255
    scene = Translation(picture, (0.28, -0.48), key=50)
    made = simulate(scene, scale=4, frames=101, sensor=Sensor(white_rate=0.1, photons=25.0), seed=0)
    pictures = motion_frames(made.spikes, key=50, white_rate=0.1)
    wrong = np.abs(parametric(pictures).velocity - np.array([0.07, -0.12])[:, None, None]).max()
    assert wrong < 0.005
    assert (
        np.abs(parametric(replace(pictures, firing=None)).velocity - np.array([0.07, -0.12])[:, None, None]).max()
        > 3 * wrong
    )


def test_affine_numbers_are_taken_where_they_are_needed():
    numbers = np.array([0.05, 0.1, 0.1, -0.08, 0.09, -0.06])
    true = np.einsum("p,pchw->chw", numbers, fields()[:6]).astype(np.float32)
    pictures = drawn(true)
    assert worst(parametric(pictures).velocity, true) < 0.05
    assert worst(parametric(pictures, affine=False).velocity, true) > 1


def test_perspective_numbers_are_taken_where_they_are_needed():
    numbers = np.array([0.05, 0.1, 0.05, -0.05, 0.05, -0.05, 0.15, -0.12])
    true = np.einsum("p,pchw->chw", numbers, fields()).astype(np.float32)
    pictures = drawn(true)
    assert worst(parametric(pictures).velocity, true) < 0.1
    assert worst(parametric(pictures, perspective=False).velocity, true) > 0.5


def test_acceleration_is_taken_where_it_is_needed():
    true = np.broadcast_to(np.array([0.1, 0.05], np.float32)[:, None, None], (2, HEIGHT, WIDTH))
    bend = np.broadcast_to(np.array([0.001, -0.0005], np.float32)[:, None, None], (2, HEIGHT, WIDTH))
    motion = parametric(drawn(true, bend))
    assert worst(motion.velocity, true) < 0.02
    # Half the square of 48 frames times 0.00002 are 0.02 sensor pixels.
    assert np.abs(motion.acceleration - bend).max() < 2e-5


def test_a_region_has_a_motion_of_its_own():
    still, moving = np.zeros((2, HEIGHT, WIDTH)), np.zeros((2, HEIGHT, WIDTH))
    moving[1] = 0.15
    region = np.zeros((HEIGHT, WIDTH), bool)
    region[15:45, 25:50] = True
    # A window onto what moves, with nothing passing its edge but the window itself.
    both = np.where(region, np.asarray(drawn(moving).picture), np.asarray(drawn(still).picture))
    pictures = MotionFrames(jnp.asarray(both), jnp.asarray(AFTER))
    start = module.Motion.of_velocity(moving + 0.05)
    found = parametric(pictures, where=region, start=start)
    # The edges of the window stand still and pull; a tenth of the speed is what they may do.
    assert np.abs(found.velocity[:, region] - moving[:, region]).max() < 0.015


def test_the_start_may_vary_over_the_picture():
    plain = MotionFrames(jnp.full((17, HEIGHT, WIDTH), 0.5, jnp.float32), jnp.asarray(AFTER))  # says nothing else
    turning = 0.01 * (fields()[3] - fields()[4]) + 0.02 * fields()[0]
    region = np.zeros((HEIGHT, WIDTH), bool)
    region[15:45, 25:50] = True
    found = parametric(plain, where=region, start=module.Motion.of_velocity(turning))
    np.testing.assert_allclose(found.velocity, turning, atol=1e-6)
    found = parametric(plain, start=module.Motion.of_velocity(turning), affine=False)
    np.testing.assert_allclose(found.velocity, 0.02 * fields()[0], atol=1e-6)  # the mean


def test_compiled_once_for_all_models_and_regions_of_a_size():
    pictures = drawn(np.full((2, HEIGHT, WIDTH), 0.05))
    parametric(pictures)
    small = np.zeros((HEIGHT, WIDTH), bool)
    small[:20, :20] = True
    parametric(pictures, where=small)
    compiled = module._sums_along._cache_size()  # pyright: ignore[reportAttributeAccessIssue]
    small[30:50, 30:50] = True
    parametric(pictures, where=small)
    parametric(pictures, affine=False)
    parametric(drawn(np.full((2, HEIGHT, WIDTH), 0.1)), perspective=False, settings=MotionSettings())
    assert module._sums_along._cache_size() == compiled  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("shape", [(2, 2), (2, 30), (7, 3)])
def test_tiny_pictures_and_pictures_without_texture(shape):
    flat = MotionFrames(jnp.full((5, *shape), 0.5), jnp.arange(-2.0, 3.0))
    motion = parametric(flat)
    assert motion.velocity.shape == (2, *shape) and np.isfinite(motion.velocity).all()
    assert not motion.velocity.any()


def test_a_fitted_start_is_fitted_to_all_moments_once_more():
    """As exactly as from near times on, from a start as wrong as one that was fitted to other pixels may be."""
    velocity = np.zeros((2, HEIGHT, WIDTH))
    velocity[0], velocity[1] = 0.1, -0.05
    region = np.ones((HEIGHT, WIDTH), bool)
    start = module.Motion.of_velocity(1.02 * velocity)
    pictures = drawn(velocity)
    ways = [parametric(pictures, start=start, where=region, fitted=fitted) for fitted in (True, False)]
    for found in ways:
        assert worst(found.velocity, velocity) < 0.1 * worst(start.velocity, velocity)
    np.testing.assert_allclose(ways[0].velocity, ways[1].velocity, atol=1e-4)


@pytest.mark.parametrize(("side", "number"), [(20, 19**2), (60, 1024), (100, 4096), (200, 16384)])
def test_points_are_of_few_numbers_and_spread_evenly(side, number):
    points = module._points(side, side, None, None, settings=DEFAULTS.parametric)
    used = int(points.region.sum())
    assert 0.98 * number <= used <= number
    assert points.region.size in (1024, 4096, 16384)
    # In each sixteenth of the picture as many as in the others, but that rows and columns may be 5, 5, 5 and 4.
    quarters = points.position[:, points.region > 0] // (side / 4)
    counts = np.bincount((4 * quarters[0] + quarters[1]).astype(int), minlength=16)
    assert counts.min() > 0.7 * used / 16


def waving() -> tuple[MotionFrames, module.Motion]:
    """Pictures of a motion that is not affine, and a start: weights that follow slowly settle which parts of it the fit
    serves, so that each update is a large share of the one before."""
    velocity = np.zeros((2, HEIGHT, WIDTH))
    velocity[1] = 0.15 + 0.05 * np.sin(3 * np.pi * np.arange(WIDTH) / WIDTH)
    return drawn(velocity), module.Motion.of_velocity(np.full((2, HEIGHT, WIDTH), 0.1))


def test_a_fit_ends_where_more_steps_lead():
    """Measured: 0.002 sensor pixels from the end at the farthest moment, 0.54 without extrapolated updates."""
    pictures, start = waving()
    region = np.ones((HEIGHT, WIDTH), bool)
    usual = parametric(pictures, where=region, start=start)
    further = ParametricSettings(most_steps=(200, 120, 100, 240), step_tolerance=0.0)
    most = parametric(pictures, where=region, start=start, settings=MotionSettings(parametric=further))
    assert worst(usual.velocity, most.velocity) < 0.05


def test_a_quarter_of_the_points_go_most_of_the_way():
    """Measured: 0.003 sensor pixels apart at the farthest moment."""
    pictures, start = waving()
    region = np.ones((HEIGHT, WIDTH), bool)
    ways = [parametric(pictures, where=region, start=start, sparse=sparse) for sparse in (True, False)]
    assert worst(ways[0].velocity, ways[1].velocity) < 0.05


def test_blocks_of_a_region_anywhere_cover_all_numbers():
    """The votes of blocks beyond the last number would be lost."""
    region = np.zeros((120, 160), bool)
    region[70:110, 90:150] = True
    points = module._points(120, 160, region, None, all_points=True, settings=DEFAULTS.parametric)
    blocks, counts = np.unique(points.block[points.region > 0], return_counts=True)
    np.testing.assert_array_equal(blocks, np.arange(DEFAULTS.parametric.blocks_per_side**2))
    assert counts.max() < 4 * counts.min()
