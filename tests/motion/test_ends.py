"""Key frames at the ends of a recording, from where what moves is seen only to come or to leave."""

import numpy as np
import pytest
from skimage import data

from scsr_opt.camera.scenes import Ellipse, MovingObject
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.motion import Automatic, estimate_motion

SIDE, FRAMES, HALFWAY = 40, 121, 60
# Sensor pixels per frame, and the object's radii in sensor pixels.
VELOCITY, RADII = np.array([0.1, 0.25]), (10, 8)


def still(name: str) -> np.ndarray:
    picture = getattr(data, name)() / 255
    top, left = ((length - 2 * SIDE) // 2 for length in picture.shape)
    return picture[top : top + 2 * SIDE, left : left + 2 * SIDE]


@pytest.mark.parametrize(("key", "simple_motion"), [(0, True), (120, True), (120, False)])
def test_an_object_that_comes_or_leaves_is_found_at_the_recordings_end(key, simple_motion):
    """Estimated from there alone it was taken for a part of the background (14.6 for 22 dB at frame 120)."""
    radii = (2 * RADII[0], 2 * RADII[1])
    scene = MovingObject(still("camera"), still("brick"), tuple(2 * VELOCITY), shape=Ellipse(*radii), key=HALFWAY)
    made = simulate(scene, scale=2, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=1)
    begin = min(max(key - 50, 0), FRAMES - 101)
    motion = estimate_motion(
        made.spikes[begin : begin + 101], key=key - begin, estimator=Automatic(simple_motion=simple_motion)
    )
    down, right = np.mgrid[:SIDE, :SIDE] - ((SIDE - 1) / 2 + VELOCITY * (key - HALFWAY))[:, None, None]
    inside = np.hypot(down / RADII[0], right / RADII[1]) < 0.8
    error = np.hypot(*(motion.velocity - VELOCITY[:, None, None]))
    assert np.mean(error[inside] < 0.05) > 0.8
    outside = np.hypot(down / RADII[0], right / RADII[1]) > 1.4
    assert np.mean(motion.speed[outside] < 0.02) > 0.8
