"""Trust: how far from the key frame a motion holds."""

import numpy as np
import pytest
from skimage import data

from scsr_opt.camera import Sensor, simulate
from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.motion import Motion, trajectory_of
from scsr_opt.motion.estimators.frames import motion_frames
from scsr_opt.motion.reliability import with_trust
from scsr_opt.motion.trajectory import SPACING, Trust

KEY, VELOCITY = 40, (0.0, 0.2)


@pytest.fixture(scope="module")
def pictures():
    scene = Translation(data.gravel()[100:196, 100:196], velocity=(0.0, 2 * VELOCITY[1]))
    made = simulate(scene, scale=2, frames=81, sensor=Sensor(photons=1000.0), seed=0)
    return motion_frames(made.spikes, key=KEY)


def steady(pictures, velocity):
    field = np.zeros((2, *pictures.picture.shape[1:]), np.float32)
    field[0], field[1] = velocity
    return Motion.of_velocity(field)


def shares(pictures, velocity):
    """Mean share near the key frame, and at both ends, of the middle of the picture (which stays in view)."""
    trust = with_trust(pictures, steady(pictures, velocity)).trust
    assert trust is not None
    share = trust.share[:, 12:-12, 12:-12].mean((1, 2))
    near = np.abs(trust.after) <= 4
    return share[near].mean(), share[[0, -1]].mean()


def test_the_true_motion_is_trusted_throughout(pictures):
    near, far = shares(pictures, VELOCITY)
    assert near > 0.95 and far > 0.8


def test_a_wrong_motion_is_trusted_near_the_key_frame_only(pictures):
    near, far = shares(pictures, (0.0, VELOCITY[1] + 0.05))  # 2 pixels wrong at the ends
    assert near > 0.7 and far < 0.4


def test_scene_at_rest_has_no_trust():
    made = simulate(Static(data.gravel()[100:196, 100:196] / 255), scale=2, frames=81, seed=0)
    still = motion_frames(made.spikes, key=KEY)
    assert with_trust(still, Motion.none(*still.picture.shape[1:])).trust is None


def test_rest_is_trusted_no_more_than_other_motions(pictures):
    """16 pixels wrong at the ends."""
    near, far = shares(pictures, (0.0, 0.0))
    assert near > 0.7 and far < 0.4


def test_samples_count_by_the_share_of_the_point_that_they_see():
    height, width = 12, 20
    share = np.ones((2, height, width), np.float32)
    share[1, :, 10] = 0.25  # ten frames after the key frame, the points of this column are elsewhere than predicted
    moving = Motion.of_velocity(np.broadcast_to(np.array([0.0, 0.25], np.float32)[:, None, None], (2, height, width)))
    believed = Motion(
        moving.velocity, moving.acceleration, moving.confidence, None, Trust(np.array([0.0, 8.0], np.float32), share)
    )
    path = trajectory_of(believed, key=0, start=0, stop=17)
    visible = np.asarray(path.visible)
    # After 8 frames column 10 of the key frame is seen at column 12; halfway in time, the share is halfway, too.
    np.testing.assert_allclose(visible[8 // SPACING, 6, [10, 12, 14]], [1, 0.25, 1], atol=1e-5)
    np.testing.assert_allclose(visible[4 // SPACING, 6, [10, 11, 12]], [1, 0.625, 1], atol=1e-5)
    # Beyond the last known moment, its share holds.
    np.testing.assert_allclose(visible[16 // SPACING, 6, 14], 0.25, atol=1e-5)


def test_what_stands_still_has_one_worth_unless_it_is_less_than_half():
    """A slow pan taken for rest, and for a motion that differs in what stands still and at the edges only."""
    scene = Translation(data.gravel()[100:196, 100:196], velocity=(0.0, 0.03))
    slow = motion_frames(simulate(scene, scale=2, frames=81, sensor=Sensor(photons=1000.0), seed=0).spikes, key=KEY)
    resting, creeping = (with_trust(slow, steady(slow, (0.0, speed))).trust for speed in (0.0, 1e-6))
    assert resting is not None and creeping is not None
    rested, crept = (trust.share[:, 12:-12, 12:-12] for trust in (resting, creeping))
    least, mean = crept.min(0), crept.mean(0)
    always, not_always = least > 0.51, least < 0.49
    assert always.mean() > 0.1 and not_always.mean() > 0.1
    np.testing.assert_allclose(rested, np.where(always, mean, rested), atol=1e-3)
    np.testing.assert_allclose(rested[:, not_always], crept[:, not_always], atol=1e-3)
