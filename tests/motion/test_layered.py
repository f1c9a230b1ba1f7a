"""Layers: which surface is where, which is in front, and what a pixel sees of them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from scsr_opt.camera import Intervals, Sensor, simulate
from scsr_opt.camera.scenes import Box, MovingObject
from scsr_opt.motion import Automatic, Motion, estimate_motion, trajectory_of
from scsr_opt.motion.estimators import layered
from scsr_opt.motion.estimators.automatic import corrected_frames
from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.settings import DEFAULTS
from scsr_opt.motion.trajectory import SPACING, Layers
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.measurement import measure

KEY, FRAMES = 40, 81
SPEED = 0.25  # sensor pixels per frame, to the right


def before_a_background(depth: tuple[int, int]) -> Motion:
    """By hand: a square of 10 pixels that moves to the right over a background at rest, in front of it or behind."""
    label = np.zeros((30, 40), np.int32)
    label[10:20, 15:25] = 1
    velocity = np.zeros((2, 2, 30, 40), np.float32)
    velocity[1, 1] = SPEED
    layers = Layers(velocity, np.zeros_like(velocity), label, np.array(depth, np.int32))
    return Motion.of_layers(layers, np.ones((30, 40), np.float32))


def test_rest_mismatches_as_a_motion_by_nothing():
    """The layer at rest is compared without interpolation."""
    picture = np.random.default_rng(0).random((9, 30, 40), np.float32)
    pictures = MotionFrames(jnp.asarray(picture), jnp.linspace(-40.0, 40.0, 9))
    hardly = Motion.of_velocity(np.full((2, 30, 40), 1e-30, np.float32))
    found, expected = (layered._mismatch(pictures, motion, 0.01, DEFAULTS) for motion in (Motion.none(30, 40), hardly))
    inside = (slice(8, -8), slice(8, -8))  # what moves at all leaves the border
    np.testing.assert_allclose(found[inside], expected[inside], rtol=1e-5)
    assert np.ptp(found[inside]) > 0.1


def positions_at(motion: Motion, time: int) -> tuple[np.ndarray, np.ndarray]:
    path = trajectory_of(motion, key=KEY, start=0, stop=FRAMES)
    moment = time // SPACING
    return np.asarray(path.position[moment]), np.asarray(path.visible[moment])


def test_what_is_in_front_hides_what_is_behind():
    position, visible = positions_at(before_a_background((0, 1)), KEY + 16)  # the square is now 4 columns further right
    inside = (slice(12, 18), slice(21, 27))
    np.testing.assert_allclose(position[1][inside], np.arange(21, 27)[None] - 4.0 + np.zeros((6, 1)), atol=1e-4)
    assert (visible[inside] == 1).all()
    # Columns 15 to 18 show background that the square hid in the key frame: no sample may be taken from there.
    assert (visible[12:18, 15:18] == 0).all()
    assert (visible[:, :13] == 1).all() and (visible[:8] == 1).all()


def test_what_is_behind_is_hidden_by_what_is_in_front():
    position, visible = positions_at(before_a_background((1, 0)), KEY + 16)
    # The background that the key frame shows right of the square stays in view; the square slides under it.
    np.testing.assert_allclose(position[1, 12:18, 26:29], np.arange(26, 29)[None] + np.zeros((6, 1)), atol=1e-4)
    assert (visible[12:18, 26:29] == 1).all()


def test_intervals_of_a_pixel_that_something_passes_are_not_merged():
    """At rest in the key frame, but hidden at other times: one merged interval would mix what hides it into it."""
    motion = before_a_background((0, 1))
    fastest = trajectory_of(motion, key=KEY, start=0, stop=FRAMES).speeds.most
    np.testing.assert_allclose(fastest[12:18, 17:23], SPEED, rtol=1e-3)
    assert (fastest[12:18, 27:33] > SPEED).all()  # the square arrives here within 40 frames: the position jumps
    assert not fastest[:8].any() and not fastest[:, 37:].any()
    spikes = np.zeros((FRAMES, 30, 40), np.uint8)
    spikes[::4] = 1
    clip = Clip(spikes, KEY, 0.6, None)
    samples = measure(clip, motion, scale=2, sampling=Intervals(ends=0.0)).samples
    number = np.bincount(samples.row * 40 + samples.column, minlength=1200).reshape(30, 40)
    assert (number[12:18, 27:33] > 10).all()
    assert (number[:8] == 1).all()


def test_a_plain_part_moves_with_what_surrounds_it():
    mismatch = np.ones((2, 30, 40), np.float32)
    mismatch[0, 8:22, 8:32] = 4.0  # the background's motion is wrong here ...
    mismatch[1, :8] = mismatch[1, 22:] = mismatch[1, :, :8] = mismatch[1, :, 32:] = 4.0  # ... the layer's here
    mismatch[:, 12:18, 14:26] = 1.0  # plain: any motion will do
    label = np.zeros((30, 40), np.int32)
    label[8:22, 8:32] = 1
    hole = label.copy()
    hole[12:18, 14:26] = 0
    np.testing.assert_array_equal(layered._islands_merged(hole, mismatch, DEFAULTS.layers), label)
    mismatch[1, 12:18, 14:26] = 2.0  # not plain: at rest behind a hole of what moves
    np.testing.assert_array_equal(layered._islands_merged(hole, mismatch, DEFAULTS.layers), hole)


def test_regions_near_each_other_are_of_one_surface():
    mask = np.zeros((30, 60), bool)
    mask[10:20, 5:15] = mask[10:20, 19:30] = mask[10:20, 45:55] = True
    mask[2, 40] = True  # a single pixel may be wrong
    mask[26:, 30:40] = True  # at the edge
    region, number = layered._regions(mask, 3)
    assert number == 3 and region[29, 35] == region[26, 35] > 0
    assert region[15, 10] == region[15, 25] == region[15, 17] != region[15, 50]
    assert region[2, 40] == region[15, 37] == 0


def test_each_pixel_of_the_key_frame_sees_itself_then():
    position, visible = positions_at(before_a_background((0, 1)), KEY)
    np.testing.assert_allclose(position, np.mgrid[0:30, 0:40], atol=1e-5)
    assert (visible == 1).all()


def test_layers_of_too_few_pixels_are_removed_one_after_another(monkeypatch, pictures):
    """Each time that pixels are labelled again, another layer may lose its pixels, until the background is left."""
    shown = pictures("static")
    shape = shown.picture.shape[1:]
    motions = [Motion.of_velocity(np.full((2, *shape), speed / 10, np.float32)) for speed in range(4)]

    def labels(mismatches, settings):
        chosen = np.zeros(shape, np.int32)
        for k in range(1, len(mismatches)):
            chosen[9 * k : 9 * k + 9, :9] = k
        chosen[chosen == len(mismatches) - 1] = 0
        return chosen

    monkeypatch.setattr(layered, "_labels", labels)
    mismatches = [np.zeros(shape, np.float32)] * len(motions)
    assert layered._layers(shown, motions, mismatches, motions[0], sparse=False, settings=DEFAULTS) is motions[0]


@pytest.mark.parametrize("speed", [(0.0, 0.2), (-0.15, 0.1)])
def test_an_object_is_found_with_its_motion_its_outline_and_its_place_in_front(speed):
    scale = 2
    scene = MovingObject(
        data.camera()[100:260, 100:260],
        data.brick()[:100, :100],
        velocity=(scale * speed[0], scale * speed[1]),
        shape=Box(35.0, 35.0),
    )
    made = simulate(scene, scale=scale, frames=101, sensor=Sensor(photons=1000.0), seed=0)
    motion = estimate_motion(made.spikes, key=50, estimator=Automatic())
    truth = made.velocity(50)
    assert motion.layers is not None
    inside, outside = np.abs(truth).sum(0) > 0, np.abs(truth).sum(0) == 0
    wrong = np.abs(motion.velocity - truth).max(0) > 0.02
    # Where a brick is plain either motion fits, so that not all of the object need follow it; the background is
    # textured.
    assert wrong[inside].mean() < 0.3 and wrong[outside].mean() < 0.05
    object_layer = motion.layers.label[inside].astype(int)
    commonest = np.bincount(object_layer).argmax()
    background = np.bincount(motion.layers.label[outside].astype(int)).argmax()
    assert commonest != background and motion.layers.depth[commonest] > motion.layers.depth[background]
    found = motion.layers.velocity[commonest][:, inside].mean(1)
    np.testing.assert_allclose(found, speed, atol=2e-3)
    assert jnp.isfinite(trajectory_of(motion, key=50, start=0, stop=101).position).all()
    # Labels that are wrong by 6 pixels find their places again.
    label = motion.layers.label
    moved = eqx.tree_at(lambda found: found.label, motion.layers, np.roll(label, 6, 1))
    pictures = corrected_frames(made.spikes, key=50, white_rate=0.6, bad_pixels=None, gain=None)
    assert pictures is not None
    again = layered.relabelled(pictures, Motion.of_layers(moved, motion.confidence))
    assert again.layers is not None
    assert (moved.label != label).mean() > 0.05 > 0.02 > (again.layers.label != label).mean()


def test_only_layers_have_labels():
    pictures = MotionFrames(jnp.zeros((3, 8, 8)), jnp.arange(3.0))
    still = Motion.none(8, 8)
    assert layered.relabelled(pictures, still) is still
