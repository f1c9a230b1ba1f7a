import math

import numpy as np
import pytest

from scsr_opt.camera.playback import stp, tfi, tfp
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.errors import InputError

PLAYBACKS = [tfp, tfi, stp]


def train(frames: int, *times: int) -> np.ndarray:
    """One pixel that fires at `times`."""
    spikes = np.zeros((frames, 1, 1), np.uint8)
    spikes[list(times)] = 1
    return spikes


def regular(frames: int, interval: int, pixels: int) -> np.ndarray:
    """Pixels that fire every `interval` frames, with every phase."""
    time, phase = np.arange(frames)[:, None], np.arange(pixels)[None, :]
    return ((time + phase) % interval == 0).astype(np.uint8)[:, :, None]


@pytest.mark.parametrize("playback", PLAYBACKS)
def test_an_intensity_picture_comes_back(playback):
    spikes = regular(200, 5, 20)
    image = playback(spikes, 100, white_rate=0.5)
    assert image.shape == (20, 1) and image.dtype == np.float32
    if playback is tfp:  # 21 frames hold four spikes or five
        assert set(np.round(image.ravel() * 21 * 0.5, 4)) == {4.0, 5.0}
    else:
        np.testing.assert_allclose(image, 0.4, rtol=1e-6)


@pytest.mark.parametrize("playback", PLAYBACKS)
@pytest.mark.parametrize("intensity", [0.05, 0.17, 0.618, 1.0])
def test_constant_light_comes_back_without_bias(playback, intensity):
    simulation = simulate(Static(np.full((100, 100), intensity)), scale=1, frames=201)
    image = playback(simulation.spikes, 100)
    assert image.mean() == pytest.approx(intensity, rel=0.02)
    # No pixel is further off than its own way of counting explains: a spike in 21 frames, a frame in the interval.
    if playback is tfp:
        assert np.abs(image - intensity).max() <= 1 / (21 * 0.6) + 1e-6
    else:
        length = 1 / (0.6 * intensity)
        assert image.max() <= 1 / (0.6 * math.floor(length)) * (1 + 1e-6)
        assert image.min() >= 1 / (0.6 * math.ceil(length)) * (1 - 1e-6)


def test_the_synapse_averages_over_the_whole_numbers_of_the_intervals():
    simulation = simulate(Static(np.full((60, 60), 0.7)), scale=1, frames=201, sensor=Sensor(white_rate=0.6))
    error = {playback: np.std(playback(simulation.spikes, 100)) for playback in PLAYBACKS}
    assert error[stp] < 0.75 * error[tfi]


def test_the_synapse_blurs_motion_less_than_a_window():
    bars = np.tile(0.1 + 0.8 * (np.arange(120) // 6 % 2), (40, 1))
    scene = Translation(bars, (0.0, 0.4), key=60.0)
    simulation = simulate(scene, scale=1, frames=121)
    error = {p: np.sqrt(np.mean((p(simulation.spikes, 60) - simulation.truth(60)) ** 2)) for p in PLAYBACKS}
    assert error[stp] < error[tfp]


@pytest.mark.parametrize(
    ("key", "window", "first", "last"),
    [(10, 1, 10, 10), (10, 5, 8, 12), (10, 4, 8, 11), (0, 5, 0, 2), (19, 5, 17, 19), (1, 20, 0, 10), (10, 20, 0, 19)],
)
def test_a_window_is_cut_where_the_recording_ends_and_divided_by_what_is_left(key, window, first, last):
    spikes = np.random.default_rng(0).integers(0, 2, (20, 3, 4), dtype=np.uint8)
    expected = spikes[first : last + 1].mean(0) / 0.6
    np.testing.assert_allclose(tfp(spikes, key, window=window), expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("times", "key", "gap"),
    [
        ((3, 10), 4, 7),  # the frame after a spike begins an interval, the frame of a spike ends one
        ((3, 10), 10, 7),
        ((3, 10, 12), 11, 2),
        ((3, 4), 4, 1),
        # Cut off by an end: the longer of the silence and the nearest interval.
        ((8, 10), 3, 8),
        ((3, 10), 3, 7),
        ((3, 10), 11, 9),
        ((3, 18), 19, 15),
        ((5,), 12, 14),  # one spike: the longer silence
        ((15,), 2, 15),
        ((15,), 17, 15),
        ((), 9, 20),
    ],
)
def test_the_interval_around_the_key_frame(times, key, gap):
    spikes = train(20, *times)
    assert tfi(spikes, key, white_rate=0.5).item() == pytest.approx(1 / (0.5 * gap))


def test_a_single_frame_is_enough():
    for spikes in (train(1), train(1, 0)):
        for playback in PLAYBACKS:
            assert np.isfinite(playback(spikes, 0)).all()


def state_by_the_book(intervals: list[int], u0: float, f: float, tau_d: float, tau_f: float) -> tuple[float, float]:
    """R and u after these intervals, starting from where the first one repeated for ever would lead."""
    resources, release = 1.0, u0
    for interval in [intervals[0]] * 2000 + intervals[1:]:
        resources, release = (
            1 - (1 - resources * (1 - release)) * math.exp(-interval / tau_d),
            u0 + (release + f * (1 - release) - u0) * math.exp(-interval / tau_f),
        )
    return resources, release


@pytest.mark.parametrize("parameters", [(0.15, 0.15, 1.0, 10.0), (0.4, 0.05, 8.0, 30.0)])
@pytest.mark.parametrize("intervals", [[4], [1, 1, 2, 1, 2], [5, 3, 7, 2, 2, 9], [12, 3]])
def test_the_synapse_follows_its_equations(intervals, parameters):
    times = np.cumsum([2, *intervals])
    u0, f, tau_d, tau_f = parameters
    image = stp(
        train(times[-1] + 1, *times.tolist()),
        int(times[-1]),
        white_rate=1.0,
        base_release=u0,
        facilitation=f,
        depression_time=tau_d,
        facilitation_time=tau_f,
    )
    R, u = state_by_the_book(intervals, *parameters)
    by_resources = -1 / (tau_d * math.log((1 - R) / (1 - R * (1 - u))))
    by_release = -1 / (tau_f * math.log((u - u0) / (u - u0 + f * (1 - u))))
    assert image.item() == pytest.approx((by_resources + by_release) / 2, rel=1e-5)


@pytest.mark.parametrize("interval", [1, 2, 17, 40, 1500])
def test_a_settled_synapse_gives_the_exact_rate_however_dim(interval):
    spikes = train(4 * interval + 1, *range(0, 4 * interval + 1, interval))
    assert stp(spikes, 3 * interval, white_rate=1.0).item() == pytest.approx(1 / interval, rel=1e-6)


def test_the_synapse_turns_to_a_new_rate():
    times = [*range(0, 100, 2), *range(100, 201, 5)]
    spikes = train(201, *times)
    told = [stp(spikes, key, white_rate=1.0).item() for key in (90, 103, 120, 190)]
    assert told[0] == pytest.approx(0.5, rel=1e-6)
    assert 0.2 < told[1] < 0.4
    assert told[1] > told[2] > told[3] == pytest.approx(0.2, rel=1e-3)


def test_what_is_long_past_does_not_matter():
    rng = np.random.default_rng(1)
    spikes = (rng.random((500, 6, 7)) < 0.4).astype(np.uint8)
    np.testing.assert_allclose(stp(spikes, 450), stp(spikes, 450, history=450), rtol=1e-5)
    np.testing.assert_allclose(stp(spikes, 450, history=0), tfi(spikes, 450), rtol=1e-6)


def test_silence_bounds_what_the_synapse_says_and_without_an_interval_it_gives_way():
    quiet = train(60, 0, 2, 4, 6)
    assert stp(quiet, 30, white_rate=1.0).item() == pytest.approx(1 / 53)
    assert stp(train(60, 0, 2, 4, 58), 59, white_rate=1.0).item() < 1 / 2
    for lonely in (train(60), train(60, 20), train(60, 40), train(60, 40, 50)):
        assert stp(lonely, 30).item() == tfi(lonely, 30).item()


@pytest.mark.parametrize("playback", PLAYBACKS)
def test_every_kind_of_spikes_is_taken(playback):
    spikes = np.random.default_rng(0).integers(0, 2, (30, 4, 5), dtype=np.uint8)
    expected = playback(spikes, 12)
    for other in (spikes > 0, spikes.astype(np.int64), spikes.tolist(), Recording.from_array(spikes)):
        np.testing.assert_array_equal(playback(other, 12), expected)
    np.testing.assert_allclose(playback(spikes, 12, white_rate=0.3), 2 * expected, rtol=1e-6)


@pytest.mark.parametrize("playback", PLAYBACKS)
@pytest.mark.parametrize(
    ("spikes", "arguments", "message"),
    [
        (np.zeros((3, 4)), {}, "The array of spikes has 2 dimensions"),
        (np.zeros((0, 4, 4)), {}, "The array of spikes is empty"),
        (np.zeros((3, 4, 4)), {}, "The array of spikes holds values of type float64"),
        (np.full((3, 4, 4), 2), {}, "The array of spikes holds values from 2 to 2"),
        (train(3), {"key": 3}, "key is 3; it must be a whole number, from 0 to 2"),
        (train(3), {"key": -1}, "key is -1; it must be a whole number, from 0 to 2"),
        (train(3), {"white_rate": 0.0}, "white_rate is 0.0, but it must be a number from 1e-06"),
        (train(3), {"white_rate": np.nan}, "white_rate is nan"),
    ],
)
def test_what_cannot_be_played_is_refused(playback, spikes, arguments, message):
    with pytest.raises(InputError, match=message):
        playback(spikes, **({"key": 1} | arguments))


@pytest.mark.parametrize(
    ("playback", "arguments", "message"),
    [
        (tfp, {"window": 1000}, "window is 1000; it must be a whole number, from 1 to"),
        (tfp, {"window": 0}, "window is 0; it must be a whole number, from 1 to"),
        (stp, {"history": -1}, "history is -1; it must be a whole number, at least 0"),
        (stp, {"base_release": 0.0}, "base_release is 0.0; it must be a finite number between 0 and 1"),
        (stp, {"facilitation": 1.0}, "facilitation is 1.0; it must be a finite number between 0 and 1"),
        (
            stp,
            {"depression_time": 0.0},
            "depression_time is 0.0; it must be a finite number above 0, in spike frames",
        ),
        (stp, {"facilitation_time": np.inf}, "facilitation_time is inf"),
    ],
)
def test_parameters_that_cannot_be_are_refused(playback, arguments, message):
    with pytest.raises(InputError, match=message):
        playback(train(3), 1, **arguments)


def test_a_real_still_scene_plays_back_as_well_as_a_simulated_one(shared_data):
    """In daylight the real sensor's only noise is the quantisation that the simulator has."""
    path = shared_data / "recordings" / "real_roadside_static.npz"
    if not path.is_file():
        pytest.skip(f"{path} is not on this machine")
    real = np.load(path)["arr_0"].transpose(2, 0, 1)
    simulation = simulate(Static(real.mean(0)), scale=1, frames=len(real), sensor=Sensor(white_rate=1.0))
    for playback in PLAYBACKS:
        error = [
            np.sqrt(np.mean((playback(spikes, 250, white_rate=1.0) - spikes.mean(0)) ** 2))
            for spikes in (real, simulation.spikes)
        ]
        assert error[0] == pytest.approx(error[1], rel=0.03)
