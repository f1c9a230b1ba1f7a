import colorsys

import numpy as np
import pytest

from scsr_opt.report import colour_wheel, full_speed, motion_colours


def _hue(colour):
    return colorsys.rgb_to_hsv(*(float(channel) for channel in colour[:3]))[0] * 360


@pytest.mark.parametrize(
    ("down", "right", "degrees"), [(0.0, 1.0, 0), (-1.0, 0.0, 90), (0.0, -1.0, 180), (1.0, 0.0, 270), (-1.0, 1.0, 45)]
)
def test_hue_is_the_direction_as_drawn(down, right, degrees):
    colours = motion_colours(np.array([down, right]).reshape(2, 1, 1), 2.0)
    assert _hue(colours[0, 0]) == pytest.approx(degrees, abs=0.01)


def test_saturation_is_the_speed():
    speeds = np.array([0.0, 0.25, 0.5, 1.0, 3.0])
    colours = motion_colours(np.stack([np.zeros((1, 5)), speeds[None]]), 1.0)[0]
    saturation = [colorsys.rgb_to_hsv(*map(float, colour))[1] for colour in colours]
    assert saturation == pytest.approx([0, 0.25, 0.5, 1, 1], abs=1e-6)


def test_unknown_motion_is_grey_and_no_motion_white():
    assert (motion_colours(np.full((2, 1, 1), np.nan), 1.0) == np.float32(0.6)).all()
    assert (motion_colours(np.zeros((2, 2, 2)), 0.0) == 1).all()


def test_full_speed_rounds_up_and_ignores_outliers():
    velocity = np.full((2, 100, 100), 0.0)
    velocity[1] = 0.1234
    velocity[1, 0, 0] = 50.0
    assert full_speed(velocity) == pytest.approx(0.13)
    assert full_speed(np.zeros((2, 4, 4))) == 0.0
    assert full_speed(np.full((2, 4, 4), np.nan)) == 0.0


def test_the_wheel_shows_each_direction_where_it_points():
    wheel = colour_wheel(101)
    assert _hue(wheel[50, 90]) == pytest.approx(0, abs=2)
    assert _hue(wheel[10, 50]) == pytest.approx(90, abs=2)
    assert _hue(wheel[90, 50]) == pytest.approx(270, abs=2)
    assert wheel[50, 50, :3].min() > 0.95 and wheel[0, 0, 3] == 0 and wheel[50, 90, 3] == 1
