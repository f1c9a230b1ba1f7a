"""White of pictures and films, against the light that recordings were made of."""

import numpy as np
import pytest

from scsr_opt.camera.recording import Recording
from scsr_opt.camera.white import White, find_white, find_white_around, white_of
from scsr_opt.errors import InputError

FRAMES, SHAPE, RATE = 100, (40, 50), 0.6
RAMP = np.linspace(0.01, 1.0, SHAPE[1]) * np.ones(SHAPE)


def fired(light: np.ndarray, frames: int = FRAMES, seed: int = 0) -> np.ndarray:
    """Spikes of an ideal camera that sees `light`, (h, w), at 0.6 spikes per frame of white."""
    charge = np.random.default_rng(seed).random(light.shape) + RATE * light * np.arange(frames + 1)[:, None, None]
    return np.minimum(np.diff(np.floor(charge), axis=0), 1).astype(np.uint8)


def found(light: np.ndarray, bad: np.ndarray | None = None) -> White:
    spikes = fired(light)
    return find_white(lambda start, stop: spikes[start:stop], FRAMES, white_rate=RATE, bad_pixels=bad)


@pytest.mark.parametrize("brightest", [0.3, 0.6, 1.3, 1.45])
def test_white_is_the_brightest_light_that_is_known(brightest):
    white = found(brightest * RAMP)
    assert white.found and white.level == pytest.approx(brightest, rel=0.06)


@pytest.mark.parametrize("brightest", [0.93, 1.0, 1.07])
def test_white_of_a_picture_that_reaches_1_stays_1(brightest):
    assert found(brightest * RAMP).level == 1


def test_white_of_dim_light_is_that_of_a_longer_window():
    """With 3 spikes in 100 frames, a window of 25 frames shows 0, 1 or 2."""
    assert found(0.05 * RAMP + 0.0).level == pytest.approx(4 / (FRAMES * RATE))  # four spikes in all: bounded
    assert found(0.2 * RAMP).level == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize("light", [0.05, 0.3, 0.5])
def test_white_of_what_is_grey_all_over_leaves_it_grey(light):
    level = found(np.full(SHAPE, light)).level
    assert 1.8 * light < level < 2.6 * light and level <= 1


def test_white_passes_over_bad_saturated_and_silent_pixels():
    light = 0.5 * RAMP**2
    light[:, :5], light[:5] = 4.0, 0.0
    bad = np.zeros(SHAPE, bool)
    bad[10:20, 5:30] = True
    light[bad] = 1.2
    assert found(light, bad).level == pytest.approx(0.5, rel=0.06)
    assert found(light).level == pytest.approx(1.2, rel=0.06)


def test_white_of_much_saturated_light_is_what_saturates():
    light = 1.6 * RAMP
    light[:, :10] = 3.0
    white = found(light)
    assert white.level == pytest.approx(1 / RATE) and white.reason == "the most light that a pixel can measure"


@pytest.mark.parametrize("light", [0.0, 5.0])
def test_white_where_nothing_is_known_is_nominal(light):
    assert found(np.full(SHAPE, light)).level == 1


def test_white_of_key_frames_is_that_of_the_frames_around_them():
    spikes = np.concatenate([fired(0.3 * RAMP), fired(0.7 * RAMP)])
    recording = Recording.from_array(spikes)
    first, both = (find_white_around(recording, 20, last, 40).level for last in (20, 180))
    assert first == pytest.approx(0.3, rel=0.1) and both == pytest.approx(0.7, rel=0.1)


def test_white_of_pictures_follows_the_same_rule():
    assert white_of(RAMP.ravel()).level == 1
    assert white_of(0.5 * RAMP.ravel()).level == pytest.approx(0.5, rel=0.03)
    assert white_of(np.zeros(100)).level == 1e-3


@pytest.mark.parametrize("level", [0, -1, np.nan, np.inf])
def test_white_that_is_no_intensity_is_refused(level):
    with pytest.raises(InputError, match="white is .*, but it must be an intensity"):
        White.given(level)


def test_white_sentence_says_why():
    assert White.given(2.0).sentence == "Shown as white: intensity 2 (as given)."
    assert "of the measured light is below" in found(0.5 * RAMP).sentence
