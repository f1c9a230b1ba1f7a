"""Smoothing and regression that all motion estimators share, against NumPy and SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates, median_filter

from scsr_opt.motion.estimators.dense import _median
from scsr_opt.motion.estimators.frames import MotionFrames, drift, drift_of, smooth, smoothed

RANDOM = np.random.default_rng(3)


@pytest.mark.parametrize("sigma", [0.4, 1.0, 2.2, 2.6, 3.0, 4.0, 4.9, 5.2, 5.5, 6.0])
def test_smoothing_by_windows_of_every_width(sigma):
    picture = RANDOM.normal(size=(2, 23, 37)).astype(np.float32)
    reach = int(np.ceil(3 * sigma))
    expected = gaussian_filter(picture.astype(np.float64), sigma, axes=(1, 2), mode="nearest", radius=reach)
    np.testing.assert_allclose(smooth(jnp.asarray(picture), jnp.asarray(sigma)), expected, atol=1e-6)
    np.testing.assert_allclose(smoothed(picture, sigma), expected, atol=1e-6)


def test_the_median_is_that_of_scipy():
    picture = RANDOM.normal(size=(2, 9, 13)).astype(np.float32)
    np.testing.assert_array_equal(_median(jnp.asarray(picture), 5), median_filter(picture, (1, 5, 5), mode="nearest"))


@pytest.mark.parametrize("moving, compiled", [(True, True), (True, False), (False, False)])
@pytest.mark.parametrize("reach", [6.0, 100.0])
def test_drift_is_the_written_out_regression(moving, compiled, reach):
    height, width, after = 12, 17, np.linspace(-12, 15, 9).astype(np.float32)
    pictures = gaussian_filter(RANDOM.normal(size=(9, height, width)), (0, 1, 1))
    motion = [gaussian_filter(RANDOM.normal(size=(2, height, width)), (0, 3, 3)) * size for size in (0.5, 0.02)]
    part = np.abs(after) <= reach
    here = np.mgrid[:height, :width]
    value, weight = np.zeros((2, 9, height, width))
    for k, tau in enumerate(after):
        there = here + (tau * motion[0] + tau**2 / 2 * motion[1] if moving else 0)
        value[k] = map_coordinates(pictures[k], there, order=1, mode="nearest")
        last = np.array([height - 1, width - 1])[:, None, None]
        weight[k] = part[k] * ((there >= 0) & (there <= last)).all(0)
    seen = np.maximum(weight.sum(0), 1e-6)
    mean = (weight * value).sum(0) / seen
    basis = np.stack([after, after**2 / 2])[:, :, None, None]
    centred = basis - (weight * basis).sum(1, keepdims=True) / seen
    given = (motion[0].astype(np.float32), motion[1].astype(np.float32)) if moving else None
    pictures = pictures.astype(np.float32)
    found = drift(pictures, after, np.float32(part), given) if compiled else drift_of(pictures, after, given, part)
    shown = weight.sum(0) > 0
    np.testing.assert_allclose(found.seen, weight.sum(0))
    # A thousandth of what such sums come to: rounding of sums of τ⁴ up to 5e4, and of places at the border.
    for name, expected in {
        "mean": mean,
        "residual": (weight * (value - mean) ** 2).sum(0),
        "change": (weight * centred * (value - mean)).sum(1),
        "spread": np.einsum("nhw,anhw,bnhw->abhw", weight, centred, centred),
    }.items():
        error = np.abs(getattr(found, name) - expected)[..., shown]
        assert error.max() < 1e-3 * np.abs(expected[..., shown]).max(), name


def test_presmoothed_is_computed_once_for_a_width():
    pictures = MotionFrames(jnp.asarray(RANDOM.normal(size=(3, 20, 24)).astype(np.float32)), jnp.arange(3.0))
    assert pictures.presmoothed(1) is pictures.presmoothed(1.0)
    assert pictures.presmoothed(1.5) is not pictures.presmoothed(1.0)


def test_part_cuts_presmoothed_pictures_of_the_whole_sensor():
    """Pictures that were smoothed before they were cut are exact at the border of the part; those that are smoothed
    afterwards see their own border values continued."""
    pictures = MotionFrames(jnp.asarray(RANDOM.normal(size=(3, 40, 44)).astype(np.float32)), jnp.arange(3.0))
    box = (slice(10, 30), slice(8, 36))
    whole = pictures.presmoothed(1.0)[:, *box]
    np.testing.assert_array_equal(pictures.part(*box, presmoothed=(1.0,)).presmoothed(1.0), whole)
    alone = pictures.part(*box).presmoothed(1.0)
    np.testing.assert_allclose(alone[:, 4:-4, 4:-4], whole[:, 4:-4, 4:-4], atol=1e-6)
    assert np.abs(alone - whole).max() > 0.01
