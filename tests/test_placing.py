"""Which samples get how many positions along their exposure, and which pixels' intervals are merged."""

import numpy as np
import pytest

from scsr_opt.camera import Intervals, simulate
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.scenes import Translation
from scsr_opt.motion import Motion
from scsr_opt.placing import Measurements, _positions, measured, stream_around

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
    ends = np.cumsum([number for number, _ in taken.placed.positions])
    given = np.array([k for _, k in taken.placed.positions])[np.searchsorted(ends, np.arange(moved.size), "right")]
    needed = np.where(moved < 0.375, 1, np.where(moved < 3 * 0.375, 3, 5))
    assert set(needed) == {1, 3, 5}
    assert (given >= needed).all()
    # Some get more than they need, so that there are few different programs: at most four times as many, or an eighth.
    total = taken.padded.row.size
    for k in (3, 5):
        assert np.count_nonzero(given >= k) <= max(4 * np.count_nonzero(needed >= k), total // 8)
    assert sum(number for number, _ in taken.placed.positions) == total


def test_samples_and_their_places_stay_together(spikes):
    """Sorted by what they need or not: the same samples, each at its own place."""
    taken = measurements(spikes, 0.25)
    n = taken.samples.row.size
    for field in ("row", "column", "start", "stop", "value", "weight"):
        np.testing.assert_array_equal(getattr(taken.padded, field)[:n], getattr(taken.samples, field))
    np.testing.assert_array_equal(np.asarray(taken.placed.value), taken.padded.value)
    ends = np.cumsum([number for number, _ in taken.placed.positions])
    for (number, k), taps, end in zip(taken.placed.positions, taken.placed.taps, ends, strict=True):
        some = slice(end - number, min(end, n))
        middle = np.asarray(taps.index)[k // 2][: some.stop - some.start]
        row, column = np.divmod(middle, 2 * WIDTH)
        column = column + np.asarray(taps.right)[k // 2][: some.stop - some.start]
        # Trajectories begin and end with the recording.
        time = np.clip((taken.samples.start + taken.samples.stop)[some] / 2, 0, FRAMES - 1) - 32
        used = np.asarray(taken.placed.weight)[some] > 0
        assert used.any()
        np.testing.assert_allclose(column[used], 2 * (taken.samples.column[some] - 0.25 * time)[used], atol=1e-3)
        np.testing.assert_array_equal(row[used], 2 * taken.samples.row[some][used])


@pytest.mark.parametrize(
    ("needed", "expected"),
    [
        ((0, 0, 0), ((1024, 1),)),
        ((0, 0, 900), ((1024, 1),)),
        ((1, 0, 900), ((128, 5), (896, 1))),
        ((70, 500, 300), ((128, 5), (896, 3))),
        ((70, 300, 500), ((128, 5), (384, 3), (512, 1))),
        ((128, 384, 500), ((128, 5), (384, 3), (512, 1))),
        ((129, 200, 500), ((512, 5), (512, 1))),
        ((600, 0, 0), ((1024, 5),)),
    ],
)
def test_few_different_numbers_of_positions(needed, expected):
    assert _positions(list(needed), 1024) == expected


def test_intervals_are_merged_where_much_of_the_scene_rests_long(spikes):
    half = np.zeros((HEIGHT, WIDTH), np.float32)
    half[:, : WIDTH // 2] = 0.25
    resting = measurements(spikes, half)
    assert (resting.merged_for[:, WIDTH // 2 + 12 :] == FRAMES).all()
    assert (resting.merged_for[:, : WIDTH // 2 - 2] == 1).all()
    half[:, :-4] = 0.25
    assert (measurements(spikes, half).merged_for == 1).all()
    assert (measurements(spikes, 0.0, merge=False).merged_for == 1).all()
