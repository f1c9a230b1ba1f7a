import numpy as np
import pytest

from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.scenes import Static
from scsr_opt.camera.simulator import simulate


def trains(seed: int = 0, frames: int = 60, chance: float = 0.15) -> np.ndarray:
    return np.random.default_rng(seed).random((frames, 6, 7)) < chance


@pytest.mark.parametrize("intensity", [0.2, 0.55, 1.0])
def test_constant_light_is_found_to_a_fraction_of_a_frame(intensity):
    spikes = simulate(Static(np.full((12, 12), intensity)), scale=1, frames=120).spikes
    edges = np.array([30.0, 50.0, 90.0])
    found = interval_rates(spikes, edges)
    # A reading is exact at the spikes' true times, which are known to a frame: its error is below a frame's light at
    # either edge of the stretch.
    assert np.abs(found - intensity).max(initial=0) < intensity / 20 + 1e-6
    counted = spikes[30:50].mean(0) / 0.6
    if intensity == 0.2:  # where a count is off by up to θ
        assert np.abs(found[0] - intensity).max() < np.abs(counted - intensity).max() / 2


def test_the_light_between_the_first_and_the_last_spike_is_conserved():
    for train in trains().reshape(60, -1).T:
        fired = np.flatnonzero(train)
        edges = np.unique(np.concatenate([[fired[0], fired[-1]], np.linspace(fired[0], fired[-1], 7)]))
        rates = interval_rates(train[:, None, None], edges, white_rate=0.5)[:, 0, 0]
        assert (rates * np.diff(edges)).sum() == pytest.approx((len(fired) - 1) / 0.5, rel=1e-5)


def test_agrees_with_interpolation_pixel_by_pixel():
    spikes = trains(1)
    edges = np.array([12.0, 17.5, 23.0, 24.0, 31.25, 47.0])
    found = interval_rates(spikes, edges, white_rate=0.7)
    compared = 0
    for row, column in np.ndindex(6, 7):
        fired = np.flatnonzero(spikes[:, row, column])
        inside = (edges >= fired[0]) & (edges <= fired[-1])
        light = np.interp(edges, fired, np.arange(len(fired))) / 0.7
        both = inside[1:] & inside[:-1]
        np.testing.assert_allclose(found[both, row, column], (np.diff(light) / np.diff(edges))[both], atol=1e-5)
        compared += both.sum()
    assert compared > 150


def test_before_the_first_and_after_the_last_spike_the_rate_is_what_the_silence_allows():
    spikes = np.zeros((40, 1, 2), bool)
    spikes[[20, 22, 24, 26], 0, 0] = True  # silent for 20 frames before: less than 1/20, though it fires every second
    spikes[[4, 14, 24, 34], 0, 1] = True  # silent for 4 frames before: that allows 1/4, the interval is 10
    early = interval_rates(spikes, np.array([0.0, 3.0]), white_rate=1)[0, 0]
    np.testing.assert_allclose(early, [1 / 20, 1 / 10], rtol=1e-5)
    late = interval_rates(spikes, np.array([36.0, 39.0]), white_rate=1)[0, 0]
    np.testing.assert_allclose(late, [1 / 13, 1 / 10], rtol=1e-4)


def test_a_pixel_that_hardly_fires_shows_its_mean_rate():
    spikes = np.zeros((50, 1, 2), np.uint8)
    spikes[17, 0, 1] = 1
    rates = interval_rates(spikes, np.array([0.0, 10.0, 30.0]), white_rate=0.5)
    np.testing.assert_array_equal(rates[:, 0, 0], 0)
    np.testing.assert_allclose(rates[:, 0, 1], 1 / 50 / 0.5, rtol=1e-5)  # θ / T


def test_all_ones_is_the_brightest_that_can_be_seen():
    np.testing.assert_allclose(interval_rates(np.ones((9, 2, 2), bool), np.array([0.0, 4.0, 8.0])), 1 / 0.6, rtol=1e-5)
