"""Gains against those that the simulator gave its pixels."""

import numpy as np
import pytest

from scsr_opt.calibration.gain import blind_gain, flat_gain, share_of_unknown_gain, spread_of, with_gain
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.errors import InputError

SENSOR = Sensor(fixed_pattern=0.06, photons=1000.0)


def seen_in_passing(fixed_pattern: float):
    """A moving scene, its samples, and what its true picture predicts for them."""
    rng = np.random.default_rng(0)
    wave = sum(
        rng.normal() * np.sin(rng.normal(scale=0.3) * np.arange(120)[:, None] + rng.normal(scale=0.3) * np.arange(120))
        for _ in range(12)
    )
    picture = 0.5 + 0.1 * np.clip(wave, -4, 4)
    scene = Translation(picture, velocity=(0.1, 0.14), key=50)
    made = simulate(scene, scale=2, frames=101, sensor=Sensor(fixed_pattern=fixed_pattern, photons=1000.0), seed=1)
    samples = spike_intervals(made.spikes)
    frames = np.stack([made.truth(t).reshape(60, 2, 60, 2).mean((1, 3)) for t in range(101)])
    middle = np.clip(np.round((samples.start + samples.stop) / 2), 0, 100).astype(int)
    return made, samples, frames[middle, samples.row, samples.column]


def test_gains_of_a_flat_field():
    # Lit unevenly, but slowly so.
    light = 0.5 + 0.05 * np.linspace(-1, 1, 60)[:, None] * np.linspace(-1, 1, 70)
    made = simulate(Static(light), scale=1, frames=300, sensor=SENSOR, seed=3)
    bad = np.zeros((60, 70), bool)
    bad[::9, ::7] = True
    spikes = made.spikes.copy()
    spikes[:, bad] = 0
    gain = flat_gain(spikes, bad_pixels=bad)
    assert np.all(gain[bad] == 1)
    error = (gain / made.gain)[~bad]
    # A rate over 300 frames is good to 0.4/300 from read-out and 0.2 % from shot noise; a median of 225 pixels to
    # 1.25 · 0.06/√225 = 0.5 %.
    assert np.std(error) < 0.012
    assert np.mean(error) == pytest.approx(1, abs=0.01)


def test_gains_of_a_scene_that_moves_are_found_from_its_picture():
    made, samples, predicted = seen_in_passing(0.06)
    gain = blind_gain(samples, predicted, moved=np.full((60, 60), 8.6), white_rate=0.6)
    error = gain / np.median(gain) - made.gain / np.median(made.gain)
    # With a perfect picture, what is left is shot noise (√(2/1000/101) = 0.4 %), the light of the ends, and the pull
    # towards 1 by one spike in thirty.
    assert np.std(error) < 0.015
    assert np.corrcoef(gain.ravel(), made.gain.ravel())[0, 1] > 0.97
    corrected = with_gain(samples, gain)
    left = np.average((corrected.value - predicted) ** 2, weights=samples.weight)
    assert left < np.average((samples.value - predicted) ** 2, weights=samples.weight)


def test_errors_of_the_picture_are_not_taken_for_gains():
    """Without a pattern the halves of a recording disagree on gains, however wrong the picture is."""
    _, samples, predicted = seen_in_passing(0.0)
    wrong = predicted * (1 + 0.1 * np.random.default_rng(5).standard_normal(predicted.size)).astype(np.float32)
    gain = blind_gain(samples, wrong, moved=np.full((60, 60), 8.6), white_rate=0.6)
    assert np.std(gain) < 0.006  # the raw ratios spread by 0.02


def test_a_picture_that_is_far_wrong_in_places_hides_no_gains_elsewhere():
    """A fifth of the pixels is predicted 30 % too bright in one half of the time, too dark in the other."""
    rng = np.random.default_rng(7)
    wrong = rng.random((60, 60)) < 0.2
    tilt = rng.choice([-0.3, 0.3], (60, 60))
    for fixed_pattern in (0.06, 0.0):
        made, samples, predicted = seen_in_passing(fixed_pattern)
        late = np.where(samples.start + samples.stop > 101, 1, -1)
        factor = 1 + late * (wrong * tilt)[samples.row, samples.column]
        said = (predicted * factor).astype(np.float32)
        gain = blind_gain(samples, said, moved=np.full((60, 60), 8.6), white_rate=0.6)
        if fixed_pattern:
            error = gain / np.median(gain) - made.gain / np.median(made.gain)
            assert np.std(error[~wrong]) < 0.015  # as with a picture that is right everywhere
            assert np.std(gain[wrong] - 1) < 0.02  # these have not moved far from 1
        else:
            assert np.std(gain) < 0.003


def test_where_nothing_moves_gains_are_left_alone():
    _, samples, predicted = seen_in_passing(0.06)
    moved = np.where(np.arange(60) < 30, 0.0, 8.6) * np.ones((60, 1))
    gain = blind_gain(samples, predicted, moved=moved, white_rate=0.6)
    assert np.all(gain[:, :30] == 1) and np.std(gain[:, 30:]) > 0.04
    still = blind_gain(samples, predicted, moved=np.zeros((60, 60)), white_rate=0.6)
    np.testing.assert_array_equal(still, 1)


def test_corrected_samples():
    samples = spike_intervals(np.ones((9, 2, 2), np.uint8))
    gain = np.array([[0.5, 1.0], [1.0, 2.0]])
    corrected = with_gain(samples, gain)
    np.testing.assert_allclose(corrected.value * gain[samples.row, samples.column], samples.value, rtol=1e-6)
    assert corrected.value.dtype == np.float32
    with pytest.raises(InputError, match="1 gains are not above 0: mark such pixels"):
        with_gain(samples, np.array([[0.0, 1.0], [1.0, 1.0]]))
    with pytest.raises(InputError, match="even_over is 2"):
        flat_gain(np.ones((9, 2, 2), np.uint8), even_over=2)


def test_pixels_of_unknown_gain_count_less_by_the_error_that_their_samples_share():
    """A pixel of light I on a sensor whose gains spread by σ, with noise s of its mean: 1/(1 + (σI/s)²)."""
    gain, known = np.ones((4, 5), np.float32), np.zeros((4, 5), bool)
    gain[0], known[0] = [0.9, 1.1, 1.0, 1.1, 0.9], True  # one of those that are known is 1
    spread = spread_of(gain, known)
    assert spread == pytest.approx(np.std([0.9, 1.1, 1.0, 1.1, 0.9]))
    spikes = np.zeros((120, 4, 5), np.uint8)
    spikes[::2] = 1  # every other frame: light 0.5 / 0.6
    samples = spike_intervals(spikes, ends=0)
    share = share_of_unknown_gain(samples, gain, known, 0.02)
    assert np.all(share[0] == 1)
    np.testing.assert_allclose(share[1:], 1 / (1 + (spread * 0.5 / 0.6 / 0.02) ** 2), rtol=1e-5)
    assert np.all(share_of_unknown_gain(samples, gain, np.zeros_like(known), 0.02) == 1)
    assert spread_of(gain, np.zeros_like(known)) == 0
