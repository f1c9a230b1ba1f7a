"""Which samples get how many positions along their exposure, and which pixels' intervals are merged."""

import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.camera import Intervals, Sensor, simulate
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.samples import Samples
from scsr_opt.camera.scenes import Translation
from scsr_opt.motion import Motion
from scsr_opt.motion.trajectory import SPACING, Trajectory
from scsr_opt.placing import Measurements, _cut_to_seen, _longest_first, measured, stream_around

HEIGHT, WIDTH, FRAMES = 24, 32, 65


@pytest.fixture(scope="module")
def spikes() -> np.ndarray:
    """A picture with a dark and a bright half; what moves is said by each test."""
    picture = np.full((2 * HEIGHT, 2 * WIDTH), 0.9)
    picture[:, : WIDTH // 2] = 0.1
    return simulate(Translation(picture, (0.0, 0.0), key=32), scale=2, frames=FRAMES, seed=0).spikes


def measurements(spikes: np.ndarray, speed: np.ndarray | float, **options) -> Measurements:
    _, stream = stream_around(Recording.from_array(spikes), key=32, frames=FRAMES, white_rate=0.6)
    velocity = np.zeros((2, HEIGHT, WIDTH), np.float32)
    velocity[1] = speed
    return measured(stream, Motion.of_velocity(velocity), scale=2, measuring=Intervals(), **options)


def test_each_exposure_gets_the_positions_that_its_motion_needs(spikes):
    """3/8 of a sensor pixel from one to the next, as far as five positions go."""
    taken = measurements(spikes, 0.25)
    moved = 0.25 * (taken.samples.stop - taken.samples.start)
    needed = np.where(moved < 0.375, 1, np.where(moved < 3 * 0.375, 3, 5))
    assert set(needed) == {1, 3, 5}
    np.testing.assert_array_equal(taken.placed.positions[: moved.size], needed)
    assert taken.placed.finest == 5 and not taken.placed.positions[moved.size :].any()
    assert (np.diff(taken.placed.positions) <= 0).all()  # so that others can be passed over
    assert measurements(spikes, 0.0).placed.finest == 1


def test_samples_and_their_places_stay_together(spikes):
    """Sorted by what they need or not: the same samples, each at its own place."""
    taken = measurements(spikes, 0.25)
    n = taken.samples.row.size
    for field in ("row", "column", "start", "stop", "value", "weight"):
        np.testing.assert_array_equal(getattr(taken.padded, field)[:n], getattr(taken.samples, field))
    np.testing.assert_array_equal(np.asarray(taken.placed.value), taken.padded.value)
    row, column = np.divmod(np.asarray(taken.placed.taps.index[0])[:n], 2 * WIDTH)
    column = column + np.asarray(taken.placed.taps.right[0])[:n]
    # Trajectories begin and end with the recording.
    time = np.clip((taken.samples.start + taken.samples.stop) / 2, 0, FRAMES - 1) - 32
    used = np.asarray(taken.placed.weight)[:n] > 0
    assert used.mean() > 0.5
    np.testing.assert_allclose(column[used], 2 * (taken.samples.column - 0.25 * time)[used], atol=1e-3)
    np.testing.assert_array_equal(row[used], 2 * taken.samples.row[used])


def test_intervals_are_merged_where_much_of_the_scene_rests_long(spikes):
    half = np.zeros((HEIGHT, WIDTH), np.float32)
    half[:, : WIDTH // 2] = 0.25
    resting = measurements(spikes, half)
    assert (resting.merged_for[:, WIDTH // 2 + 12 :] == FRAMES).all()
    assert (resting.merged_for[:, : WIDTH // 2 - 2] == 1).all()
    half[:, :-4] = 0.25
    assert (measurements(spikes, half).merged_for == 1).all()
    assert (measurements(spikes, 0.0, merge=False).merged_for == 1).all()


@pytest.mark.parametrize(
    ("pixels", "moved", "positions"), [(1, 0.4, {1}), (12, 0.4, {1, 3}), (1, 1.2, {1, 5})], ids=["few", "many", "far"]
)
def test_few_exposures_that_are_a_little_long_do_not_put_all_through_corrections(pixels, moved, positions):
    """One pixel in 20,000 may be blurred by its motion; not an object, nor what needs five positions."""
    row, column = np.divmod(np.arange(20_000, dtype=np.int32), 200)
    ones = np.ones(row.size, np.float32)
    samples = Samples(row, column, 0 * ones, ones, 0.5 * ones, ones)
    speed = np.zeros((100, 200), np.float32)
    speed[7, 40 : 40 + pixels] = moved
    ordered, found = _longest_first(samples, speed)
    assert set(found.tolist()) == positions
    if len(positions) > 1:
        assert (ordered.row[:pixels] == 7).all() and (found[:pixels] > 1).all()


def pixel_seen(*, visible: np.ndarray, out: np.ndarray | None = None) -> Trajectory:
    """What the pixel of a sensor of one sees at moments four frames apart; `out` of the picture or not."""
    position = np.zeros((visible.size, 2, 1, 1), np.float32)
    position[:, 1, 0, 0] = 0 if out is None else 3.0 * out
    return Trajectory(jnp.float32(0), jnp.asarray(position), jnp.asarray(visible, jnp.float32)[:, None, None])


def exposure(start: float, stop: float, thresholds: float, *, each: float = 1.0) -> Samples:
    """A sample of a pixel that fires at every fourth frame in white light."""
    nothing, (begin, end) = np.zeros(1, np.int32), (np.full(1, v, np.float32) for v in (start, stop))
    return Samples(nothing, nothing, begin, end, thresholds * 4 / (end - begin), each * (end - begin))


@pytest.mark.parametrize(
    ("start", "stop", "begin", "end", "thresholds"),
    [(10.0, 50.0, 10.0, 28.0, 0.5), (2.0, 62.0, 2.0, 28.0, 0.5), (-0.5, 50.0, 0.0, 28.0, 0.0)],
    ids=["a spike at its start", "longer", "the opening end"],
)
@pytest.mark.parametrize("how", ["hidden", "out"])
def test_an_interval_is_cut_to_the_time_that_its_pixel_can_be_used(start, stop, begin, end, thresholds, how):
    """From frame 28 on the pixel sees what the key frame does not show: as if the recording ended there."""
    seen = np.arange(0, 69, SPACING) <= 28
    path = pixel_seen(visible=seen.astype(float)) if how == "hidden" else pixel_seen(visible=1 + 0 * seen, out=~seen)
    cut = _cut_to_seen(exposure(start, stop, 1.0), path, 65, white_rate=0.25, ends=0.1)
    np.testing.assert_allclose([cut.start[0], cut.stop[0]], [begin, end])
    np.testing.assert_allclose(cut.value * (end - begin), thresholds * 4, rtol=1e-6)
    np.testing.assert_allclose(cut.weight, 0.1 * (end - begin), rtol=1e-6)


def test_of_an_interval_seen_in_the_middle_only_its_darkness_is_known():
    """No spike begins or ends the stretch: nothing was gathered, as of a pixel that never fires."""
    seen = np.isin(np.arange(0, 69, SPACING), [20, 24, 28, 32, 48, 52])  # of two stretches the longer one
    cut = _cut_to_seen(exposure(4.0, 60.0, 1.0), pixel_seen(visible=seen.astype(float)), 65, white_rate=0.25, ends=0.1)
    assert (cut.start[0], cut.stop[0], cut.value[0]) == (20.0, 32.0, 0.0)


@pytest.mark.parametrize(
    ("sample", "visible"),
    [
        (exposure(10.0, 50.0, 1.0), np.ones(18)),
        (exposure(10.0, 50.0, 1.0), np.where(np.arange(18) < 8, 1.0, 0.3)),  # worth 0.3 of 40 frames, cut 0.1 of 18
        (exposure(24.0, 31.0, 1.0), (np.arange(18) < 8).astype(float)),
        (exposure(10.0, 50.0, 9.0), (np.arange(18) < 8).astype(float)),
        (exposure(10.0, 50.0, 1.0), np.zeros(18)),
    ],
    ids=["seen all the time", "worth more as it is", "short", "many spikes", "never seen"],
)
def test_other_samples_stay_as_they_are(sample, visible):
    same = _cut_to_seen(sample, pixel_seen(visible=visible), 65, white_rate=0.25, ends=0.1)
    for field in ("start", "stop", "value", "weight"):
        np.testing.assert_array_equal(getattr(same, field), getattr(sample, field))


def test_a_dim_scene_that_passes_through_a_small_picture_keeps_its_light():
    """A pixel a frame, 24 of them, an interval of 40 frames: hardly one lies within the picture from end to end."""
    picture = np.full((48, 260), 0.25)
    made = simulate(Translation(picture, (0.0, 2.0), key=32), scale=2, frames=FRAMES, sensor=Sensor(white_rate=0.1))
    _, stream = stream_around(Recording.from_array(made.spikes[:, :, 60:84]), key=32, frames=FRAMES, white_rate=0.1)
    velocity = np.zeros((2, 24, 24), np.float32)
    velocity[1] = 1.0
    placed = measured(stream, Motion.of_velocity(velocity), scale=2, measuring=Intervals()).placed
    light = float(placed.weight @ placed.value / placed.weight.sum())
    # 0.223 measured: stretches shorter than SPACING are left out, in which the ½θ of an end is brightest.
    assert 0.75 * 0.25 < light < 1.25 * 0.25
