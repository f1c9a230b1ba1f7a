"""The noise model against recordings of known noise."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from scsr_opt.camera.noise import Noise, estimate_photons
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.camera.scenes import Static
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.errors import InputError


def recording(level: float, photons: float, fixed_pattern: float = 0.0, white_rate: float = 0.6) -> np.ndarray:
    # Levels that differ a little from pixel to pixel, so that their fractions of a frame are all different.
    picture = level * np.random.default_rng(0).uniform(0.95, 1.05, (60, 60))
    sensor = Sensor(photons=photons, fixed_pattern=fixed_pattern, white_rate=white_rate)
    return simulate(Static(picture), scale=1, frames=150, sensor=sensor, seed=1).spikes


@pytest.mark.parametrize(
    ("level", "photons", "fixed_pattern"),
    [(0.15, math.inf, 0.0), (0.3, 100.0, 0.0), (0.15, 25.0, 0.0), (0.3, math.inf, 0.3)],
)
def test_the_variance_of_intervals_is_the_models(level, photons, fixed_pattern):
    made = recording(level, photons, fixed_pattern)
    found = spike_intervals(made, ends=0)
    noise = Noise(photons=photons, fixed_pattern=fixed_pattern)
    # Against the light that was there; 5 % of that is spread of the levels. Weighted by duration, as everywhere.
    picture = level * np.random.default_rng(0).uniform(0.95, 1.05, (60, 60))
    error = found.value - picture[found.row, found.column]
    measured = np.average(error**2, weights=found.weight)
    predicted = np.average(noise.variance(found.weight.astype(float), float(level)), weights=found.weight)
    # Durations vary with the noise themselves, which the formula leaves out: a tenth at these levels, more where the
    # spread is 30 %.
    assert measured == pytest.approx(predicted, rel=0.25)


@pytest.mark.parametrize("photons", [10.0, 25.0, 60.0])
def test_photons_are_found_in_dim_light(photons):
    picture = np.random.default_rng(2).uniform(0.2, 1, (50, 50))
    made = simulate(Static(picture), scale=1, frames=151, sensor=Sensor(white_rate=0.1, photons=photons), seed=3)
    # 2,500 pixels with about 5 triples of intervals in a quarter of them: 3,000 squares, 4 % each way.
    assert estimate_photons(made.spikes, white_rate=0.1) == pytest.approx(photons, rel=0.15)


def test_without_shot_noise_there_are_very_many_photons():
    picture = np.random.default_rng(4).uniform(0.1, 0.4, (60, 60))
    made = simulate(Static(picture), scale=1, frames=151, seed=5)
    assert estimate_photons(made.spikes) > 500
    assert estimate_photons(np.zeros((20, 3, 3), np.uint8)) == math.inf


def test_weights_follow_the_level_and_keep_their_sum():
    made = recording(0.3, 100.0)
    found = spike_intervals(made)
    level = np.where(np.arange(60)[:, None] < 30, 0.2, 0.8) * np.ones((60, 60))
    weight = Noise(photons=100.0).weights(found, level)
    assert weight.sum() == pytest.approx(found.weight.sum(), rel=1e-4)
    per_frame = weight / found.weight
    # Over 150 frames: I² / (6 · 150²) + I / (100 · 150), mostly shot noise, which grows with the light.
    ratio = (0.8**2 / 135000 + 0.8 / 15000) / (0.2**2 / 135000 + 0.2 / 15000)
    assert per_frame[found.row < 30].mean() == pytest.approx(ratio * per_frame[found.row >= 30].mean(), rel=1e-3)
    assert np.ptp(per_frame[found.row < 30]) < 1e-3 * per_frame.max()  # one factor for all samples of a pixel
    # When the recording began does not matter.
    later = replace(found, start=found.start + np.float32(1000), stop=found.stop + np.float32(1000))
    np.testing.assert_allclose(Noise(photons=100.0).weights(later, level), weight, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"photons": 0}, "photons is 0, but it must be above 0"),
        ({"fixed_pattern": -0.1}, "fixed_pattern is -0.1, but it must be a finite number, 0 or more."),
        ({"dark_rate": math.inf}, "dark_rate is inf, but"),
    ],
)
def test_what_cannot_be(change, message):
    with pytest.raises(InputError, match=re.escape(message)):
        Noise(**change)
