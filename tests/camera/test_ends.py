"""Dark pixels: what the ends of a recording say keeps the mean where it should be."""

import numpy as np
import pytest

from scsr_opt.camera.samples import END_WEIGHT, Samples, spike_intervals
from scsr_opt.camera.scenes import Static
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.errors import InputError

LEVELS = [0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.5]


def recording(level: float, photons: float = np.inf, seed: int = 0, white_rate: float = 0.6) -> np.ndarray:
    sensor = Sensor(photons=photons, white_rate=white_rate)
    return simulate(Static(np.full((100, 100), level)), scale=1, frames=101, sensor=sensor, seed=seed).spikes


def mean(samples: Samples) -> float:
    return float(np.average(samples.value, weights=samples.weight))


@pytest.mark.parametrize("photons", [np.inf, 100.0])
@pytest.mark.parametrize("level", LEVELS)
def test_no_level_comes_out_too_bright_or_too_dark(level, photons):
    found = mean(spike_intervals(recording(level, photons)))
    # A mean of 10,000 pixels, each off by at most ½θ/T in the standard deviation from its phase and by √(I/NT) from
    # shot noise: four standard errors. What remains (2 %) is that an interval's start and duration go together.
    phase = 0.5 / 0.6 / 101
    error = 4 * np.hypot(phase, np.sqrt(level / photons / 101)) / 100
    assert found == pytest.approx(level, rel=0.02, abs=error)


def test_without_the_ends_only_those_that_fired_twice_would_speak():
    dark = recording(0.01, 100.0)
    without = spike_intervals(dark, ends=0)
    assert without.count == 0 or mean(without) > 1.2 * 0.01
    assert mean(spike_intervals(dark)) == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("shortest", [1, 10, 101])
def test_ends_are_the_light_before_the_first_and_after_the_last_spike(shortest):
    spikes = np.zeros((30, 1, 3), np.uint8)
    spikes[[10, 18], 0, 0] = spikes[4, 0, 1] = 1
    found = spike_intervals(spikes, white_rate=0.5, shortest=shortest, first_frame=100, ends=0.25)
    entries = sorted(
        zip(found.column.tolist(), found.start.tolist(), found.stop.tolist(), found.value.tolist(), strict=True)
    )
    expected = [
        (0, 99.5, 110, 0.5 / 0.5 / 10.5),  # half a threshold before
        (0, 110, 118, 1 / 0.5 / 8),
        (0, 118, 129.5, 0.5 / 0.5 / 11.5),
        (1, 99.5, 104, 0.5 / 0.5 / 4.5),
        (1, 104, 129.5, 0.5 / 0.5 / 25.5),
        (2, 99.5, 129.5, 0),  # never fired: nothing that one could count
    ]
    np.testing.assert_allclose(np.array(entries), np.array(expected, float), rtol=1e-5)
    inner = found.start == 110
    np.testing.assert_allclose(found.weight[inner & (found.stop == 118)], 8)
    others = ~(inner & (found.stop == 118))
    np.testing.assert_allclose(found.weight[others], 0.25 * (found.stop - found.start)[others])


def test_bad_pixels_have_no_ends():
    spikes = np.zeros((20, 2, 2), np.uint8)
    spikes[5, 0] = 1
    bad = np.array([[True, False], [True, False]])
    found = spike_intervals(spikes, bad_pixels=bad)
    assert sorted(zip(found.row.tolist(), found.column.tolist(), strict=True)) == [(0, 1), (0, 1), (1, 1)]
    assert spike_intervals(spikes, bad_pixels=np.ones((2, 2), bool)).count == 0


def test_bright_pixels_are_as_exact_as_without_ends():
    level = np.random.default_rng(1).uniform(0.5, 1, (40, 40))
    spikes = simulate(Static(level), scale=1, frames=101, seed=2).spikes

    def error(ends: float) -> float:
        found = spike_intervals(spikes, shortest=101, ends=ends)
        light, weight = np.zeros_like(level), np.zeros_like(level)
        np.add.at(light, (found.row, found.column), found.weight * found.value)
        np.add.at(weight, (found.row, found.column), found.weight)
        return float(np.sqrt(np.mean((light / weight - level) ** 2)))

    # Two ends, a threshold's light ±29 % each at a tenth of the weight, against 0.4 frames' light.
    assert error(END_WEIGHT) < 1.1 * error(0)
    assert error(1.0) > 1.5 * error(0)


@pytest.mark.parametrize("ends", [-0.1, 1.5, float("nan")])
def test_weights_of_ends_that_cannot_be(ends):
    with pytest.raises(InputError, match="ends is .*, but it must be a number from 0"):
        spike_intervals(np.zeros((5, 2, 2), np.uint8), ends=ends)
