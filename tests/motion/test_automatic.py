"""`Automatic`: its choice, and the work that it leaves out where a scene does not need it."""

import numpy as np
import pytest
from skimage import color, data

from scsr_opt.camera.scenes import Box, MovingObject, TurningDisc
from scsr_opt.camera.simulator import Simulation, simulate
from scsr_opt.motion import Automatic, Motion, trajectory_of
from scsr_opt.motion.estimators import automatic
from scsr_opt.motion.estimators.frames import MotionFrames, motion_frames
from scsr_opt.motion.estimators.settings import ChoiceSettings
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
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
    return made, motion_frames(made.spikes, key=KEY)


@pytest.fixture(scope="module")
def usual(small) -> Motion:
    return Automatic()(small[1])


@pytest.fixture(scope="module")
def everything(small) -> Motion:
    """With nothing left out."""
    return Automatic(simple_motion=False)(small[1])


def test_object_before_a_still_wall_is_searched_for_around_it_only(small, everything, monkeypatch):
    made, pictures = small
    searched = []
    dense = automatic.dense

    def watched(part, **options):
        searched.append(part.picture.shape[1:])
        return dense(part, **options)

    monkeypatch.setattr(automatic, "dense", watched)
    monkeypatch.setattr(automatic, "global_motion", lambda *_, **__: pytest.fail("one motion was fitted to the scene"))
    found = Automatic()(pictures)
    assert np.prod(searched[0]) < 0.7 * np.prod(SHAPE)

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
    def needs_several(resting: np.ndarray, moving: np.ndarray) -> bool:
        return automatic._needs_several_motions(resting, moving, DEFAULTS.choice)

    rows, columns = np.mgrid[0:100, 0:120]
    inside = np.hypot(rows - 50, columns - 60)
    # A turn about the middle: at rest there, and the faster the farther out.
    assert not needs_several(inside < 20, inside > 40)
    assert needs_several(inside > 40, inside < 20)
    assert needs_several(columns < 60, (columns > 70) & (columns < 85))
    assert not needs_several(np.zeros((100, 120), bool), inside > 40)
    assert not needs_several(rows == 50, inside > 40)  # in one line: it may be the axis of a shear
    for side, several in ((6, False), (10, True)):  # 4 % of the sensor may be so by mistake, 12 % are not
        scattered = (rows % 30 < side) & (columns % 30 < side)
        assert needs_several(scattered, ~scattered) == several


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


def test_scattered_layers_are_replaced_by_others(small, usual, monkeypatch):
    _, pictures = small
    layered = automatic.layered
    assert usual.layers is not None

    def found_by(choice: ChoiceSettings, *, with_good: bool = False, with_scattered: bool = True) -> Motion:
        def candidates(part, before, everywhere, moving, total, **options):
            label = np.random.default_rng(0).integers(0, 2, moving.shape).astype(np.int32)
            velocity = np.stack([before.velocity, before.velocity + 0.1])
            scattered = Layers(velocity, np.zeros_like(velocity), label, np.array([0, 1], np.int32))
            found = [Motion.of_layers(scattered, everywhere.confidence)] if with_scattered else []
            more = layered(part, before, everywhere, moving, total, **options) if with_good else []
            return [*(lambda motion=motion: motion for motion in [before, *found]), *more]

        monkeypatch.setattr(automatic, "layered", candidates)
        return Automatic(settings=MotionSettings(choice=choice))(pictures)

    np.testing.assert_array_equal(found_by(ChoiceSettings(), with_good=True).velocity, usual.velocity)
    any_residual = ChoiceSettings(prediction_ratio=2.0)  # accepts the dense estimate however well it predicts
    dense = found_by(any_residual)
    assert dense.layers is None and (dense.speed > 0.1).mean() > 0.02  # pixel by pixel
    alone = found_by(any_residual, with_scattered=False)
    assert alone.layers is None and not alone.speed.any()


@pytest.mark.parametrize("simple_motion", [True, False])
def test_layers_that_predict_clearly_better_than_the_dense_estimate_are_enough(
    small, usual, everything, simple_motion, monkeypatch
):
    """Layers with the dense estimate as one more are then made only without `simple_motion`, and are not chosen."""
    _, pictures = small
    layered, good, calls = automatic.layered, usual if simple_motion else everything, []
    assert good.layers is not None

    def with_another(*given, **options):
        makers = layered(*given, **options)

        def another() -> Motion:
            calls.append(None)
            return makers[0]()

        return [makers[0], another]

    def found(sufficient: float) -> tuple[Motion, int]:
        calls.clear()
        settings = MotionSettings(choice=ChoiceSettings(layers_sufficient_ratio=sufficient))
        return Automatic(simple_motion=simple_motion, settings=settings)(pictures), len(calls)

    monkeypatch.setattr(automatic, "layered", with_another)
    first, made = found(1.0)
    assert made == (0 if simple_motion else 1)
    assert first.layers is not None
    np.testing.assert_array_equal(first.layers.label, good.layers.label)
    if simple_motion:
        assert found(0.0)[1] == 1


def test_only_accelerating_surfaces_get_an_acceleration(small, monkeypatch):
    """An object that does not accelerate would lose accuracy; a turning disc would fall apart without acceleration."""
    wall = data.gravel()[40 : 40 + SCALE * SHAPE[0], 40 : 40 + SCALE * SHAPE[1]] / 255
    disc = TurningDisc(wall, color.rgb2gray(data.coffee())[100:200, 100:200], 0.0068, radius=110.0)
    turning = motion_frames(simulate(disc, scale=SCALE, seed=2).spikes, key=KEY)
    taken: list[int | None] = []
    accelerated, layered, given = automatic.accelerated, automatic.layered, []

    def watched_accelerated(part, motion, *, turns=None, **options):
        taken.append(turns)
        return accelerated(part, motion, turns=turns, **options)

    def watched_layered(part, before, everywhere, *rest, **options):
        given.append(everywhere)
        return layered(part, before, everywhere, *rest, **options)

    monkeypatch.setattr(automatic, "accelerated", watched_accelerated)
    monkeypatch.setattr(automatic, "layered", watched_layered)
    steady = Automatic()(small[1])
    assert taken == [1] and not given[-1].acceleration.any()
    assert steady.layers is not None and not np.median(steady.acceleration[:, steady.layers.label > 0])
    taken.clear()
    Automatic()(turning)
    assert taken == [1, 2]
    # −ω² r towards the middle: distinguished from zero in the outer half of the disc.
    rows, columns = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    outwards = np.stack([rows - (SHAPE[0] - 1) / 2, columns - (SHAPE[1] - 1) / 2])
    distance = np.hypot(*outwards)
    outer = (distance > 25) & (distance < 50)
    assert given[-1].acceleration.shape[1:] == SHAPE, "the part looked at is the whole sensor"
    found = (given[-1].acceleration * outwards).sum(0)[outer] / distance[outer]
    truth = -(0.0068**2) * distance[outer]
    assert np.median(found / truth) > 0.5, np.median(found / truth)
