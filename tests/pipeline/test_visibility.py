"""Intervals that can be used in part are cut to that part, and become ends."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt import reconstruct
from scsr_opt.camera import Intervals, Sensor, simulate
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.samples import Samples, spike_intervals
from scsr_opt.camera.scenes import Translation
from scsr_opt.motion import Motion
from scsr_opt.motion.trajectory import SPACING, Trajectory
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.measurement import measure
from scsr_opt.pipeline.scene_summary import TileKind
from scsr_opt.pipeline.visibility import cut_to_seen

FRAMES = 65
MOMENTS = np.arange(0, FRAMES + 3, SPACING)


def seen_by(visible: np.ndarray, *, out: np.ndarray | None = None) -> Trajectory:
    """Trajectory of what the pixels (n, 1, w) see at moments four frames apart; `out` of the picture or not."""
    moments, height, width = visible.shape
    position = np.broadcast_to(np.indices((height, width)), (moments, 2, height, width)).astype(np.float32)
    if out is not None:
        position = position + np.array([0, 99], np.float32)[:, None, None] * out[:, None]
    return Trajectory(jnp.float32(0), jnp.asarray(position), jnp.asarray(visible, jnp.float32))


def of_one(visible: np.ndarray) -> np.ndarray:
    return visible.astype(float)[:, None, None]


def exposures(*each: tuple[int, float, float, float]) -> Samples:
    """Pixel, start, stop and thresholds gathered of samples of a sensor of one row, white every fourth frame."""
    pixel, start, stop, thresholds = (np.array(v) for v in zip(*each, strict=True))
    start, stop, thresholds = (v.astype(np.float32) for v in (start, stop, thresholds))
    whole = (start >= 0) & (stop <= FRAMES - 1)
    duration = stop - start
    weight = duration * np.where(whole, np.float32(1), np.float32(0.1))
    row, column = np.zeros(pixel.size, np.int32), pixel.astype(np.int32)
    return Samples(row, column, start, stop, 4 * thresholds / duration, weight)


def cut(samples: Samples, path: Trajectory) -> Samples:
    return cut_to_seen(samples, path, frames=FRAMES, white_rate=0.25, ends=0.1)


def gathered(samples: Samples) -> np.ndarray:
    """Thresholds."""
    return np.asarray(samples.value * (samples.stop - samples.start) / 4)


@pytest.mark.parametrize(
    ("sample", "begin", "end", "thresholds"),
    [
        ((10, 50, 1), 10, 28, 0.5), ((2, 62, 1), 2, 28, 0.5),
        ((-0.5, 50, 0.5), -0.5, 28, 0), ((-0.5, 64.5, 0), -0.5, 28, 0),
    ],
    ids=["interval", "longer", "opening end", "no spike"],
)  # fmt: skip
@pytest.mark.parametrize("how", ["hidden", "out"])
def test_what_is_hidden_later_is_cut_as_if_the_recording_ended_there(sample, begin, end, thresholds, how):
    seen = of_one(MOMENTS <= 28)
    path = seen_by(seen) if how == "hidden" else seen_by(np.ones_like(seen), out=seen == 0)
    left = cut(exposures((0, *sample)), path)
    np.testing.assert_allclose([left.start[0], left.stop[0]], [begin, end])
    np.testing.assert_allclose(gathered(left), thresholds, rtol=1e-6)
    np.testing.assert_allclose(left.weight, 0.1 * (end - begin), rtol=1e-6)


@pytest.mark.parametrize(
    ("sample", "thresholds"), [((10, 50, 1), 0.5), ((30, 64.5, 0.5), 0)], ids=["interval", "closing end"]
)
def test_what_comes_into_view_late_is_cut_as_if_the_recording_began_there(sample, thresholds):
    left = cut(exposures((0, *sample)), seen_by(of_one(MOMENTS >= 36)))
    assert (left.start[0], left.stop[0]) == (36, sample[1])
    np.testing.assert_allclose(gathered(left), thresholds, rtol=1e-6)


def test_of_an_interval_seen_in_the_middle_only_its_darkness_is_known():
    """No spike begins or ends the stretch: nothing was gathered, as of a pixel that never fires."""
    seen = np.isin(MOMENTS, [20, 24, 28, 32, 48, 52])  # of two stretches the longer one
    left = cut(exposures((0, 4, 60, 1)), seen_by(of_one(seen)))
    assert (left.start[0], left.stop[0], left.value[0]) == (20, 32, 0)


@pytest.mark.parametrize(
    ("sample", "visible"),
    [
        ((10, 50, 1), np.ones(MOMENTS.size)),
        ((10, 50, 1), np.where(MOMENTS <= 28, 1.0, 0.3)),  # worth 0.3 of 40 frames, cut 0.1 of 18
        ((10, 29, 1), MOMENTS <= 28),  # what is hidden next does not matter
        ((24, 31, 1), MOMENTS <= 28),
        ((10, 50, 9), MOMENTS <= 28),
        ((10, 50, 1), 0 * MOMENTS),
    ],
    ids=["seen all the time", "worth more as it is", "hidden afterwards", "short", "many spikes", "never seen"],
)
def test_other_samples_stay_as_they_are(sample, visible):
    same = cut(exposures((0, *sample)), seen_by(of_one(visible)))
    for field in dataclasses.fields(Samples):
        np.testing.assert_array_equal(getattr(same, field.name), getattr(exposures((0, *sample)), field.name))


def test_each_of_many_samples_is_cut_by_its_own_pixel():
    """Short and long ones in any order, of pixels of which the second and the fourth are hidden in part."""
    visible = np.ones((MOMENTS.size, 1, 4))
    visible[MOMENTS > 40, 0, 1] = 0
    visible[MOMENTS < 20, 0, 3] = 0
    left = cut(
        exposures(
            (3, 2, 12, 1), (1, 30, 60, 1), (0, 5, 64, 1), (3, 12, 26, 1), (2, 0, 60, 1), (1, 3, 30, 1), (3, 26, 27, 1),
        ),
        seen_by(visible),
    )  # fmt: skip
    np.testing.assert_array_equal(left.column, [3, 1, 0, 3, 2, 1, 3])
    np.testing.assert_array_equal(left.start, [2, 30, 5, 20, 0, 3, 26])
    np.testing.assert_array_equal(left.stop, [12, 40, 64, 26, 60, 30, 27])
    np.testing.assert_allclose(gathered(left), [1, 0.5, 1, 0.5, 1, 1, 1], rtol=1e-6)


def test_at_rest_and_without_a_sample_nothing_is_done():
    one = Trajectory(jnp.float32(0), jnp.zeros((1, 2, 1, 1)), jnp.ones((1, 1, 1)))
    sample = exposures((0, 10, 50, 1))
    assert cut(sample, one) is sample
    empty = spike_intervals(np.zeros((FRAMES, 1, 1), np.uint8), ends=0.0)
    assert cut(empty, seen_by(of_one(MOMENTS <= 28))).row.size == 0


def passing(white_rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Grey that passes 24 pixels at a pixel a frame, and its velocity."""
    picture = np.full((48, 260), 0.25)
    sensor = Sensor(white_rate=white_rate)
    made = simulate(Translation(picture, (0.0, 2.0), key=32), scale=2, frames=FRAMES, sensor=sensor)
    velocity = np.zeros((2, 24, 24), np.float32)
    velocity[1] = 1.0
    return made.spikes[:, :, 60:84], velocity


def test_measure_dim_scene_passing_through_a_small_picture_keeps_its_light():
    """An interval lasts 40 frames: not one lies within the picture from end to end."""
    spikes, velocity = passing(0.1)
    clip = Clip.around(Recording.from_array(spikes), 32, frames=FRAMES, white_rate=0.1)
    placed = measure(clip, Motion.of_velocity(velocity), scale=2, sampling=Intervals()).placed
    light = float(placed.weight @ placed.value / placed.weight.sum())
    # Short stretches are left out, in which the ½θ of an end is brightest (0.245 measured).
    assert 0.9 * 0.25 < light < 1.1 * 0.25


def test_scene_summary_counts_what_was_cut_as_out_of_view():
    """Most of what each pixel sees is out of view at the key frame, as it was before anything was cut."""
    spikes, velocity = passing(0.1)
    solution = reconstruct(spikes, scale=2, key=32, frames=FRAMES, white_rate=0.1, motion=Motion.of_velocity(velocity))
    scene = solution.scene
    assert scene is not None and (scene.used < 0.1).all()
    assert scene.share(TileKind.FAST) + scene.share(TileKind.DARK) == 1
