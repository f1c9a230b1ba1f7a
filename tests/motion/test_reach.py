"""Reach: how far in time a dense motion is estimated from and used."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from scsr_opt.camera import Sensor, simulate
from scsr_opt.camera.scenes import Scene
from scsr_opt.errors import InputError
from scsr_opt.motion import Motion
from scsr_opt.motion.estimators.dense import accelerated, dense
from scsr_opt.motion.estimators.frames import motion_frames
from scsr_opt.motion.estimators.reach import within_reach
from scsr_opt.motion.propagation import carry
from scsr_opt.motion.reliability import with_trust
from scsr_opt.motion.validation import validate_motion

FRAMES, KEY, SIZE = 101, 50, (40, 88)
SPEED, SHAKE, PERIOD = 0.08, 3.0, 90.0
"""Sensor pixels per frame; sensor pixels, and frames, of the right half's shaking."""


class HalfShaken(Scene):
    """Texture that moves at a constant velocity; its right half is shaken on top of that, faster than an acceleration
    could follow for long."""

    def __init__(self, shake: float):
        self.size, self.key = SIZE, float(KEY)
        self.shake = shake
        noise = np.random.default_rng(3).standard_normal((SIZE[0], SIZE[1] + 40))
        grey = gaussian_filter(noise, 1.2, mode="wrap")
        self.texture = 0.2 + 0.6 * (grey - grey.min()) / np.ptp(grey)

    def displacement(self, t):
        """Sensor pixels to the right, for each column."""
        right = 1 / (1 + np.exp(-(np.arange(SIZE[1]) - SIZE[1] / 2) / 3))
        after = t - KEY
        return SPEED * after + self.shake * np.sin(2 * np.pi * after / PERIOD) * right

    def frame(self, t):
        row, column = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
        return map_coordinates(self.texture, [row, column + 20 - self.displacement(t)[None]], order=3, mode="nearest")

    def velocity(self, t):
        change = (self.displacement(t + 0.5) - self.displacement(t - 0.5))[None]
        return np.stack([np.zeros(SIZE), np.broadcast_to(change, SIZE)])


DAY, DIM = Sensor(photons=1000.0), Sensor(0.07, 25.0)


def fitted(shake, sensor=DAY):
    made = simulate(HalfShaken(shake), scale=1, frames=FRAMES, sensor=sensor, seed=0)
    pictures = motion_frames(made.spikes, key=KEY)
    return pictures, accelerated(pictures, dense(pictures))


@pytest.fixture(scope="module")
def shaken():
    pictures, motion = fitted(SHAKE)
    return pictures, motion, within_reach(pictures, motion)


LEFT, RIGHT = (slice(4, -4), slice(6, 30)), (slice(4, -4), slice(58, 82))


def test_where_the_motion_fails_far_from_the_key_frame_fewer_frames_are_used(shaken):
    _, _, motion = shaken
    assert motion.reach is not None
    longest = motion.reach.max()
    assert np.median(motion.reach[LEFT]) == pytest.approx(longest, rel=1e-3)
    assert np.median(motion.reach[RIGHT]) <= 0.75 * longest


def test_the_velocity_at_the_key_frame_is_better_for_it(shaken):
    _, before, motion = shaken
    true = HalfShaken(SHAKE).velocity(KEY)[1][RIGHT]
    wrong, left = (np.abs(of.velocity[1][RIGHT] - true).mean() for of in (before, motion))
    assert left < 0.6 * wrong


def test_constant_motion_keeps_all_frames_and_its_fit():
    pictures, motion = fitted(0.0)
    assert within_reach(pictures, motion) is motion


def test_dim_light_keeps_all_frames():
    """A pixel fires every thirty frames or so: pictures closer than that show the same intervals, and their differences
    are no measure of anything."""
    pictures, motion = fitted(0.0, DIM)
    assert within_reach(pictures, motion) is motion


def test_samples_beyond_the_reach_have_no_weight_and_those_of_what_rests_keep_theirs(shaken):
    pictures, _, motion = shaken
    still = motion.velocity.copy()
    still[:, :, :20] = 0
    acceleration = np.where(still == 0, 0, motion.acceleration)
    short = replace(motion, velocity=still, acceleration=acceleration, reach=np.full(SIZE, 24.0, np.float32))
    unlimited = with_trust(pictures, replace(short, reach=None)).trust
    limited = with_trust(pictures, short).trust
    assert limited is not None and unlimited is not None
    far, near = np.abs(limited.after) >= 24, np.abs(limited.after) <= 24 / 2**0.5
    moving = still.any(0)
    assert (limited.share[far][:, moving] == 0).all()
    np.testing.assert_allclose(limited.share[near], unlimited.share[near], rtol=1e-5)
    np.testing.assert_array_equal(limited.share[:, ~moving], unlimited.share[:, ~moving])


def test_a_reach_is_shorter_as_seen_from_another_key_frame():
    velocity = np.full((2, 8, 9), 0.1, np.float32)
    motion = replace(Motion.of_velocity(velocity), reach=np.full((8, 9), 30.0, np.float32))
    assert (carry(motion, 10).reach == 20).all()
    assert (carry(motion, -40).reach == 0).all()


def test_a_reach_of_another_shape_or_below_zero_is_refused():
    motion = Motion.of_velocity(np.zeros((2, 8, 9), np.float32))
    for wrong in (np.full((8, 9), -1.0, np.float32), np.full((8, 9), np.nan, np.float32)):
        with pytest.raises(InputError, match=r"motion\.reach"):
            validate_motion(replace(motion, reach=wrong), 8, 9)
    throughout = replace(motion, reach=np.full((8, 9), np.inf, np.float32))
    assert validate_motion(throughout, 8, 9).reach is not None
    with pytest.raises(InputError, match=r"motion\.reach has shape \(8, 9\); it must be \(9, 8\)"):
        validate_motion(throughout, 9, 8)
