"""Which samples get how many positions along their exposure, and which pixels' intervals are merged."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.camera import Intervals, simulate
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.samples import Samples
from scsr_opt.camera.scenes import Translation
from scsr_opt.motion import Motion
from scsr_opt.motion.trajectory import SPACING, Trajectory, Trust
from scsr_opt.operators.sampling import moments
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.measurement import _POSITIONS, Measurements, _longest_first, measure
from scsr_opt.pipeline.settings import SamplingSettings

HEIGHT, WIDTH, FRAMES = 24, 32, 65


@pytest.fixture(scope="module")
def spikes() -> np.ndarray:
    """A picture with a dark and a bright half; what moves is said by each test."""
    picture = np.full((2 * HEIGHT, 2 * WIDTH), 0.9)
    picture[:, : WIDTH // 2] = 0.1
    return simulate(Translation(picture, (0.0, 0.0), key=32), scale=2, frames=FRAMES, seed=0).spikes


def measurements(spikes: np.ndarray, speed: np.ndarray | float, **options) -> Measurements:
    clip = Clip.around(Recording.from_array(spikes), 32, frames=FRAMES, white_rate=0.6)
    velocity = np.zeros((2, HEIGHT, WIDTH), np.float32)
    velocity[1] = speed
    return measure(clip, Motion.of_velocity(velocity), scale=2, sampling=Intervals(), **options)


def test_measure_each_exposure_has_the_positions_that_its_motion_needs(spikes):
    """As many as miss no more than 0.0013 of the light, as far as five positions go."""
    taken = measurements(spikes, 0.09)
    moved = 0.09 * (taken.samples.stop - taken.samples.start)
    needed = np.select([moved < 0.1, moved < 0.5, moved < 0.7], [1, 2, 3], 5)
    assert set(needed) == {1, 2, 3, 5}
    np.testing.assert_array_equal(taken.placed.positions[: moved.size], needed)
    assert taken.placed.finest == 5 and not taken.placed.positions[moved.size :].any()
    assert (np.diff(taken.placed.positions) <= 0).all()  # so that others can be passed over
    assert measurements(spikes, 0.0).placed.finest == 1


def missed(positions: int, moved: float) -> float:
    """Share of the light of an exposure that positions miss, for pictures with power ν⁻² up to 2 cycles per sensor
    pixel, behind an aperture of one."""
    cycles = np.linspace(0.02, 2, 400)
    start, stop, number = jnp.asarray([-moved / 2]), jnp.asarray([moved / 2]), jnp.asarray([positions])
    places = np.array([float(moments(start, stop, number, k)[0]) for k in range(positions)])
    read = np.cos(2 * np.pi * cycles * places[:, None]).mean(0)
    light = np.sinc(cycles) ** 2 / cycles**2
    return float(np.sqrt((light * (read - np.sinc(cycles * moved)) ** 2).sum() / light.sum()))


def test_no_exposure_misses_much_of_the_light():
    for fewer, reach in zip(_POSITIONS[1:], SamplingSettings().positions_motion_px, strict=True):
        assert missed(fewer, reach) < 0.0014
    assert missed(5, 1.95) < 0.003


def test_a_pixel_before_which_something_passes_needs_more_positions_only_then():
    """At rest but for one step of the trajectory, from frame 20 to 24."""
    position = np.zeros((16, 2, 3, 4), np.float32)
    position[6:, 1, 1, 2] = 2.0
    path = Trajectory(jnp.float32(0), jnp.asarray(position), jnp.ones((16, 3, 4)))
    # Before it, in it, after it, beyond the moments, over all of it, and next to it.
    row, column = np.full(6, 1, np.int32), np.array([2, 2, 2, 2, 2, 1], np.int32)
    start, stop = np.array([[4, 7], [21, 23], [25, 28], [58, 62], [2, 50], [21, 23]], np.float32).T
    np.testing.assert_allclose(path.speeds.during(row, column, start, stop), [0, 0.5, 0, 0, 0.5, 0])
    np.testing.assert_allclose(path.speeds.most[1], [0, 0, 0.5, 0])


def seen_until(frame: int) -> Trajectory:
    """A scene at rest of which one pixel, (1, 2), is hidden from `frame` on, a moment of the trajectory."""
    visible = np.ones((FRAMES // SPACING + 1, HEIGHT, WIDTH), np.float32)
    visible[frame // SPACING :, 1, 2] = 0
    return Trajectory(jnp.float32(0), jnp.zeros((visible.shape[0], 2, HEIGHT, WIDTH)), jnp.asarray(visible))


@pytest.mark.parametrize("how", ["hidden", "out of the picture"])
def test_measure_intervals_of_what_is_lost_are_not_merged(how):
    """Saturated all the time: merged by fours, but for the four frames in which the pixel is hidden, or sees beyond."""
    spikes = np.ones((FRAMES, HEIGHT, WIDTH), np.uint8)
    clip = Clip.around(Recording.from_array(spikes), 32, frames=FRAMES, white_rate=1.0)
    # The scene moves a little, so that nothing else is merged.
    path = seen_until(20)
    moving = 0.1 * SPACING * jnp.arange(len(path.visible), dtype=jnp.float32)[:, None, None, None]
    position = jnp.broadcast_to(moving, path.position.shape)
    visible = path.visible
    if how != "hidden":
        position, visible = jnp.where(visible[:, None] == 0, -1.0, position), jnp.ones(visible.shape)
    path = Trajectory(path.first, position, visible)
    samples = measure(clip, path, scale=2, sampling=Intervals(ends=0)).samples
    there = (samples.row == 1) & (samples.column == 2)
    assert sorted(samples.start[there]) == [*range(0, 16, 4), 16, 17, 18, 19, *range(20, 64, 4)]
    elsewhere = (samples.row == 5) & (samples.column == 5)
    assert sorted(samples.start[elsewhere]) == [*range(0, 64, 4)]


def test_an_exposure_that_is_hidden_before_its_end_has_more_than_one_position():
    """With one, in the middle, it would count in full."""
    path = seen_until(20)
    row, column = np.array([1, 1, 1, 5], np.int32), np.array([2, 2, 2, 5], np.int32)
    start, stop = np.array([[2, 7], [10, 20], [30, 34], [10, 20]], np.float32).T
    ones = np.ones(4, np.float32)
    samples = Samples(row, column, start, stop, ones, ones)
    order, positions = _longest_first(samples, path.speeds, path.unsteady, each=True)
    assert order[0] == 1 and positions.tolist() == [2, 1, 1, 1]


@pytest.mark.parametrize("speed", [0.0, 0.25])
def test_the_light_seen_is_that_of_the_samples(spikes, speed):
    """At rest each pixel's own; in motion where the middle of the exposures is."""
    taken = measurements(spikes, speed)
    samples, weight = taken.samples, np.asarray(taken.placed.weight, float)[: taken.samples.row.size]
    time = np.clip((samples.start + samples.stop) / 2, 0, FRAMES - 1) - 32
    column = np.floor(samples.column - speed * time + 0.5 + 1e-3)
    inside = (weight > 0) & (column >= 0) & (column < WIDTH)
    expected = np.zeros((HEIGHT, WIDTH))
    np.add.at(expected, (samples.row[inside], column[inside].astype(int)), weight[inside])
    found = np.asarray(taken.placed.seen())
    assert found.sum() == pytest.approx(weight.sum(), rel=1e-5)
    assert np.abs(found - expected).sum() <= (1e-4 if speed == 0 else 0.02) * weight.sum()  # rounding of places


def test_samples_and_their_places_stay_together(spikes):
    """Sorted by what they need or not: the same samples, each at its own place."""
    taken = measurements(spikes, 0.25)
    n = taken.samples.row.size
    for field in ("row", "column", "start", "stop", "value", "weight"):
        np.testing.assert_array_equal(getattr(taken.padded, field)[:n], getattr(taken.samples, field))
    np.testing.assert_array_equal(np.asarray(taken.placed.value), taken.padded.value)
    row, column = np.divmod(np.asarray(taken.placed.taps.index[0])[:n], 2 * WIDTH)
    column = column + np.asarray(taken.placed.taps.right[0])[:n]
    start, stop = jnp.asarray(taken.samples.start), jnp.asarray(taken.samples.stop)
    first = moments(start, stop, taken.placed.positions[:n], 0)
    # Trajectories begin and end with the recording.
    time = np.clip(first, 0, FRAMES - 1) - 32
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
    assert (measurements(spikes, 0.0, merged_intervals=False).merged_for == 1).all()


@pytest.mark.parametrize(
    ("pixels", "moved", "positions"), [(1, 0.4, {1}), (12, 0.4, {1, 2}), (1, 1.7, {1, 5})], ids=["few", "many", "far"]
)
def test_few_exposures_that_are_a_little_long_do_not_put_all_through_corrections(pixels, moved, positions):
    """One pixel in 20,000 may be blurred by its motion; not an object, nor what moves farther."""
    row, column = np.divmod(np.arange(20_000, dtype=np.int32), 200)
    ones = np.ones(row.size, np.float32)
    samples = Samples(row, column, 0 * ones, ones, 0.5 * ones, ones)
    position = np.zeros((2, 2, 100, 200), np.float32)
    position[1, 1, 7, 40 : 40 + pixels] = SPACING * moved
    path = Trajectory(jnp.float32(0), jnp.asarray(position), jnp.ones((2, 100, 200)))
    order, found = _longest_first(samples, path.speeds, path.unsteady, each=True)
    assert set(found.tolist()) == positions
    assert set(_longest_first(samples, path.speeds, path.unsteady, each=False)[1].tolist()) == {max(positions)}
    if len(positions) > 1:
        assert (row[order[:pixels]] == 7).all() and (found[:pixels] > 1).all()


def test_used_frames_are_those_before_and_after_the_key_frame_whose_samples_have_weight(spikes):
    """Constant light: all frames at rest; half of them where the motion is trusted for that long only."""
    light = np.zeros_like(spikes)
    light[::2] = 1
    throughout = measurements(light, 0.0)
    np.testing.assert_allclose(throughout.used_frames(32), FRAMES // 2, rtol=0.02)
    after = np.arange(-32, 33, 4, dtype=np.float32)
    share = np.broadcast_to((np.abs(after) <= 16)[:, None, None], (after.size, HEIGHT, WIDTH)).astype(np.float32)
    clip = Clip.around(Recording.from_array(light), 32, frames=FRAMES, white_rate=0.6)
    motion = dataclasses.replace(Motion.none(HEIGHT, WIDTH), trust=Trust(after, share))
    part = measure(clip, motion, scale=2, sampling=Intervals(), merged_intervals=False)
    np.testing.assert_allclose(part.used_frames(32), 18, rtol=0.1)  # the weight falls to 0 from 16 to 20
    dark = measure(
        Clip.around(Recording.from_array(np.zeros_like(light)), 32), Motion.none(HEIGHT, WIDTH), scale=2,
        sampling=Intervals(ends=0),
    )  # fmt: skip
    assert not dark.used_frames(32).any()


def test_measurements_that_are_let_go_cannot_be_read(spikes):
    taken = measurements(spikes, 0.09)
    gains = taken.with_gain(np.ones((HEIGHT, WIDTH)), np.ones((HEIGHT, WIDTH), bool), 0.01)
    picture = jnp.zeros(taken.placed.shape)
    taken.placed.read(picture)
    taken.let_go()
    for gone in (taken, gains):  # they share their places
        with pytest.raises(RuntimeError, match="deleted"):
            gone.placed.read(picture)
    assert taken.samples.row.size > 0 and np.isfinite(taken.used_frames(10)).all()
