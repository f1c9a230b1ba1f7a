import tracemalloc

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from scsr_opt.camera.scenes import Box, MovingObject, Scene, Static, Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.camera.video import Video
from scsr_opt.errors import InputError


def constant(intensity: float, size: int = 64) -> Static:
    return Static(np.full((size, size), intensity))


def intervals(spikes: np.ndarray) -> np.ndarray:
    trains = spikes.reshape(len(spikes), -1).T
    return np.concatenate([np.diff(np.flatnonzero(train)) for train in trains])


def smooth(size: tuple[int, int], seed: int) -> np.ndarray:
    noise = gaussian_filter(np.random.default_rng(seed).standard_normal(size), 6, mode="mirror")
    return (noise - noise.min()) / np.ptp(noise)


@pytest.mark.parametrize("intensity", [0.031, 0.1, 0.2718, 0.5, 0.6180, 1.0])
@pytest.mark.parametrize("white_rate", [0.6, 0.1])
def test_constant_light_gives_intervals_of_the_two_nearest_lengths_and_the_exact_rate(intensity, white_rate):
    frames = 400
    spikes = simulate(constant(intensity, 24), scale=1, frames=frames, sensor=Sensor(white_rate=white_rate)).spikes
    length = 1 / (white_rate * intensity)  # θ / I
    assert set(np.unique(intervals(spikes))) <= {np.floor(length), np.ceil(length)}
    # The residual is kept: were it thrown away at each spike, the count would fall behind by far more than one.
    assert np.abs(spikes.sum(0) - frames / length).max() < 1 + 1e-9
    assert abs(spikes.mean() - 1 / length) < 3 * 0.5 / np.sqrt(24 * 24) / frames


def test_spikes_are_the_integral_of_changing_light():
    # Eq. 1 at every frame of every pixel: the spikes so far are the whole part of the charge so far.
    scene = Translation(smooth((40, 60), 0), (0.3, -0.7))
    simulation = simulate(scene, scale=2, frames=120, seed=3)
    light = np.stack([scene.frame(float(t)).reshape(20, 2, 30, 2).mean((1, 3)) for t in range(120)])
    ahead = np.cumsum(simulation.spikes, 0) - 0.6 * np.cumsum(light, 0)  # the first charge, less the charge at present
    assert np.ptp(ahead, axis=0).max() < 1 + 1e-9


def test_the_first_charge_is_uniform():
    spikes = simulate(constant(0.5, 100), scale=1, frames=20, sensor=Sensor(white_rate=0.1)).spikes
    assert spikes.any(0).all()
    share = np.bincount(spikes.argmax(0).ravel(), minlength=20) / 10_000
    assert np.abs(share - 1 / 20).max() < 5 * np.sqrt(0.05 * 0.95 / 10_000)


@pytest.mark.parametrize("intensity", [0.25, 0.8])
def test_shot_noise_has_the_variance_of_the_photons(intensity):
    frames, photons, rate = 500, 2.0, 0.1  # a low rate, so that hardly ever two spikes' worth falls into one frame
    sensor = Sensor(photons=photons, white_rate=rate)
    counts = simulate(constant(intensity), scale=1, frames=frames, sensor=sensor).spikes.sum(0)
    # Light of variance I/photons a frame, in spikes; and a uniform phase at the start and the end, 1/12 each.
    variance = rate**2 * frames * intensity / photons + 1 / 6
    assert counts.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / counts.size))
    assert counts.mean() == pytest.approx(rate * frames * intensity, abs=5 * np.sqrt(variance / counts.size))


@pytest.mark.parametrize(("photons", "rate"), [(np.inf, 1.0), (4.0, 0.2)])
def test_dark_charge_has_its_mean_and_its_noise(photons, rate):
    frames, dark = 1500, 0.3
    sensor = Sensor(dark_rate=dark, photons=photons, white_rate=rate)
    counts = simulate(constant(0.0), scale=1, frames=frames, sensor=sensor).spikes.sum(0)
    variance = rate**2 * frames * dark / min(photons, Sensor.DARK_ELECTRONS) + 1 / 6
    assert counts.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / counts.size))
    assert counts.mean() == pytest.approx(rate * frames * dark, abs=5 * np.sqrt(variance / counts.size))
    assert not simulate(constant(0.0), scale=1, frames=200).spikes.any()


def test_shot_noise_and_dark_noise_add_up():
    sensor = Sensor(photons=5.0, dark_rate=0.2, white_rate=0.3)
    counts = simulate(constant(0.3), scale=1, frames=500, sensor=sensor).spikes.sum(0)
    variance = 0.3**2 * 500 * 0.5 / 5 + 1 / 6
    assert counts.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / counts.size))
    assert counts.mean() == pytest.approx(0.3 * 500 * 0.5, abs=5 * np.sqrt(variance / counts.size))


def test_the_gain_spreads_as_asked_and_is_what_the_pixels_do():
    simulation = simulate(constant(0.7), scale=1, frames=400, sensor=Sensor(fixed_pattern=0.06, dark_rate=0.0))
    assert simulation.gain.std() == pytest.approx(0.06, rel=5 / np.sqrt(2 * simulation.gain.size))
    assert simulation.gain.mean() == pytest.approx(1, abs=5 * 0.06 / 64)
    assert np.abs(simulation.spikes.sum(0) - 0.6 * 0.7 * 400 * simulation.gain).max() < 1 + 1e-9
    assert (simulate(constant(0.7), scale=1, frames=2).gain == 1).all()


def test_dead_and_hot_pixels():
    simulation = simulate(constant(0.5), scale=1, frames=50, sensor=Sensor(dead=0.02, hot=0.01))
    assert simulation.dead.sum() == round(0.02 * 64**2)
    assert simulation.hot.sum() == round(0.01 * 64**2)
    assert not (simulation.dead & simulation.hot).any()
    np.testing.assert_array_equal(simulation.bad_pixels, simulation.dead | simulation.hot)
    assert not simulation.spikes[:, simulation.dead].any()
    assert simulation.spikes[:, simulation.hot].all()
    good = simulation.spikes[:, ~simulation.bad_pixels].sum(0)
    assert good.min() >= 14 and good.max() <= 16
    everything = simulate(constant(0.5), scale=1, frames=5, sensor=Sensor(dead=0.3, hot=0.7))
    assert everything.bad_pixels.all()


class Flash(Scene):
    """White up to a moment, then black."""

    def __init__(self, until: float):
        self.size, self.key, self.until = (8, 8), 0.0, until

    def frame(self, t):
        return np.full(self.size, float(t < self.until))

    def velocity(self, t):
        return np.zeros((2, *self.size))


def test_a_saturated_pixel_fires_in_every_frame_and_hoards_nothing():
    spikes = simulate(Flash(30.0), scale=1, frames=60, sensor=Sensor(white_rate=2.5)).spikes
    assert spikes[:30].all()
    assert not spikes[30:].any()
    assert simulate(constant(1.0), scale=1, frames=40, sensor=Sensor(white_rate=1.0)).spikes.all()


def test_a_sensor_pixel_sees_the_mean_over_its_picture_pixels():
    picture = np.random.default_rng(1).random((12, 18))
    rate = simulate(Static(picture), scale=3, frames=2000).spikes.mean(0)
    np.testing.assert_allclose(rate / 0.6, picture.reshape(4, 3, 6, 3).mean((1, 3)), atol=1 / (0.6 * 2000))


def test_the_optics_blur_in_picture_pixels():
    picture = np.zeros((20, 20))
    picture[9:12, 7:9] = 1.0
    rate = simulate(Static(picture), scale=2, frames=2000, sensor=Sensor(psf_sigma=1.5)).spikes.mean(0)
    seen = gaussian_filter(picture, 1.5).reshape(10, 2, 10, 2).mean((1, 3))
    np.testing.assert_allclose(rate / 0.6, seen, atol=1 / (0.6 * 2000))


def test_the_same_seed_gives_the_same_recording():
    sensor = Sensor(photons=50.0, fixed_pattern=0.05, dead=0.01)
    first, again, other = (simulate(constant(0.4), scale=1, frames=20, sensor=sensor, seed=s) for s in (7, 7, 8))
    np.testing.assert_array_equal(first.spikes, again.spikes)
    np.testing.assert_array_equal(first.gain, again.gain)
    assert (first.spikes != other.spikes).any() and (first.gain != other.gain).any()


def test_switching_noise_on_leaves_phase_gain_and_bad_pixels_as_they_were():
    quiet = simulate(constant(0.4), scale=1, frames=3, sensor=Sensor(fixed_pattern=0.05, dead=0.01))
    noisy = simulate(constant(0.4), scale=1, frames=3, sensor=Sensor(fixed_pattern=0.05, dead=0.01, photons=1e6))
    np.testing.assert_array_equal(quiet.gain, noisy.gain)
    np.testing.assert_array_equal(quiet.dead, noisy.dead)
    assert (quiet.spikes != noisy.spikes).mean() < 0.01


def test_the_truth_is_the_sharp_picture_and_a_part_pixel_at_the_edge_is_left_out():
    picture = smooth((31, 47), 2)
    simulation = simulate(Static(picture), scale=4, frames=5, sensor=Sensor(psf_sigma=2.0))
    assert simulation.spikes.shape == (5, 7, 11)
    assert simulation.spikes.dtype == np.uint8
    np.testing.assert_array_equal(simulation.truth(2.0), picture[:28, :44])
    assert simulation.velocity(2.0).shape == (2, 7, 11)
    assert simulation.white_rate == 0.6


def test_the_velocity_is_in_sensor_pixels_and_of_one_surface():
    scene = MovingObject(
        smooth((40, 40), 3), smooth((30, 30), 4), (2.0, -6.0), shape=Box(7.3, 5.6), position=(20.2, 19.1), key=0.0
    )
    simulation = simulate(scene, scale=4, frames=2)
    velocity = simulation.velocity(0.0)
    pairs = {tuple(pair) for pair in velocity.reshape(2, -1).T.tolist()}
    assert pairs == {(0.0, 0.0), (0.5, -1.5)}  # never a mixture at the edge
    covered = scene.surface(0.0).reshape(10, 4, 10, 4).sum((1, 3))
    assert ((covered > 0) & (covered < 16)).any()
    np.testing.assert_array_equal(velocity[0] == 0.5, covered >= 8)
    np.testing.assert_array_equal(simulate(Translation(smooth((9, 9), 0), (1, 2)), scale=3).velocity(5.0)[1], 2 / 3)


def test_the_pictures_are_not_all_kept():
    class Blank(Flash):
        def __init__(self):
            super().__init__(0.0)
            self.size = (256, 256)

    tracemalloc.start()
    spikes = simulate(Blank(), scale=8, frames=300).spikes
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * 256 * 256 * 8 + spikes.nbytes


def test_progress_is_told_of_every_frame_and_of_the_end_even_when_it_fails():
    class Notes(list):
        def start(self, total, what):
            self.append(("start", total, what))

        def advance(self, done):
            self.append(done)

        def finish(self):
            self.append("finish")

    notes = Notes()
    simulate(constant(0.5, 8), scale=1, frames=3, progress=notes)
    assert notes == [("start", 3, "Simulating"), 1, 1, 1, "finish"]

    class Torn(Flash):
        def frame(self, t):
            raise RuntimeError("torn")

    notes = Notes()
    with pytest.raises(RuntimeError, match="torn"):
        simulate(Torn(0.0), scale=1, frames=3, progress=notes)
    assert notes[-1] == "finish"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"white_rate": 0.0}, "white_rate is 0.0, but it must be a number from 1e-06"),
        ({"white_rate": np.inf}, "white_rate is inf"),
        ({"photons": -1.0}, "photons is -1.0; it must be a finite number from 1e-06"),
        ({"photons": np.nan}, "photons is nan"),
        ({"dark_rate": -0.1}, "dark_rate is -0.1; it must be a finite number from 0 to 1e\\+06"),
        ({"fixed_pattern": 1.0}, "fixed_pattern is 1.0; it must be a finite number from 0 to below 1"),
        ({"dead": 1.5}, "dead is 1.5; it must be a finite number from 0 to 1, a share"),
        ({"hot": -0.5}, "hot is -0.5; it must be a finite number from 0 to 1, a share"),
        ({"dead": 0.6, "hot": 0.6}, "dead = 0.6 and hot = 0.6 are more than all pixels"),
        ({"photons": 1e300}, r"photons is 1e\+300; it must be a finite number from 1e-06 to 1e\+12"),
        ({"dark_rate": 1e300}, r"dark_rate is 1e\+300"),
        ({"white_rate": 1e-40}, "white_rate is 1e-40"),
        ({"psf_sigma": -1.0}, "psf_sigma is -1.0; it must be a finite number of at least 0, in HR pixels"),
    ],
)
def test_a_sensor_that_cannot_be_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        Sensor(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scale": 0}, "scale is 0; it must be a whole number, at least 1"),
        ({"scale": 1, "frames": 0}, "frames is 0; it must be a whole number, at least 1"),
        ({"scale": 1, "seed": -1}, "seed is -1; it must be a whole number, at least 0"),
        ({"scale": 100}, "64 rows and 64 columns, which is less than one sensor pixel at scale 100"),
    ],
)
def test_arguments_that_cannot_be_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        simulate(constant(0.5), **arguments)


def test_more_frames_than_a_video_lasts_are_refused_before_any_work():
    video = Video(np.zeros((3, 8, 8)), readouts_per_frame=10.0)
    assert len(simulate(video, scale=1, frames=21).spikes) == 21
    with pytest.raises(InputError, match="22 frames were asked for, but the scene is known from spike frame 0 to 20"):
        simulate(video, scale=1, frames=22)


def test_the_threshold_is_the_inverse_of_the_white_rate():
    assert Sensor(white_rate=0.25).threshold == 4.0
