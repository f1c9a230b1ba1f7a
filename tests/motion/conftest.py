"""Recordings with known motion, made once."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from skimage import color, data

from scsr_opt.camera.scenes import Affine, Box, MovingObject, Static, Translation, TurningDisc
from scsr_opt.camera.simulator import Simulation, simulate
from scsr_opt.motion.estimators.frames import MotionFrames, motion_frames

SCALE = 2
KEY = 50
SIZE = 200  # HR pixels


def still(name: str, size: int = SIZE) -> np.ndarray:
    picture = getattr(data, name)()
    picture = color.rgb2gray(picture) if picture.ndim == 3 else picture / 255
    top, left = ((n - size) // 2 for n in picture.shape)
    return picture[top : top + size, left : left + size]


@cache
def _recording(name: str) -> Simulation:
    """`name`: static, affine, object, disc, or translate followed by the speed in sensor pixels per frame."""
    behind = still("camera")
    if name == "static":
        scene = Static(behind)
    elif name == "affine":
        scene = Affine(behind, rotation=0.002, zoom=0.001, drift=(0.1, -0.2))
    elif name == "object":
        scene = MovingObject(still("gravel"), still("coffee", 90), (0.2, 0.36), shape=Box(42.0, 42.0))
    elif name == "disc":
        scene = TurningDisc(still("gravel"), still("grass", 160), 0.004, radius=70)
    else:
        speed = float(name.removeprefix("translate"))
        scene = Translation(behind, (0.6 * speed * SCALE, -0.8 * speed * SCALE))
    return simulate(scene, scale=SCALE, seed=1)


@cache
def _pictures(name: str) -> MotionFrames:
    return _central(motion_frames(_recording(name).spikes, key=KEY), 17)


def _central(some: MotionFrames, number: int) -> MotionFrames:
    """The `number` pictures in the middle: with always the same number, everything is compiled only once."""
    first = (some.after.shape[0] - number) // 2
    part = slice(first, first + number)
    counted = some.counted
    assert counted is not None
    return replace(some, picture=some.picture[part], after=some.after[part], counted=lambda: counted()[part])


def _error(found: np.ndarray, name: str) -> np.ndarray:
    """Length of the velocity's error, sensor pixels per frame."""
    return np.hypot(*(found - _recording(name).velocity(KEY)))


@pytest.fixture
def recording():
    return _recording


@pytest.fixture
def pictures():
    return _pictures


@pytest.fixture
def error():
    return _error


@pytest.fixture
def central():
    return _central
