"""Maps of a camera, against those that its recordings were made with."""

import numpy as np
import pytest

from scsr_opt import InputError, Options, reconstruct
from scsr_opt.calibration.bad_pixels import PixelKind
from scsr_opt.camera import Recording
from scsr_opt.motion import Motion
from scsr_opt.pipeline.camera_calibration import calibrate

SHAPE, RATE, FRAMES = (24, 32), 0.6, 400
RNG = np.random.default_rng(0)
GAIN = np.clip(RNG.normal(1, 0.05, SHAPE), 0.8, 1.2)
DARK = np.clip(RNG.normal(0.02, 0.004, SHAPE), 0, None)
DEAD, HOT = (5, 7), (15, 20)


def recorded(light: np.ndarray, frames: int = FRAMES, seed: int = 1) -> Recording:
    """What a camera with these maps records of a scene at rest."""
    rate = RATE * light * GAIN + DARK
    rate[DEAD], rate[HOT] = 0, 0.8
    charge = np.random.default_rng(seed).random(SHAPE) + rate * np.arange(frames + 1)[:, None, None]
    return Recording.from_array(np.diff(np.floor(charge), axis=0).astype(np.uint8), white_rate=RATE)


@pytest.fixture(scope="module")
def maps():
    even = recorded(np.full(SHAPE, 0.5))
    return calibrate(flat=[even, even], dark=[recorded(np.zeros(SHAPE), 2000)])


def test_calibrate_finds_gains_dark_level_and_bad_pixels(maps):
    good = ~maps.bad.mask
    assert maps.bad.kind[DEAD] == PixelKind.DEAD and maps.bad.kind[HOT] == PixelKind.HOT and (~good).sum() == 2
    assert np.abs(maps.dark - DARK)[good].max() < 1e-3
    error = (maps.gain / GAIN)[good]
    assert error.std() < 0.02 and np.std(GAIN) > 0.04  # a median over 15×15 gains is good to 1 %
    assert maps.gain[DEAD] == maps.gain[HOT] == 1 and maps.dark[HOT] == 0


def test_calibration_takes_dark_level_and_pattern_out_of_a_picture(maps):
    light = 0.3 + 0.2 * np.sin(np.arange(SHAPE[1]) / 4) * np.ones(SHAPE)
    options = Options(motion=Motion.none(*SHAPE), strength=1e-4, frames=FRAMES, bad_pixels=None)
    seen = recorded(light, seed=2)
    raw = reconstruct(seen, scale=1, options=options, gain=None).image
    better = reconstruct(maps.applied(seen), scale=1, options=options, gain=maps.gain, dark=maps.dark).image
    good = ~maps.bad.mask
    wrong, left = (np.abs(image - light)[good].mean() for image in (raw, better))
    assert wrong > 0.03 and left < 0.01 and np.mean((better - light)[good]) == pytest.approx(0, abs=3e-3)


def test_calibrate_refuses_nothing_and_different_sensors():
    with pytest.raises(InputError, match="There is no recording"):
        calibrate()
    with pytest.raises(InputError, match="calibrate one camera at a time"):
        calibrate(flat=[recorded(np.full(SHAPE, 0.5), 20)], dark=[Recording.from_array(np.zeros((5, 4, 4), np.uint8))])


@pytest.mark.parametrize(
    ("dark", "message"), [(np.ones((2, 2)), "dark is an array"), (np.ones(SHAPE), "from 0 to below")]
)
def test_dark_that_cannot_be_used_is_refused(dark, message):
    with pytest.raises(InputError, match=message):
        reconstruct(recorded(np.full(SHAPE, 0.5), 20), scale=1, dark=dark)
