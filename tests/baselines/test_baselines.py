"""Properties that all baselines have in common, and those that each of them claims."""

import re
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from skimage import data
from skimage.restoration import denoise_tv_chambolle

import scsr_opt.baselines as baselines
from scsr_opt.baselines import (
    BASELINES,
    conventional_camera,
    mgsr,
    shift_and_add,
    stp_bicubic,
    tfi_bicubic,
    tfp_bicubic,
)
from scsr_opt.baselines.motion_guided import _splat
from scsr_opt.baselines.settings import DEFAULT
from scsr_opt.baselines.single_image import noise_level
from scsr_opt.camera import Recording, Sensor, Simulation, Static, Translation, simulate, stp, tfi, tfp
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.errors import InputError
from scsr_opt.motion import Motion
from scsr_opt.report import bicubic

EVERY = pytest.mark.parametrize("name", BASELINES)
MULTI_FRAME = ("shift_and_add", "mgsr")
PICTURE = data.camera()[90:186, 150:246]
VELOCITY = (0.1, -0.15)  # sensor pixels per frame


@cache
def moving(scale: int) -> Simulation:
    """96x96 picture pixels; over 61 frames they move by 6 and 9 sensor pixels."""
    scene = Translation(PICTURE, velocity=(VELOCITY[0] * scale, VELOCITY[1] * scale), key=30)
    return simulate(scene, scale=scale, frames=61, sensor=Sensor(photons=1000.0), seed=3)


def picture(name: str, spikes, **arguments) -> np.ndarray:
    """A baseline's picture at scale 2 (one scale, so that everything is compiled once), the motion known."""
    known = {"motion": Motion.constant(VELOCITY, spikes.shape[1:])} if name in MULTI_FRAME else {}
    return BASELINES[name](spikes, **{"scale": 2, **known, **arguments})


@cache
def usual(name: str) -> np.ndarray:
    """Of the moving scene, with nothing given but the motion."""
    return picture(name, moving(2).spikes)


def test_the_registry_holds_the_functions_by_their_names():
    assert all(getattr(baselines, name) is function for name, function in BASELINES.items())
    assert {"tfp_bicubic", "tfp_sr", "shift_and_add", "conventional_camera", "mgsr"} <= set(BASELINES)


@EVERY
def test_constant_light_comes_back(name):
    spikes = simulate(Static(np.full((96, 96), 0.4)), scale=2, frames=61, seed=1).spikes
    image = picture(name, spikes)
    assert image.shape == (96, 96) and image.dtype == np.float32
    # Spikes are counted in whole frames: on average over 2304 pixels that cancels to well under a percent. The largest
    # bias is that of the 8 bits, 0.5 / 255.
    assert image.mean() == pytest.approx(0.4, rel=0.015)


@EVERY
def test_a_recording_is_taken_as_an_array_is_and_defaults_are_the_middle_and_its_own_rate(name):
    spikes = moving(2).spikes
    expected = picture(name, spikes, key=30, white_rate=0.6)
    np.testing.assert_array_equal(usual(name), expected)
    np.testing.assert_array_equal(picture(name, Recording.from_array(spikes)), expected)
    other = picture(name, Recording.from_array(spikes, white_rate=0.9))
    np.testing.assert_array_equal(other, picture(name, spikes, white_rate=0.9))
    # Everything is measured in units of 1/white_rate, the strengths included; only the 8 bits are not.
    tolerance = 1 / 255 if name == "conventional_camera" else 2e-3
    off = np.abs(other - expected / 1.5)
    # Whether a sample lies within the picture is decided by rounding at its edge: single pixels there may differ more.
    assert np.mean(off > tolerance) < 1e-3 and off.max() < 2 * tolerance


@EVERY
def test_bad_pixels_are_not_used(name):
    made = moving(2)
    bad = np.random.default_rng(0).random(made.spikes.shape[1:]) < 0.05
    dead, hot = made.spikes.copy(), made.spikes.copy()
    dead[:, bad], hot[:, bad] = 0, 1
    first, second = (picture(name, Recording.from_array(s, bad_pixels=bad)) for s in (dead, hot))
    np.testing.assert_array_equal(first, second)
    truth = made.truth(30.0)
    # 5 % of the pixels, filled in from their neighbours, are worth a few tenths of a decibel; black ones cost several.
    assert psnr(truth, first, 8) > psnr(truth, usual(name), 8) - 1


@EVERY
@pytest.mark.parametrize("value", [0, 1])
def test_blank_and_tiny_recordings(name, value):
    image = BASELINES[name](np.full((7, 1, 5), value, np.uint8), scale=3)
    assert image.shape == (3, 15) and np.isfinite(image).all()
    if value:  # a spike in every frame: light of 1/white_rate; the conventional camera is overexposed
        expected = 1 if name == "conventional_camera" else 1 / 0.6
        np.testing.assert_allclose(image, expected, rtol=1e-3)


@EVERY
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": 0}, "scale is 0; it must be a whole number, at least 1."),
        ({"key": 31}, "key is 31; it must be a whole number, from 0 to 30."),
        ({"white_rate": 0}, "white_rate is 0, but it must be a number from 1e-06 to 1000, in spikes per frame"),
        ({"white_rate": float("nan")}, "white_rate is nan, but it must be"),
        ({"spikes": np.full((31, 8, 9), 2, np.uint8)}, "0 and 1"),
        ({"spikes": np.zeros((8, 9), np.uint8)}, "dimensions"),
    ],
)
def test_what_cannot_be_used_is_said(name, change, message):
    arguments = {"spikes": np.zeros((31, 8, 9), np.uint8), "scale": 2, **change}
    with pytest.raises(InputError, match=re.escape(message)):
        BASELINES[name](arguments.pop("spikes"), **arguments)


@pytest.mark.parametrize(
    ("function", "playback"), [(tfp_bicubic, tfp), (tfi_bicubic, tfi), (stp_bicubic, stp)], ids=["tfp", "tfi", "stp"]
)
@pytest.mark.parametrize("key", [0, 20, 60])
def test_playbacks_are_those_of_the_camera_enlarged(function, playback, key):
    spikes = moving(3).spikes
    expected = bicubic(playback(spikes, key, white_rate=0.5), 3)
    np.testing.assert_array_equal(function(spikes, scale=3, key=key, white_rate=0.5), expected)


def test_single_image_is_the_minimiser_of_its_problem():
    """The objective is convex: at its minimiser it rises in every direction, be it smoother, sharper or any other."""
    spikes = moving(2).spikes
    playback = tfp(spikes, 30)
    strength = DEFAULT.single_image_noise_factor * noise_level(playback)

    def objective(image: np.ndarray) -> float:
        seen = image.reshape(48, 2, 48, 2).mean((1, 3))
        down, right = np.zeros((2, 96, 96))
        down[:-1], right[:, :-1] = np.diff(image, axis=0), np.diff(image, axis=1)
        return 0.5 * np.sum((seen - playback) ** 2) + strength * np.hypot(down, right).sum()

    image = picture("tfp_sr", spikes).astype(np.float64)
    least = objective(image)
    smoother = denoise_tv_chambolle(image, weight=strength, eps=0, max_num_iter=500) - image
    noise = 0.01 * np.random.default_rng(0).standard_normal(image.shape)
    # The solve is stopped within about 1e-3 of the minimum; half or double the strength is ten times that off.
    for change in (smoother, -smoother, noise, bicubic(playback, 2) - image):
        assert objective(image + 0.3 * change) > least * (1 - 1e-3)
    assert least < 0.9 * objective(bicubic(playback, 2).astype(np.float64))


def test_noise_level_is_that_of_the_noise():
    rng = np.random.default_rng(1)
    plane = np.add.outer(np.arange(200) * 0.01, np.arange(200) * 0.02)
    # The mean of 40,000 responses, which overlap: within 2 %.
    assert noise_level((plane + 0.05 * rng.standard_normal(plane.shape)).astype(np.float32)) == pytest.approx(
        0.05, rel=0.03
    )
    assert noise_level(plane.astype(np.float32)) < 1e-5


@pytest.mark.parametrize("name", ["tfp", "tfi", "stp"])
def test_single_image_takes_out_noise_between_edges(name):
    """Squares of one grey each, 24 pixels wide: what total variation is for."""
    squares = np.kron(np.random.default_rng(4).uniform(0.2, 0.9, (4, 4)), np.ones((24, 24)))
    made = simulate(Static(squares), scale=2, frames=61, sensor=Sensor(photons=1000.0), seed=1)
    score = {kind: psnr(squares, picture(f"{name}_{kind}", made.spikes), 8) for kind in ("bicubic", "sr")}
    assert score["sr"] > score["bicubic"] + 1


def test_values_are_put_where_they_belong():
    rng = np.random.default_rng(2)
    position, values = rng.uniform(-1, 6, (2, 50)), rng.standard_normal((3, 50))
    rows, columns = np.arange(5)[:, None], np.arange(6)[None, :]
    expected = np.zeros((3, 5, 6))
    for (row, column), value in zip(position.T, values.T, strict=True):
        if 0 <= row <= 4 and 0 <= column <= 5:
            tap = np.maximum(1 - abs(rows - row), 0) * np.maximum(1 - abs(columns - column), 0)
            expected += value[:, None, None] * tap
    np.testing.assert_allclose(_splat(position, values, (5, 6)), expected, atol=1e-12)


def test_shift_and_add_gives_the_picture_as_a_pixel_blurs_it():
    made = moving(3)
    blurred = uniform_filter(made.truth(30.0), 3, mode="nearest")
    image = shift_and_add(made.spikes, scale=3, motion=Motion.constant(VELOCITY, made.spikes.shape[1:]))
    # Beside the aperture there is the bilinear weight and the motion during an interval, half a pixel each.
    assert psnr(blurred, image, 12) > 30
    assert psnr(blurred, image, 12) > psnr(blurred, tfp_bicubic(made.spikes, scale=3), 12) + 4
    # A pixel aside it fits worse, on either side alike: it is not displaced.
    for axis in (0, 1):
        before, here, after = (
            np.square(np.roll(image, shift, axis) - blurred)[12:-12, 12:-12].mean() for shift in (-1, 0, 1)
        )
        assert here < min(before, after) and max(before, after) < 1.5 * min(before, after)


def test_shift_and_add_closes_holes():
    """At rest and ×4, a quarter of the pixels are near a measurement; the others lie between the values around them."""
    spikes = simulate(Static(PICTURE), scale=4, frames=61, seed=1).spikes
    image = shift_and_add(spikes, scale=4, motion=Motion.none(*spikes.shape[1:]))
    truth = simulate(Static(PICTURE), scale=4, frames=61, seed=1).truth(30.0)
    assert psnr(truth, image, 16) > psnr(truth, tfp_bicubic(spikes, scale=4), 16) - 0.5
    assert 0 <= image.min() and image.max() <= 1 / 0.6


def test_motion_guided_is_sharper_than_shift_and_add_and_that_than_playback():
    made = moving(2)
    truth = made.truth(30.0)
    scores = [psnr(truth, usual(name), 8) for name in ("tfp_sr", "shift_and_add", "mgsr")]
    assert scores[0] + 2 < scores[1] < scores[2] - 1  # measured: see docs/baselines.md
    found = mgsr(made.spikes, scale=2)
    assert psnr(truth, found, 8) > scores[2] - 0.3  # the motion is found


def exposed(made: Simulation, frames: range) -> np.ndarray:
    """The mean light of the frames, as the sensor's pixels see it."""
    light = np.mean([made.truth(float(t)) for t in frames], axis=0)
    return light.reshape(48, 2, 48, 2).mean((1, 3))


def test_the_conventional_camera_sees_all_light_of_its_exposure():
    made = moving(2)
    image = conventional_camera(made.spikes, scale=1, exposure=41 / 40_000)
    np.testing.assert_allclose(image * 255, np.rint(image * 255), atol=1e-4)
    expected = np.clip(exposed(made, range(10, 51)), 0, 1)
    # The times of the spikes are read out in whole frames: at either end the light of up to half a frame of 41 is
    # uncertain, 0.3/41 in the root mean square, and the photons' noise is √(1/(1000·41)).
    assert np.sqrt(np.mean((image - expected) ** 2)) < 0.015
    short = conventional_camera(made.spikes, scale=1, exposure=5 / 40_000)
    assert np.abs(short - exposed(made, range(28, 33))).mean() < np.abs(image - exposed(made, range(28, 33))).mean()


def test_the_exposure_is_in_seconds():
    spikes = moving(2).spikes
    slow = Recording.from_array(spikes, readout_rate=20_000)
    np.testing.assert_array_equal(
        conventional_camera(slow, scale=2, exposure=0.001), conventional_camera(spikes, scale=2, exposure=0.0005)
    )
    # 1/120 s are more frames than there are: what is there.
    np.testing.assert_array_equal(
        conventional_camera(spikes, scale=2), conventional_camera(spikes, scale=2, exposure=61 / 40_000)
    )


def test_read_noise_has_its_size_and_its_seed():
    spikes = simulate(Static(np.full((96, 96), 0.5)), scale=1, frames=61, seed=1).spikes
    clean, noisy = (conventional_camera(spikes, scale=1, read_noise=noise) for noise in (0.0, 5.0))
    assert np.std((noisy - clean) * 255) == pytest.approx(5, rel=0.05)  # of 9216 pixels: 0.7 % would be chance
    np.testing.assert_array_equal(noisy, conventional_camera(spikes, scale=1, read_noise=5.0))
    assert not np.array_equal(noisy, conventional_camera(spikes, scale=1, read_noise=5.0, seed=1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"exposure": 0.002}, "exposure is 0.002 s, 80 frames, but only 31 lie around the key frame: ask for at most"),
        ({"exposure": 0.0005, "key": 2}, "but only 5 lie around the key frame"),
        ({"exposure": -1.0}, "exposure is -1.0; it must be a finite number above 0, in seconds."),
        ({"read_noise": float("nan")}, "read_noise is nan; it must be a finite number of at least 0"),
    ],
)
def test_what_a_conventional_camera_cannot_do_is_said(change, message):
    with pytest.raises(InputError, match=re.escape(message)):
        conventional_camera(np.zeros((31, 8, 9), np.uint8), scale=2, **change)
