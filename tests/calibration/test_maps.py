"""Calibrations in files, and pictures corrected by them."""

import numpy as np
import pytest

from scsr_opt.calibration.bad_pixels import BadPixels, PixelKind
from scsr_opt.calibration.maps import Calibration
from scsr_opt.camera.recording import Recording
from scsr_opt.errors import InputError

SHAPE = (6, 8)


@pytest.fixture
def maps() -> Calibration:
    kind = np.zeros(SHAPE, np.uint8)
    kind[1, 2], kind[4, 5] = PixelKind.DEAD, PixelKind.RESTING
    rng = np.random.default_rng(0)
    return Calibration(
        BadPixels(kind), rng.uniform(0.8, 1.2, SHAPE).astype(np.float32), rng.uniform(0, 0.02, SHAPE).astype(np.float32)
    )


def test_calibration_is_read_back_as_it_was_saved(maps, tmp_path):
    maps.save(tmp_path / "a.npz")
    read = Calibration.load(tmp_path / "a.npz")
    for one, other in ((read.bad.kind, maps.bad.kind), (read.gain, maps.gain), (read.dark, maps.dark)):
        np.testing.assert_array_equal(one, other)


def test_calibration_corrects_a_picture_of_the_sensor_that_it_is_of(maps):
    light = np.random.default_rng(1).uniform(0.1, 1, SHAPE)
    seen = light * maps.gain + maps.dark / 0.6
    np.testing.assert_allclose(maps.corrected(seen, 0.6), light, rtol=1e-5)
    part = maps.crop(1, 2, 4, 5)
    np.testing.assert_allclose(part.corrected(seen[1:5, 2:7], 0.6), light[1:5, 2:7], rtol=1e-5)


def test_calibration_adds_its_bad_pixels_to_those_of_a_recording(maps):
    own = np.zeros(SHAPE, bool)
    own[0, 0] = True
    recording = Recording.from_array(np.zeros((5, *SHAPE), np.uint8), bad_pixels=own)
    np.testing.assert_array_equal(maps.applied(recording).bad_pixels, own | maps.bad.mask)
    with pytest.raises(InputError, match="The calibration is of 8x6 pixels, but .* has 6x6"):
        maps.applied(Recording.from_array(np.zeros((5, 6, 6), np.uint8)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gain": np.zeros(SHAPE)}, "maps that cannot be used"),
        ({"dark": np.full(SHAPE, 1.5)}, "maps that cannot be used"),
        ({"bad_pixels": np.full(SHAPE, 9)}, "maps that cannot be used"),
        ({"dark": np.zeros((2, 2))}, "maps that cannot be used"),
        ({"gain": None}, "holds no calibration"),
    ],
)
def test_calibration_that_cannot_be_used_is_refused(change, message, tmp_path):
    stored = {"bad_pixels": np.zeros(SHAPE, np.uint8), "gain": np.ones(SHAPE), "dark": np.zeros(SHAPE)} | change
    np.savez(tmp_path / "a.npz", **{name: value for name, value in stored.items() if value is not None})
    with pytest.raises(InputError, match=message):
        Calibration.load(tmp_path / "a.npz")
    with pytest.raises(InputError, match="There is no calibration"):
        Calibration.load(tmp_path / "b.npz")
