"""Drawings that networks are trained on beside photographs."""

import numpy as np
import pytest

from learned.training.data import SCENES, Examples
from learned.training.drawings import drawing


@pytest.mark.parametrize("side", [1, 17, 96])
def test_drawings_are_intensities_of_every_kind(side):
    drawn = [drawing(np.random.default_rng(seed), side) for seed in range(60)]
    assert all(one.shape == (side, side) and one.dtype == np.float32 for one in drawn)
    assert min(one.min() for one in drawn) >= 0 and max(one.max() for one in drawn) <= 1
    if side > 1:  # plain ones, and those of two greys, and those of many
        greys = [len(np.unique(one)) for one in drawn]
        assert min(greys) == 1 and 2 in greys and max(greys) > 50


def test_a_drawing_depends_on_chance_alone():
    one, same, other = (drawing(np.random.default_rng(seed), 32) for seed in (4, 4, 5))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("scene", SCENES)
def test_every_third_example_is_drawn_and_the_others_stay(scene):
    size = {"scale": 2, "frames": 11, "patch": 16, "scenes": (scene,), "lights": ("day",)}
    stills, mixed = Examples(**size), Examples(**size, drawings=3)
    alike = [np.array_equal(stills[number].truth, mixed[number].truth) for number in range(6)]
    assert alike == [True, True, False, True, True, False]


def test_every_fourth_example_has_faulty_pixels_and_the_others_stay():
    size = {"scale": 1, "frames": 41, "patch": 24, "scenes": ("static",), "lights": ("day",)}
    usual, faulty = Examples(**size), Examples(**size, defects=4)
    alike = [np.array_equal(usual[number].spikes, faulty[number].spikes) for number in range(8)]
    assert alike == [True, True, False, True] * 2
    silent = [
        np.count_nonzero(~one.spikes.any(0)) - np.count_nonzero(~other.spikes.any(0))
        for one, other in ((faulty[number], usual[number]) for number in range(2, 80, 4))
    ]
    assert min(silent) >= 0 and max(silent) >= 24  # some have lines
