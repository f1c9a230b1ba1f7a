"""The outer loop's update of light: the edge between the light of two lamps, found by the picture."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from skimage.metrics import mean_squared_error

from scsr_opt import reconstruct
from scsr_opt.camera import Scene, Translation, simulate
from scsr_opt.motion import Motion

SHAPE, FRAMES, KEY, SPEED = (48, 64), 400, 200, 0.1


class TwoLamps(Scene):
    """A texture that moves to the right, under a lamp to the left and one to the right, a quarter of a cycle apart."""

    def __init__(self):
        grey = gaussian_filter(np.random.default_rng(0).standard_normal(SHAPE), 1.5, mode="wrap")
        self.scene = Translation(0.2 + 0.6 * (grey - grey.min()) / np.ptp(grey), (0, SPEED), key=KEY)
        self.size, self.key, self.span = self.scene.size, self.scene.key, self.scene.span

    def frame(self, t):
        lamps = [1 + 0.5 * np.sin(2 * np.pi * t / 400 + phase) for phase in (0, np.pi / 2)]
        return self.scene.frame(t) * np.repeat(lamps, SHAPE[1] // 2)

    def velocity(self, t):
        return self.scene.velocity(t)


@pytest.fixture(scope="module")
def solution():
    spikes = simulate(TwoLamps(), scale=1, frames=FRAMES, seed=1).spikes
    return reconstruct(spikes, scale=1, key=KEY, motion=Motion.constant((0, SPEED), SHAPE), strength=3e-4)


def test_reconstruct_two_lamps_finds_the_edge_between_them(solution):
    share = solution.light.share
    left = (share == share[:, 24, 8][:, None, None]).all(0)
    np.testing.assert_array_equal(left, np.arange(SHAPE[1])[None].repeat(SHAPE[0], 0) < SHAPE[1] // 2)


def test_reconstruct_two_lamps_gives_the_scene_without_a_seam(solution):
    """Along the edge the picture is as good as elsewhere."""
    truth, middle = TwoLamps().scene.frame(KEY), SHAPE[1] // 2
    inner, seam = np.s_[6:-6, 6:-6], np.s_[6:-6, middle - 4 : middle + 4]
    everywhere = mean_squared_error(truth[inner], solution.image[inner])
    assert mean_squared_error(truth[seam], solution.image[seam]) < 1.5 * everywhere
