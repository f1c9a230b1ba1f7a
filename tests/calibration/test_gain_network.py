"""Gains of a still scene, which only knowledge of pictures can tell, against those that the simulator gave."""

import re

import numpy as np
import pytest
from skimage import data

from scsr_opt.calibration import gain_network
from scsr_opt.calibration.gain_network import GainNetwork, gain_at_rest, rates_at_rest
from scsr_opt.camera.scenes import Static
from scsr_opt.camera.simulator import Sensor, Simulation, simulate
from scsr_opt.errors import InputError

PATTERN = 0.05


def still(spread: float, frames: int = 101, **sensor: float) -> Simulation:
    picture = data.camera()[64:256, 160:352] / 255
    return simulate(Static(picture), scale=2, frames=frames, sensor=Sensor(fixed_pattern=spread, **sensor), seed=3)


def test_rates_and_their_noise_are_those_of_the_sensor():
    light = np.random.default_rng(1).uniform(0.38, 0.42, (40, 40))
    for sensor in (Sensor(), Sensor(photons=100.0)):
        several = [simulate(Static(light), scale=1, frames=101, sensor=sensor, seed=n).spikes for n in range(12)]
        rates, noise = (np.stack(of) for of in zip(*(rates_at_rest(s, white_rate=0.6) for s in several), strict=True))
        assert rates.mean() == pytest.approx(0.4, rel=5e-3)
        truly = rates.std(0).mean() / 0.42  # over the intensity and the 0.02 at which its logarithm becomes linear
        # Photons make halves whose errors are independent; read-out adds a little. Of read-out alone each half has two
        # ends' errors of its own, where the whole has two for both: √2 times as large, and more as ends count less.
        least, most = (0.95, 1.25) if np.isfinite(sensor.photons) else (1.3, 1.8)
        assert least < np.median(noise) / truly < most


def test_a_pattern_before_a_still_scene_is_taken_for_gain():
    made = still(PATTERN)
    found = gain_at_rest(made.spikes, white_rate=0.6)
    lit = made.truth(50.0).reshape(96, 2, 96, 2).mean((1, 3)) > 0.1
    left = (found / made.gain)[lit].std()
    print(f"gains spread by {made.gain[lit].std():.4f}, over those found by {left:.4f}")
    # Half of the variance; what is texture here, grass, keeps it.
    assert left < 0.77 * made.gain[lit].std()
    assert np.corrcoef(found[lit], made.gain[lit])[0, 1] > 0.65
    assert abs(np.log(found)[lit].mean()) < 0.01  # no light is lost


@pytest.mark.parametrize(
    "made",
    [still(0.0), still(0.0, white_rate=0.1, photons=25.0), still(PATTERN, frames=5), still(0.0, frames=1)],
    ids=["no pattern", "dim light", "too short to tell", "one frame"],
)
def test_without_a_pattern_or_where_noise_hides_it_all_gains_are_one(made):
    found = gain_at_rest(made.spikes, white_rate=made.sensor.white_rate)
    assert found.shape == made.gain.shape and (found == 1).all()


def test_bad_pixels_have_a_gain_of_one_and_do_not_matter_to_others():
    made = still(PATTERN)
    bad = np.zeros(made.gain.shape, bool)
    bad[3::12, 5::12] = True
    wrong = made.spikes.copy()
    wrong[:, bad] = 1
    found, usual = gain_at_rest(wrong, white_rate=0.6, bad_pixels=bad), gain_at_rest(made.spikes, white_rate=0.6)
    assert (found[bad] == 1).all()
    beside = np.roll(bad, 1, axis=1)
    assert np.abs(found - usual)[beside].mean() < 0.3 * np.abs(usual - 1)[beside].mean()
    everywhere = gain_at_rest(made.spikes, white_rate=0.6, bad_pixels=np.ones_like(bad))
    assert (everywhere == 1).all()


@pytest.mark.parametrize("shape", [(1, 1), (5, 70), (9, 8)])
def test_small_sensors_and_none_that_fires(shape):
    fired = np.random.default_rng(0).random((60, *shape)) < 0.5
    for spikes in (fired, np.zeros_like(fired), np.ones_like(fired)):
        found = gain_at_rest(spikes, white_rate=0.6)
        assert found.shape == shape and found.dtype == np.float32 and np.isfinite(found).all()


@pytest.mark.parametrize("side", [8, 17, 32])
def test_a_small_sensor_is_not_taken_to_have_a_pattern(side):
    """All squares may be texture where there are few: without a minimum a third of such parts of 8×8 pixels had one."""
    for picture in (data.grass(), data.brick(), data.gravel()):
        made = simulate(Static(picture[: 2 * side, : 2 * side] / 255), scale=2, sensor=Sensor(photons=1000.0), seed=1)
        assert (gain_at_rest(made.spikes, white_rate=0.6) == 1).all()


@pytest.mark.parametrize("picture", [data.brick(), data.gravel(), data.camera()], ids=["brick", "gravel", "camera"])
def test_a_white_rate_that_is_too_low_makes_no_pattern(picture):
    """Surfaces brighter than white are unlike all that the network has seen."""
    made = simulate(Static(picture[:160, :160] / 255), scale=2, sensor=Sensor(photons=1000.0), seed=1)
    for white_rate in (0.06, 0.15, 0.3):
        assert (gain_at_rest(made.spikes, white_rate=white_rate) == 1).all()


@pytest.mark.parametrize("spread", [0.0, PATTERN])
def test_windows_of_a_large_sensor_tell_that_there_is_no_pattern(spread, monkeypatch):
    """All of it is looked at only where they do not."""
    picture = np.pad(data.camera() / 255, ((0, 48), (0, 48)), mode="symmetric")[::2, ::2]
    made = simulate(Static(picture), scale=1, frames=61, sensor=Sensor(fixed_pattern=spread), seed=3)
    looked_at, looks = [], gain_network._logarithm

    def counted(network, rate, noise, bad, settings):
        looked_at.append(rate.shape)
        return looks(network, rate, noise, bad, settings)

    monkeypatch.setattr(gain_network, "_logarithm", counted)
    found = gain_at_rest(made.spikes, white_rate=0.6)
    windows = [shape for shape in looked_at if shape != picture.shape]
    # Two rows of three windows; where the first one tells enough, the second is not looked at.
    assert windows == [(3, 56, 56)] * (1 + bool(spread)) and (picture.shape in looked_at) == bool(spread)
    everywhere = gain_at_rest(made.spikes, white_rate=0.6, sampled_gains=False)
    assert looked_at.pop() == picture.shape
    np.testing.assert_array_equal(everywhere, found)
    if not spread:
        assert (found == 1).all()
    else:
        assert (found / made.gain).std() < 0.9 * made.gain.std()


def test_a_bad_pixel_is_left_out_whatever_it_does():
    made = still(PATTERN)
    bad = np.random.default_rng(0).random(made.gain.shape) < 0.05
    hot, flickering = made.spikes.copy(), made.spikes.copy()
    hot[:, bad], flickering[:50, bad], flickering[50:, bad] = 1, 1, 0
    usual, other = (gain_at_rest(spikes, white_rate=0.6, bad_pixels=bad) for spikes in (hot, flickering))
    assert usual.std() > 0.02
    np.testing.assert_allclose(other, usual, atol=1e-6)
    np.testing.assert_array_equal(gain_at_rest(hot, white_rate=0.6, bad_pixels=bad.astype(np.uint8)), usual)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"white_rate": 0}, "white_rate is 0, but it must be a number from 1e-06"),
        ({"white_rate": 0.6, "bad_pixels": np.zeros((3, 3), bool)}, "bad_pixels has shape (3, 3), but the sensor has"),
        ({"white_rate": 0.6, "bad_pixels": np.full((9, 8), 2)}, "bad_pixels holds values"),
    ],
)
def test_refuses(options, message):
    with pytest.raises(InputError, match=re.escape(message)):
        gain_at_rest(np.zeros((20, 9, 8), np.uint8), **options)


def test_a_network_is_the_same_after_it_was_written(tmp_path):
    network = GainNetwork.load()
    network.save(tmp_path / "gain.npz")
    again = GainNetwork.load(tmp_path / "gain.npz")
    made = still(PATTERN)
    one, other = (gain_at_rest(made.spikes, white_rate=0.6, network=n) for n in (network, again))
    np.testing.assert_array_equal(one, other)
