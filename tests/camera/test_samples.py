"""Samples against a slow loop that knows Eq. 1 only, and against light that is known."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from scsr_opt.camera.samples import RUN_FRAMES, Samples, mean_light, spike_intervals, windows
from scsr_opt.camera.spike_times import SpikeTimes
from scsr_opt.errors import InputError

RATE = 0.6
FIELDS = ("row", "column", "start", "stop", "value", "weight")

recordings = st.tuples(st.integers(1, 40), st.integers(1, 3), st.integers(1, 4)).flatmap(
    lambda shape: arrays(np.uint8, shape, elements=st.integers(0, 1))
)


def expected(
    spikes: np.ndarray, shortest: np.ndarray, first_frame: int, run: np.ndarray | None = None
) -> list[tuple[float, ...]]:
    """The samples, one pixel and one spike after another."""
    found = []
    for row, column in np.ndindex(spikes.shape[1:]):
        times = [t for t in range(len(spikes)) if spikes[t, row, column]]
        length = int(shortest[row, column])
        # Inside a run of spikes in frame after frame only every fourth frame is kept.
        blocks = np.full((1, *spikes.shape[1:]), 4) if run is None else run.reshape(-1, *spikes.shape[1:])
        every = [int(blocks[min(t // 4, len(blocks) - 1), row, column]) for t in range(len(spikes))]
        kept = [t for t in times if t % every[t] == 0 or not {t - 1, t + 1} <= set(times)]
        ends = [t for i, t in enumerate(kept) if i == 0 or t // length != kept[i - 1] // length]
        if times and ends[-1] != times[-1]:
            ends.append(times[-1])
        for a, b in zip(ends[:-1], ends[1:], strict=True):
            counted = sum(a < t <= b for t in times)
            found.append((row, column, a + first_frame, b + first_frame, counted / RATE / (b - a), b - a))
    return found


def rows(samples: Samples) -> list[tuple[float, ...]]:
    return list(zip(*(np.asarray(getattr(samples, name), float) for name in FIELDS), strict=True))


def constant_light(frames: int, level: np.ndarray, seed: int = 0) -> np.ndarray:
    """Eq. 1 for light that does not change: the k-th spike when the charge passes k thresholds, random first charge."""
    charge = np.random.default_rng(seed).random(level.shape)
    reached = np.floor(charge + RATE * level * np.arange(frames + 1)[:, None, None])
    return np.diff(reached, axis=0).astype(np.uint8)


@given(spikes=recordings, shortest=st.integers(1, 12), first_frame=st.integers(-5, 5))
def test_intervals_are_those_of_a_loop_over_pixels(spikes, shortest, first_frame):
    found = spike_intervals(spikes, white_rate=RATE, shortest=shortest, first_frame=first_frame, ends=0)
    np.testing.assert_allclose(rows(found), expected(spikes, np.full(spikes.shape[1:], shortest), first_frame), 1e-6)
    assert found.count == found.row.size


@given(spikes=recordings, data=st.data())
def test_runs_are_as_long_as_each_pixel_asks_for(spikes, data):
    run = data.draw(arrays(np.int32, spikes.shape[1:], elements=st.integers(1, 9)))
    found = spike_intervals(spikes, white_rate=RATE, run=run, ends=0)
    np.testing.assert_allclose(rows(found), expected(spikes, np.ones_like(run), 0, run), 1e-6)


@given(spikes=recordings, data=st.data())
def test_runs_may_differ_from_block_to_block_of_frames(spikes, data):
    blocks = data.draw(st.integers(1, 11))
    run = data.draw(arrays(np.int32, (blocks, *spikes.shape[1:]), elements=st.integers(1, RUN_FRAMES)))
    found = spike_intervals(spikes, white_rate=RATE, run=run, ends=0)
    np.testing.assert_allclose(rows(found), expected(spikes, np.ones(spikes.shape[1:], int), 0, run), 1e-6)


@given(spikes=recordings)
def test_without_runs_every_interval_is_a_sample(spikes):
    found = spike_intervals(spikes, white_rate=RATE, run=1, ends=0)
    assert found.count == np.maximum(spikes.sum(0, dtype=int) - 1, 0).sum()


@given(spikes=recordings, data=st.data())
def test_shortest_may_differ_from_pixel_to_pixel(spikes, data):
    shortest = data.draw(arrays(np.int32, spikes.shape[1:], elements=st.integers(1, 50)))
    found = spike_intervals(spikes, white_rate=RATE, shortest=shortest, ends=0)
    # Pixels whose intervals are all merged come after the others.
    np.testing.assert_allclose(sorted(rows(found)), sorted(expected(spikes, shortest, 0)), 1e-6)


@given(spikes=recordings, shortest=st.integers(1, 50))
def test_merging_keeps_all_light_and_all_time(spikes, shortest):
    """Σ weight·value of a pixel is θ·(spikes − 1), Σ weight the time from its first to its last spike."""
    found = spike_intervals(spikes, white_rate=RATE, shortest=shortest, ends=0)
    light, time = np.zeros(spikes.shape[1:]), np.zeros(spikes.shape[1:])
    np.add.at(light, (found.row, found.column), found.weight * found.value)
    np.add.at(time, (found.row, found.column), found.weight)
    fired = spikes.sum(0)
    first = spikes.argmax(0)
    last = len(spikes) - 1 - spikes[::-1].argmax(0)
    np.testing.assert_allclose(light, np.maximum(fired - 1.0, 0) / RATE, rtol=1e-5)
    np.testing.assert_array_equal(time, np.where(fired > 0, last - first, 0))


def test_every_merged_interval_but_a_pixels_first_and_last_is_about_the_length_asked_for():
    level = np.random.default_rng(1).uniform(0.3, 1.5, (10, 10))
    found = spike_intervals(constant_light(400, level), white_rate=RATE, shortest=20)
    pixel = found.row * 10 + found.column
    inner = (pixel[1:-1] == pixel[:-2]) & (pixel[1:-1] == pixel[2:])
    # Ends are the first spikes in blocks of 20 frames; at these levels the longest interval is 6 frames.
    assert found.weight[1:-1][inner].min() >= 20 - 6
    assert found.weight[1:-1][inner].max() <= 20 + 6


def test_an_interval_is_off_by_no_more_than_a_frames_light():
    level = np.random.default_rng(2).uniform(0.05, 1.5, (30, 30))
    found = spike_intervals(constant_light(200, level), white_rate=RATE, ends=0)
    true = level[found.row, found.column]
    assert np.all(np.abs(found.value - true) <= true / found.weight * (1 + 1e-5))


def test_intervals_are_unbiased_for_constant_light():
    """Each pixel's weighted mean is (c θ) / (last − first), off by a frame's light at most over the whole stretch; over
    pixels of random phase those errors cancel: 900 of them, each below level / 190, leave 1e-4."""
    level = np.full((30, 30), 0.37)
    found = spike_intervals(constant_light(200, level), white_rate=RATE)
    assert np.average(found.value, weights=found.weight) == pytest.approx(0.37, abs=3e-4)


@pytest.mark.parametrize("kind", ["intervals", "merged", "windows"])
def test_exposures_sit_where_the_light_was_gathered(kind):
    """Light that grows shows exposures that sit too early, light that fades those that sit too late.

    What both have in common (a pixel's first spike comes early in its frame, its last one late) cancels in the
    difference. With the frames a+1 … b in the place of [a, b] it would be half a frame.
    """
    frames, slope = 300, 2e-3
    phase = np.random.default_rng(3).random((1, 40, 40))

    def error(slope: float) -> float:
        light = 0.8 + slope * (np.arange(frames)[:, None, None] - frames / 2) + np.zeros_like(phase)
        spikes = np.diff(np.floor(phase + np.cumsum(RATE * light, axis=0)), axis=0, prepend=0).astype(np.uint8)
        if kind == "windows":
            found = windows(spikes, length=10, white_rate=RATE)
        else:
            found = spike_intervals(spikes, white_rate=RATE, shortest=10 if kind == "merged" else 1)
        middle = 0.8 + slope * ((found.start + found.stop) / 2 - frames / 2)
        return float(np.average(found.value - middle, weights=found.weight))

    late = (error(slope) - error(-slope)) / (2 * slope)
    assert late == pytest.approx(0, abs=0.05)


def test_values_do_not_depend_on_how_spikes_are_stored():
    spikes = constant_light(50, np.random.default_rng(4).uniform(0.1, 1.2, (5, 6)))
    first = spike_intervals(spikes, white_rate=RATE)
    for other in (spikes.astype(bool), np.asfortranarray(spikes), spikes[::-1][::-1]):
        assert rows(spike_intervals(other, white_rate=RATE)) == rows(first)
    kinds = [getattr(first, name).dtype.name for name in FIELDS]
    assert kinds == ["int32", "int32", "float32", "float32", "float32", "float32"]


def test_bad_pixels_have_no_samples():
    spikes = constant_light(50, np.full((4, 5), 0.8))
    bad = np.random.default_rng(5).random((4, 5)) < 0.4
    found = spike_intervals(spikes, white_rate=RATE, bad_pixels=bad)
    assert {(r, c) for r, c in zip(found.row, found.column, strict=True)} == set(zip(*np.nonzero(~bad), strict=True))
    counted = windows(spikes, length=10, white_rate=RATE, bad_pixels=bad)
    assert np.all((counted.weight > 0) == ~bad[counted.row, counted.column])
    assert counted.count == (~bad).sum() * 5


@pytest.mark.parametrize("fired", [0, 1])
def test_a_pixel_that_fires_less_than_twice_has_no_interval(fired):
    spikes = np.zeros((20, 2, 3), np.uint8)
    spikes[7] = fired
    for shortest in (1, 4, np.full((2, 3), 4, np.int32)):
        found = spike_intervals(spikes, shortest=shortest, ends=0)
        assert found.count == 0 and found.row.size == 0
        assert found.padded().row.size == 1024 and found.padded().count == 0


def test_windows_count_spikes():
    spikes = np.random.default_rng(6).integers(0, 2, (23, 3, 4)).astype(np.uint8)
    found = windows(spikes, length=5, white_rate=RATE, first_frame=100)
    assert found.count == 4 * 12  # the last three frames are left out
    for row, column, start, stop, value, weight in rows(found):
        # Frame t covers [t − ½, t + ½].
        begin = int(start + 0.5) - 100
        assert stop - start == weight == 5
        assert value == pytest.approx(spikes[begin : begin + 5, int(row), int(column)].sum() / 5 / RATE)
    assert sorted(set(found.start)) == [99.5, 104.5, 109.5, 114.5]


@pytest.mark.parametrize("length", [0, -1, 24])
def test_windows_that_do_not_fit(length):
    with pytest.raises(InputError, match=f"windows of {length} frames do not fit a recording of 23: .* from 1 to 23"):
        windows(np.zeros((23, 2, 2), np.uint8), length=length)


def test_padding_is_little_and_of_few_lengths():
    def lengths(n: int) -> int:
        zeros, whole = np.zeros(n, np.float32), np.zeros(n, np.int32)
        return Samples(whole, whole, zeros, zeros, zeros, zeros).padded().row.size

    # From a million on more lengths are worth their compilation.
    assert [lengths(n) for n in (1_300_000, 1_500_000, 1_700_000)] == [5 << 18, 3 << 19, 7 << 18]
    steps = np.array([1024, 1536, 2048, 3072, 4096])
    sizes = np.unique([*range(1, 5000, 13), *steps - 1, *steps, *steps + 1])
    padded = np.array([lengths(int(n)) for n in sizes])
    assert np.all(padded >= sizes) and np.all(padded >= 1024)
    assert np.all((padded - sizes <= sizes / 2) | (padded == 1024))
    assert np.unique(padded).size <= 2 * np.log2(5000 / 1024) + 2


@settings(max_examples=20)
@given(spikes=recordings)
def test_padding_keeps_the_samples_and_adds_no_weight(spikes):
    found = spike_intervals(spikes)
    padded = found.padded()
    assert rows(padded)[: found.row.size] == rows(found)
    assert padded.count == found.count
    assert all(getattr(padded, name).size == padded.row.size for name in FIELDS)
    assert not padded.weight[found.row.size :].any()


@given(recordings, st.sampled_from([0.0, 0.1, 1.0]), st.integers(0, 20))
@settings(deadline=None)
def test_mean_light_is_that_of_all_samples(spikes, ends, begin):
    begin = min(begin, len(spikes) - 1)
    part = spikes[begin:]
    samples = spike_intervals(part, white_rate=RATE, shortest=len(part), ends=ends)
    found = mean_light(SpikeTimes.of(spikes, begin), begin, len(spikes), white_rate=RATE, ends=ends)
    np.testing.assert_allclose(found, samples.mean_light(spikes.shape[1:]), rtol=1e-5, atol=1e-6)
