"""`reconstruct`: the whole path, its defaults, its errors; and what it is held to on recordings with a known answer."""

import re

import numpy as np
import pytest
from skimage import data
from skimage.io import imread

from scsr_opt import InputError, Recording, SolveError, Status, reconstruct
from scsr_opt.camera import Sensor, Windows, read_recording, simulate, tfp
from scsr_opt.camera.scenes import MovingObject, Static, Translation
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.motion import Motion, Still
from scsr_opt.priors import RED, Bounded, NumpyDenoiser, PlugAndPlay, nl_means
from scsr_opt.report import bicubic
from scsr_opt.solvers import FISTA

PICTURE = data.camera()[90:250, 150:310]


def moving(scale: int, frames: int = 61):
    """48×48 sensor pixels (at ×8 20×20) before which a picture pans by 0.11 and 0.17 sensor pixels per frame."""
    scene = Translation(PICTURE[: 48 * scale, : 48 * scale], velocity=(0.11 * scale, -0.17 * scale), key=frames // 2)
    return simulate(scene, scale=scale, frames=frames, sensor=Sensor(photons=1000.0), seed=3)


# Scale 2 is that of most tests here, and scale 1 that of the recording's settings, below.
@pytest.mark.parametrize("scale", [pytest.param(1, marks=pytest.mark.slow), 3, pytest.param(8, marks=pytest.mark.slow)])
def test_every_scale_beats_enlarged_playback(scale):
    made = moving(scale)
    solution = reconstruct(made.spikes, scale=scale)
    height, width = made.spikes.shape[1:]
    assert solution.image.shape == (scale * height, scale * width) and solution.image.dtype == np.float32
    assert solution.status is Status.converged and solution.velocity is not None
    truth = made.truth(30)
    border = 4 * scale
    playback = bicubic(tfp(made.spikes, 30, window=21), scale)
    # Playback is blurred by 3.5 sensor pixels of motion; a decibel is far less than what undoing that brings.
    assert psnr(truth, solution.image, border) > psnr(truth, playback, border) + 1
    assert np.median(np.abs(solution.velocity - np.array([0.11, -0.17])[:, None, None])) < 0.01


def test_a_scene_at_rest_has_no_motion_and_few_samples():
    """One of all intervals of a pixel, and one for either end."""
    made = simulate(Static(PICTURE[:96, :96]), scale=2, frames=101, sensor=Sensor(photons=1000.0), seed=1)
    solution = reconstruct(made.spikes, scale=2)
    assert solution.velocity is not None and not solution.velocity.any()
    assert solution.diagnostics.samples <= 3 * made.spikes[0].size and solution.diagnostics.positions == 1


def test_reconstruct_object_before_a_background_is_in_layers():
    """Layers: both are sharper than with one velocity for all, and the background next to the object is not smeared."""
    scene = MovingObject(PICTURE, data.brick()[:60, :60], velocity=(0.3, 0.5))
    made = simulate(scene, scale=2, frames=101, sensor=Sensor(photons=1000.0), seed=2)
    truth = made.truth(50)
    score = psnr(truth, reconstruct(made.spikes, scale=2).image, 8)
    assert score > psnr(truth, reconstruct(made.spikes, scale=2, motion=Still()).image, 8) + 2
    assert score > psnr(truth, bicubic(tfp(made.spikes, 50), 2), 8) + 1


def test_bad_pixels_are_not_used():
    """Whatever a bad pixel fires, the picture is the same to the last bit; and dead pixels leave no holes."""
    made = moving(2)
    bad = np.random.default_rng(0).random(made.spikes.shape[1:]) < 0.05
    dead, hot = made.spikes.copy(), made.spikes.copy()
    dead[:, bad], hot[:, bad] = 0, 1
    pictures = [reconstruct(spikes, scale=2, bad_pixels=bad).image for spikes in (dead, hot)]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[0], reconstruct(hot, scale=2, bad_pixels=bad.astype(np.uint8)).image)
    assert hot[:, bad].all()  # the caller's array is as it was
    truth = made.truth(30)
    whole = reconstruct(made.spikes, scale=2).image
    assert psnr(truth, pictures[0], 8) > psnr(truth, whole, 8) - 1
    assert psnr(truth, reconstruct(dead, scale=2).image, 8) < psnr(truth, pictures[0], 8)


def test_bad_pixels_of_the_recording_count_too():
    made = moving(2)
    bad = np.zeros(made.spikes.shape[1:], bool)
    bad[10:20, 10:20] = True
    known = Recording.from_array(made.spikes, bad_pixels=bad)
    np.testing.assert_array_equal(
        reconstruct(known, scale=2).image, reconstruct(made.spikes, scale=2, bad_pixels=bad).image
    )


def test_settings_of_the_recording_are_taken():
    made = moving(2)
    half = Recording.from_array(made.spikes, white_rate=1.2)
    assert np.median(reconstruct(half, scale=1).image) == pytest.approx(np.median(made.truth(30)) / 2, rel=0.05)
    assert np.median(reconstruct(half, scale=1, white_rate=0.6).image) == pytest.approx(
        np.median(made.truth(30)), rel=0.05
    )


def test_reconstruct_more_noise_or_fewer_frames_have_a_greater_strength():
    def strength(frames: int, photons: float) -> float:
        scene = Translation(PICTURE[:96, :96], velocity=(0.1, 0.2), key=frames // 2)
        made = simulate(scene, scale=2, frames=frames, sensor=Sensor(photons=photons), seed=4)
        motion = Motion.constant((0.05, 0.1), made.spikes.shape[1:])
        λ = reconstruct(made.spikes, scale=2, motion=motion, solver=FISTA(1)).diagnostics.strength
        assert λ is not None
        return λ

    assert strength(101, 30.0) > 1.2 * strength(101, 1000.0)
    assert strength(25, 1000.0) > 1.5 * strength(101, 1000.0)


def test_only_frames_around_the_key_are_read():
    made = moving(2)
    first = reconstruct(made.spikes, scale=2, key=20, frames=31)
    second = reconstruct(made.spikes[5:36], scale=2, key=15)
    np.testing.assert_array_equal(first.image, second.image)


def test_stages_are_numbered_through_and_carry_pictures_when_asked():
    made = moving(2, frames=21)
    solution = reconstruct(made.spikes, scale=2, keep_images=True, solver=FISTA(iterations=6, tolerance=0))
    assert [stage.number for stage in solution.stages] == list(range(1, len(solution.stages) + 1))
    assert all(stage.objective == stage.data + stage.prior for stage in solution.stages)
    np.testing.assert_array_equal(solution.stages[-1].image, solution.image)
    assert solution.stages[-1].gradient_step is not None
    assert solution.status is Status.iterations_exhausted


@pytest.mark.parametrize(
    "shape", [(1, 1, 1), (40, 1, 30), pytest.param((101, 1, 1), marks=pytest.mark.slow), (2, 4, 4)]
)
@pytest.mark.parametrize("value", [0, 1])
def test_blank_and_tiny_recordings(shape, value):
    """No spike: nothing is known. A spike in every frame: light of 1/white_rate at least."""
    solution = reconstruct(np.full(shape, value, np.uint8), scale=3)
    assert solution.image.shape == (3 * shape[1], 3 * shape[2]) and np.isfinite(solution.image).all()
    if value == 0:
        assert solution.status is Status.no_samples and not solution.status.usable
    else:
        np.testing.assert_allclose(solution.image, 1 / 0.6, rtol=1e-3)


def test_nothing_left_when_every_pixel_is_bad():
    spikes = moving(2).spikes
    solution = reconstruct(spikes, scale=2, bad_pixels=np.ones(spikes.shape[1:], bool))
    assert solution.status is Status.no_samples


def test_reconstruct_samples_that_all_leave_the_picture_gives_no_samples():
    spikes = moving(2).spikes
    solution = reconstruct(spikes, scale=2, motion=Motion.constant((1e6, 1e6), spikes.shape[1:]))
    assert solution.status is Status.no_samples and not solution.image.any()
    with pytest.raises(SolveError, match="holds no usable sample"):
        reconstruct(spikes, scale=2, motion=solution.motion, throw=True)


@pytest.mark.parametrize("shape", [(2, 2), (5, 7)])
def test_small_sensors_before_which_something_moves(shape):
    """Too few pixels for any layer."""
    wave = np.sin(np.arange(60)[:, None] / 2) * np.cos(np.arange(60) / 3)
    height, width = shape
    for speed in (0.1, 0.3):
        at = [int(speed * t) for t in range(60)]
        light = np.stack([0.5 + 0.5 * wave[k : k + height, 2 * k : 2 * k + width] for k in at])
        total = np.cumsum(0.6 * light, 0)
        spikes = np.diff(np.floor(total), axis=0, prepend=0).astype(np.uint8)
        solution = reconstruct(spikes, scale=2)
        assert solution.image.shape == (2 * height, 2 * width) and np.isfinite(solution.image).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": 0}, "scale is 0; it must be a whole number, at least 1."),
        ({"scale": True}, "scale is True; it must be a whole number, at least 1."),
        ({"key": False}, "key is False; it must be a whole number, from 0 to 30."),
        ({"key": 31}, "key is 31; it must be a whole number, from 0 to 30."),
        ({"frames": 0}, "frames is 0; it must be a whole number, at least 1."),
        ({"white_rate": 0}, "white_rate is 0, but it must be a number from 1e-06 to 1000, in spikes per frame"),
        ({"strength": -1.0}, "strength is -1.0; it must be a finite number from 0 to 1e+18."),
        ({"strength": float("nan")}, "strength is nan; it must be a finite number from 0 to 1e+18."),
        ({"strength": 1e38}, "strength is 1e+38; it must be a finite number from 0 to 1e+18."),
        ({"strength": np.complex64(1j)}, "it must be a finite number from 0 to 1e+18."),
        ({"prior": PlugAndPlay(nl_means())}, "No strength is given, and PlugAndPlay has no relative_strength"),
        ({"prior": Bounded(PlugAndPlay(nl_means()))}, "No strength is given, and Bounded has no relative_strength"),
        (
            {"prior": RED(NumpyDenoiser(lambda image, sigma: image[:4]))},
            "The denoiser gave float32 of shape (4, 18) for a picture of shape (16, 18); it must give a float array",
        ),
        (
            {"prior": Bounded(PlugAndPlay(lambda image, sigma: image > 0)), "strength": 1e-3},
            "The denoiser gave bool of shape (16, 18) for a picture of shape (16, 18); it must give a float array",
        ),
        ({"bad_pixels": np.zeros((2, 2), bool)}, "bad_pixels has shape (2, 2), but the sensor has 8 rows"),
        ({"bad_pixels": np.full((8, 9), 2)}, "bad_pixels holds values from 2 to 2"),
        ({"refine": -1}, "refine is -1; it must be a whole number, at least 0."),
        ({"gain": "sharp"}, "gain is 'sharp'; it must be 'auto', 'blind' or one gain for each pixel, (8, 9)."),
        ({"gain": np.ones((9, 8))}, "gain is an array of shape (9, 8); it must be 'auto', 'blind'"),
        ({"gain": np.full((8, 9), 1 + 1j)}, "gain is a complex array of shape (8, 9); it must be 'auto', 'blind'"),
        ({"gain": 1j}, "gain is 1j; it must be 'auto', 'blind' or one gain for each pixel, (8, 9)."),
        ({"gain": np.zeros((8, 9))}, "gain holds 72 values that are not finite and above 0; mark such pixels"),
        ({"samples": Windows(32)}, "windows of 32 frames do not fit a recording of 31"),
        ({"motion": Motion.none(3, 3)}, "motion.velocity has shape (2, 3, 3); for this recording it must be (2, 8, 9)"),
        (
            {"motion": Motion.of_velocity(np.full((2, 8, 9), np.nan))},
            "motion.velocity holds values that are not finite",
        ),
        ({"motion": Motion.constant((1e7, 0), (8, 9))}, "motion.velocity holds values above 1e+06 sensor pixels"),
        ({"white_rate": 1e-40}, "white_rate is 1e-40, but it must be a number from 1e-06 to 1000"),
        ({"spikes": np.full((31, 8, 9), 2, np.uint8)}, "0 and 1"),
        ({"spikes": np.zeros((8, 9), np.uint8)}, "dimensions"),
    ],
)
def test_reconstruct_option_that_cannot_be_used_is_refused(change, message):
    arguments = {"spikes": np.zeros((31, 8, 9), np.uint8), "scale": 2, **change}
    with pytest.raises(InputError, match=re.escape(message)):
        reconstruct(arguments.pop("spikes"), **arguments)


def test_the_share_of_saturated_pixels_is_known():
    """Where a pixel fires in every frame the picture is a lower bound, which bad pixels say nothing of."""
    spikes = (np.arange(31)[:, None, None] % 2 == np.zeros((8, 10), int)).astype(np.uint8)
    spikes[:, :, 5:] = 1
    assert reconstruct(spikes, scale=1).diagnostics.saturated == 0.5
    bad = np.zeros((8, 10), bool)
    bad[:, 5:] = True
    assert reconstruct(spikes, scale=1, bad_pixels=bad).diagnostics.saturated == 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "floor"), [("reds_200", 37.4), ("reds_203", 34.7)])
@pytest.mark.parametrize("frames", [101, 301])
def test_video_of_a_known_answer_at_sensor_resolution(shared_data, name, floor, frames):
    """Also of three times as many frames, over which no velocity and acceleration hold: 35.3 and 33.4 without a
    reach."""
    folder = shared_data / "recordings"
    recording = read_recording(folder / f"{name}_part1_400x250_key150.dat")
    truth = imread(folder / f"{name}_part1_key150_groundtruth.png") / 255
    image = np.clip(reconstruct(recording, scale=1, key=150, frames=frames).image, 0, 1)
    assert -10 * np.log10(np.mean((image - truth) ** 2)) >= floor


@pytest.mark.parametrize("key", [0, 30])
def test_noise_is_not_taken_for_motion(key):
    """Spikes drawn anew in every frame contradict any motion; none of the richer ones may be believed for that."""
    spikes = (np.random.default_rng(0).random((60, 24, 30)) < 0.3).astype(np.uint8)
    solution = reconstruct(spikes, scale=2, key=key)
    assert (solution.diagnostics.speed_max or 0) < 0.5  # it was 29 before motions had to explain something
    assert solution.image.mean() == pytest.approx(0.5, rel=0.1)
