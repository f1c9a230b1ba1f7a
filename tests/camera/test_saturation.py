"""Which pixels saw more light than they can tell."""

import numpy as np
import pytest

from scsr_opt.camera import Sensor, read_recording, simulate
from scsr_opt.camera.saturation import said_of, saturated, share_saturated, spike_counts
from scsr_opt.camera.scenes import Static


def shares(picture: np.ndarray, frames: int, white_rate: float = 0.6) -> float:
    sensor = Sensor(white_rate=white_rate, photons=1000.0)
    made = simulate(Static(picture), scale=1, frames=frames, sensor=sensor, seed=2)
    return share_saturated(spike_counts(made.spikes), frames)


@pytest.mark.parametrize("frames", [1, 2, 3, 5, 10, 11, 21, 41, 101])
def test_white_by_day_is_not_saturated(frames):
    assert shares(np.ones((40, 50)), frames) == 0


@pytest.mark.parametrize("frames", [10, 21, 101])
def test_light_of_more_than_a_spike_a_frame_is(frames):
    half = np.repeat([[0.3, 1.0]], 20, 0).repeat(10, 1)
    assert shares(half, frames, white_rate=1.2) == 0.5


def test_bad_pixels_mean_nothing():
    count = np.array([[101, 101, 50, 91]])
    bad = np.array([[True, False, False, False]])
    np.testing.assert_array_equal(saturated(count, 101, bad), [[False, True, False, False]])
    assert share_saturated(count, 101, bad) == pytest.approx(1 / 3)
    assert share_saturated(count, 101, np.ones_like(bad)) == 0


def test_a_small_share_is_said():
    assert said_of(1e-5).startswith("under 0.1 % of the pixels") and said_of(0.5).startswith("50 % of the pixels")
    assert said_of(1.0).startswith("100 % of the pixels") and said_of(0.0123).startswith("1.2 % of the pixels")


@pytest.mark.parametrize(
    ("name", "least", "most"),
    [
        ("real_car_400x250.dat", 0.05, 0.12),  # 5 % of its pixels fired in all of these frames
        ("real_roadside_static.npz", 0, 0),
        ("real_lowlight_helicopter.npz", 0, 0),
        ("reds_200_part1_400x250_key150.dat", 0, 0),
        ("reds_203_part1_400x250_key150.dat", 0, 0),
    ],
)
def test_real_recordings(shared_data, name, least, most):
    recording = read_recording(shared_data / "recordings" / name)
    spikes = recording.window(*recording.around(None, 101))
    assert least <= share_saturated(spike_counts(spikes), len(spikes), recording.bad_pixels) <= most
