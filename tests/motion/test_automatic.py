"""What `Automatic` leaves out where a scene does not need it, and that the motion found is the same."""

import numpy as np
import pytest
from skimage import color, data

from scsr_opt.camera.scenes import Box, MovingObject, TurningDisc
from scsr_opt.camera.simulator import Simulation, simulate
from scsr_opt.motion import Automatic, Motion, trajectory_of
from scsr_opt.motion.estimators import automatic
from scsr_opt.motion.estimators.frames import MotionFrames, stretches
from scsr_opt.motion.trajectory import Layers

SCALE, KEY = 2, 50
SPEED = (0.1, 0.2)  # sensor pixels per frame
SHAPE = (140, 160)  # sensor pixels


@pytest.fixture(scope="module")
def small() -> tuple[Simulation, MotionFrames]:
    """An object of 30 sensor pixels a side in the middle of a still wall."""
    wall = data.gravel()[40 : 40 + SCALE * SHAPE[0], 40 : 40 + SCALE * SHAPE[1]] / 255
    texture = color.rgb2gray(data.coffee())[100:200, 100:200]
    scene = MovingObject(wall, texture, (SCALE * SPEED[0], SCALE * SPEED[1]), shape=Box(30.0, 30.0))
    made = simulate(scene, scale=SCALE, seed=2)
    return made, stretches(made.spikes, key=KEY)


@pytest.fixture(scope="module")
def usual(small) -> Motion:
    return Automatic()(small[1])


@pytest.fixture(scope="module")
def everything(small) -> Motion:
    """With nothing left out."""
    return Automatic(skip=False)(small[1])


def test_what_moves_before_a_still_wall_is_looked_for_around_it_only(small, everything, monkeypatch):
    made, pictures = small
    looked_at = []
    dense = automatic.dense

    def watched(part, *, start):
        looked_at.append(part.picture.shape[1:])
        return dense(part, start=start)

    monkeypatch.setattr(automatic, "dense", watched)
    monkeypatch.setattr(automatic, "together", lambda pictures: pytest.fail("one motion for all was fitted"))
    found = Automatic()(pictures)
    assert np.prod(looked_at[0]) < 0.7 * np.prod(SHAPE)

    assert found.layers is not None and everything.layers is not None
    label, other = found.layers.label, everything.layers.label
    assert (label != other).mean() < 0.002
    same = label == other
    # The fits see other pixels and end where steps are below 0.002 px over the recording.
    assert np.abs(found.velocity - everything.velocity)[:, same].max() < 1e-3
    front = made.scene.surface(float(KEY))[::SCALE, ::SCALE] > 0
    np.testing.assert_allclose(np.median(found.velocity[:, front], axis=1), SPEED, atol=0.003)
    assert not found.velocity[:, label == 0].any()


def test_no_affine_motion_explains_what_moves_between_pixels_at_rest():
    rows, columns = np.mgrid[0:100, 0:120]
    inside = np.hypot(rows - 50, columns - 60)
    # A turn about the middle: at rest there, and the faster the farther out.
    assert not automatic._takes_several(inside < 20, inside > 40)
    assert automatic._takes_several(inside > 40, inside < 20)
    assert automatic._takes_several(columns < 60, (columns > 70) & (columns < 85))
    assert not automatic._takes_several(np.zeros((100, 120), bool), inside > 40)
    assert not automatic._takes_several(rows == 50, inside > 40)  # in one line: it may be the axis of a shear
    for side, several in ((6, False), (10, True)):  # 4 % of the sensor may be so by mistake, 12 % are not
        scattered = (rows % 30 < side) & (columns % 30 < side)
        assert automatic._takes_several(scattered, ~scattered) == several


@pytest.mark.parametrize("kept", [True, False])
def test_layers_of_a_part_are_continued_with_the_background(kept):
    """`kept`: whether the background is among the layers of the part."""
    box = (slice(10, 30), slice(5, 35))
    background = Motion.of_velocity(np.full((2, 40, 50), 0.1, np.float32))
    velocity = np.stack([np.full((2, 20, 30), v, np.float32) for v in (0.1 if kept else 0.3, 0.5)])
    label = np.zeros((20, 30), np.int32)
    label[5:15, 10:20] = 1
    inner = Layers(velocity, np.zeros_like(velocity), label, np.array([0, 1], np.int32))
    whole = Motion.of_layers(inner, np.full((20, 30), 0.5, np.float32)).within(background, *box)
    assert whole.layers is not None
    np.testing.assert_array_equal(whole.velocity[:, *box], np.take_along_axis(velocity, label[None, None], 0)[0])
    outside = np.ones((40, 50), bool)
    outside[box] = False
    assert (whole.velocity[:, outside] == np.float32(0.1)).all() and (whole.confidence[outside] == 1).all()
    assert len(whole.layers.depth) == (2 if kept else 3)
    behind = whole.layers.depth[whole.layers.label[0, 0]]
    assert (behind <= whole.layers.depth).all() and (whole.layers.label[outside] == whole.layers.label[0, 0]).all()
    # At the key frame each pixel sees itself.
    path = trajectory_of(whole, key=8, start=8, stop=9)
    np.testing.assert_allclose(path.position[0], np.mgrid[0:40, 0:50], atol=1e-5)


def test_layers_that_do_not_serve_leave_it_to_others(small, usual, monkeypatch):
    _, pictures = small
    layered = automatic.layered
    assert usual.layers is not None

    def found_by(*, with_good: bool = False, with_scattered: bool = True) -> Motion:
        def candidates(part, before, everywhere, moving, total, *, skip, sparse):
            label = np.random.default_rng(0).integers(0, 2, moving.shape).astype(np.int32)
            velocity = np.stack([before.velocity, before.velocity + 0.1])
            scattered = Layers(velocity, np.zeros_like(velocity), label, np.array([0, 1], np.int32))
            found = [Motion.of_layers(scattered, everywhere.confidence)] if with_scattered else []
            more = layered(part, before, everywhere, moving, total, skip=skip, sparse=sparse) if with_good else []
            return [*(lambda motion=motion: motion for motion in [before, *found]), *more]

        monkeypatch.setattr(automatic, "layered", candidates)
        return Automatic()(pictures)

    np.testing.assert_array_equal(found_by(with_good=True).velocity, usual.velocity)
    monkeypatch.setattr(automatic, "_PREDICTS", 2.0)  # so that it is no matter of how well the dense estimate predicts
    dense = found_by()
    assert dense.layers is None and (dense.speed > 0.1).mean() > 0.02  # pixel by pixel
    alone = found_by(with_scattered=False)
    assert alone.layers is None and not alone.speed.any()


@pytest.mark.parametrize("skip", [True, False])
def test_layers_that_predict_clearly_better_than_the_dense_estimate_are_enough(
    small, usual, everything, skip, monkeypatch
):
    """What has the dense estimate as one more layer is made then only if nothing is to be skipped, and not chosen."""
    _, pictures = small
    layered, good, asked = automatic.layered, usual if skip else everything, []
    assert good.layers is not None

    def with_another(*given, **options):
        makers = layered(*given, **options)

        def another() -> Motion:
            asked.append(None)
            return makers[0]()

        return [makers[0], another]

    def found(clearly: float) -> tuple[Motion, int]:
        asked.clear()
        monkeypatch.setattr(automatic, "_CLEARLY", clearly)
        return Automatic(skip=skip)(pictures), len(asked)

    monkeypatch.setattr(automatic, "layered", with_another)
    first, made = found(1.0)
    assert made == (0 if skip else 1)
    assert first.layers is not None
    np.testing.assert_array_equal(first.layers.label, good.layers.label)
    if skip:
        assert found(0.0)[1] == 1


def test_only_what_accelerates_is_given_an_acceleration(small, monkeypatch):
    """An object that does not accelerate would lose by the freedom to; without it, a turning disc falls apart."""
    wall = data.gravel()[40 : 40 + SCALE * SHAPE[0], 40 : 40 + SCALE * SHAPE[1]] / 255
    disc = TurningDisc(wall, color.rgb2gray(data.coffee())[100:200, 100:200], 0.0068, radius=110.0)
    turning = stretches(simulate(disc, scale=SCALE, seed=2).spikes, key=KEY)
    taken: list[int | None] = []
    accelerated, layered, given = automatic.accelerated, automatic.layered, []

    def watched(part, motion, *, start, turns=None):
        taken.append(turns)
        return accelerated(part, motion, start=start, **({} if turns is None else {"turns": turns}))

    def told(part, before, everywhere, moving, total, *, skip, sparse):
        given.append(everywhere)
        return layered(part, before, everywhere, moving, total, skip=skip, sparse=sparse)

    monkeypatch.setattr(automatic, "accelerated", watched)
    monkeypatch.setattr(automatic, "layered", told)
    steady = Automatic()(small[1])
    assert taken == [1] and not given[-1].acceleration.any()
    assert steady.layers is not None and not np.median(steady.acceleration[:, steady.layers.label > 0])
    taken.clear()
    Automatic()(turning)
    assert taken == [1, 2]
    # −ω² r towards the middle: told apart from nothing in the outer half of the disc.
    rows, columns = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    outwards = np.stack([rows - (SHAPE[0] - 1) / 2, columns - (SHAPE[1] - 1) / 2])
    distance = np.hypot(*outwards)
    outer = (distance > 25) & (distance < 50)
    assert given[-1].acceleration.shape[1:] == SHAPE, "the part looked at is the whole sensor"
    found = (given[-1].acceleration * outwards).sum(0)[outer] / distance[outer]
    truth = -(0.0068**2) * distance[outer]
    assert np.median(found / truth) > 0.5, np.median(found / truth)
