"""Motion and pictures some frames later."""

import numpy as np
import pytest

from scsr_opt.motion import Motion
from scsr_opt.motion.propagation import carry, moved_along
from scsr_opt.motion.trajectory import Layers

HEIGHT, WIDTH = 24, 30


def test_what_does_not_move_stays_and_nothing_changes_in_no_time():
    still = Motion.none(HEIGHT, WIDTH)
    moving = Motion.of_velocity(np.full((2, HEIGHT, WIDTH), 0.3, np.float32))
    assert carry(still, 40) is still and carry(moving, 0) is moving
    picture = np.random.default_rng(0).random((HEIGHT, WIDTH)).astype(np.float32)
    assert moved_along(still, 40, 1, picture) is picture


def test_a_turn_goes_on_turning():
    """About (12, 15), by 0.002 rad per frame: the velocity at a place does not change with time."""
    rows, columns = np.indices((HEIGHT, WIDTH), dtype=np.float32) - np.array([12, 15], np.float32)[:, None, None]
    velocity = np.float32(0.002) * np.stack([columns, -rows])
    towards = -(np.float32(0.002) ** 2) * np.stack([rows, columns])
    turn = Motion(velocity, towards, np.ones((HEIGHT, WIDTH), np.float32))
    later = carry(turn, 30)
    inner = (slice(None), slice(4, -4), slice(4, -4))
    # A path to second order in ωt has its velocity to first: what is left is ω (ωt)²/2 of a radius of 15 pixels.
    np.testing.assert_allclose(later.velocity[inner], velocity[inner], atol=1.1 * 0.002 * 0.06**2 / 2 * 15)
    assert np.abs(velocity[inner]).max() > 0.015


def test_a_layer_takes_its_label_along_and_uncovers_the_background():
    label = np.zeros((HEIGHT, WIDTH), np.int32)
    label[8:16, 5:13] = 1
    velocity = np.zeros((2, 2, HEIGHT, WIDTH), np.float32)
    velocity[1, 1] = 0.5
    layers = Layers(velocity, np.zeros_like(velocity), label, np.array([0, 1], np.int32))
    motion = Motion.of_layers(layers, np.ones((HEIGHT, WIDTH), np.float32))
    later = carry(motion, 10)
    assert later.layers is not None
    np.testing.assert_array_equal(later.layers.label, np.roll(label, 5, axis=1))
    np.testing.assert_array_equal(later.velocity[1], 0.5 * np.roll(label, 5, axis=1))
    assert later.trust is None


@pytest.mark.parametrize("leading", [(), (2,), (3, 2)])
def test_pictures_move_along_and_all_else_stays(leading):
    picture = np.random.default_rng(1).random((*leading, 2 * HEIGHT, 2 * WIDTH)).astype(np.float32)
    right = np.zeros((2, HEIGHT, WIDTH), np.float32)
    right[1] = 0.25
    state = {"image": picture, "weight": np.float32(3), "other": np.ones((5, 7), np.float32)}
    moved = moved_along(Motion.of_velocity(right), 8, 2, state)
    np.testing.assert_allclose(moved["image"][..., 4:], picture[..., :-4], atol=1e-6)  # ¼ px · 8 frames · scale 2
    assert moved["weight"] == 3 and moved["other"] is state["other"]
