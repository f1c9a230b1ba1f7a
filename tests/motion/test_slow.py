"""Motion that no pixel alone shows: slow pans, recordings of a few spikes a pixel, pans that leave the view."""

import numpy as np
import pytest
from skimage import data

from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.motion import Automatic, Motion, estimate_motion
from scsr_opt.motion.estimators.evidence import at_rest, counts_agree
from scsr_opt.motion.estimators.frames import MotionFrames, motion_frames
from scsr_opt.motion.estimators.parametric import shows_global_motion
from scsr_opt.motion.settings import DEFAULTS

SCALE = 2
PHOTONS = {0.6: 1000.0, 0.1: 25.0}


def seen(speed: float, frames: int, white_rate: float = 0.6) -> tuple[np.ndarray, MotionFrames]:
    """Spikes of a pan by `speed` sensor pixels per frame, or of a scene at rest, and their motion frames."""
    picture = data.camera()[100:300, 100:300] / 255
    scene = Translation(picture, (0.6 * SCALE * speed, -0.8 * SCALE * speed)) if speed else Static(picture)
    sensor = Sensor(white_rate, PHOTONS[white_rate])
    spikes = simulate(scene, scale=SCALE, frames=frames, sensor=sensor, seed=1).spikes
    return spikes, motion_frames(spikes, key=frames // 2, white_rate=white_rate)


@pytest.mark.parametrize(("speed", "frames", "near"), [(0.025, 40, 0.15), (0.003, 101, 0.15)])
def test_a_pan_that_no_pixel_contradicts_rest_by_is_found(speed, frames, near):
    spikes, pictures = seen(speed, frames)
    assert (
        shows_global_motion(pictures) and at_rest(pictures)[0].mean() <= 3 * DEFAULTS.evidence.tolerated_share_at_rest
    )
    found = estimate_motion(spikes, key=frames // 2).velocity
    away = np.hypot(*(found - speed * np.array([0.6, -0.8])[:, None, None])).mean()
    print(f"{frames} frames: wrong by {away / speed:.3f} of the speed")
    assert away < near * speed


@pytest.mark.parametrize(("frames", "white_rate"), [(2, 0.6), (10, 0.6), (40, 0.6), (101, 0.6), (101, 0.1)])
def test_a_scene_at_rest_does_not_move_as_one(frames, white_rate):
    _, pictures = seen(0.0, frames, white_rate)
    assert not shows_global_motion(pictures)
    if white_rate > 0.1:  # in dim light single pixels contradict anything
        assert not Automatic()(pictures).velocity.any()


@pytest.mark.parametrize(
    ("frames", "speed", "white_rate"), [(20, 0.2, 0.6), (20, 0.1, 0.6), (101, 0.14, 0.1), (101, 0.8, 0.6)]
)
def test_what_fires_seldom_for_its_motion_is_not_taken_for_rest(frames, speed, white_rate):
    """Most of its pictures show the same interval. Pans were taken for rest, or for several motions; the last one
    carries 80 of 100 pixels out of view."""
    spikes, pictures = seen(speed, frames, white_rate)
    assert at_rest(pictures)[1].mean() < 0.05
    found = estimate_motion(spikes, key=frames // 2, white_rate=white_rate)
    assert found.layers is None and np.ptp(found.velocity, axis=(1, 2)).max() < 0.1 * speed
    away = np.hypot(*(found.velocity - speed * np.array([0.6, -0.8])[:, None, None])).mean()
    print(f"{frames} frames, white {white_rate}: wrong by {away / speed:.3f} of the speed")
    assert away < 0.3 * speed


@pytest.mark.parametrize(("speed", "white_rate"), [(0.14, 0.1), (0.4, 0.6)])
def test_counts_tell_the_velocity_from_rest_and_from_what_is_far_too_fast(speed, white_rate):
    _, pictures = seen(speed, 101, white_rate)

    def agree(velocity: tuple[float, float]) -> bool:
        return counts_agree(pictures, Motion.of_velocity(np.full((2, 100, 100), np.reshape(velocity, (2, 1, 1)))))

    assert agree((0.6 * speed, -0.8 * speed))
    assert not agree((0.0, 0.0)) and not agree((1.2, 1.6))
    still = seen(0.0, 101, white_rate)[1]
    assert not counts_agree(still, Motion.of_velocity(np.full((2, 100, 100), 0.1, np.float32)))


@pytest.mark.parametrize("frames", [2, 7, 20, 101, 1000])
def test_counts_are_those_of_each_stretch(frames):
    spikes = np.random.default_rng(0).random((frames, 5, 6)) < 0.4
    some = motion_frames(spikes.astype(np.uint8), key=frames // 2)
    always = motion_frames(np.ones_like(spikes), key=0)
    assert some.counted is not None and always.counted is not None
    assert some.counted().shape == some.picture.shape
    assert float(abs(some.counted().mean() - spikes.mean())) < 0.2
    np.testing.assert_array_equal(always.counted(), 1)
