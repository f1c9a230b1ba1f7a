"""First and last spikes and their number, against the plain way."""

import numpy as np
import pytest

from scsr_opt.camera.spike_times import SpikeTimes, second_spikes


def fired(frames, rate, seed=0):
    spikes = (np.random.default_rng(seed).random((frames, 6, 7)) < rate).astype(np.uint8)
    spikes[:, 0] = 0
    spikes[frames // 2, 0, 1] = 1
    return spikes


@pytest.mark.parametrize("rate", [0.01, 0.3, 1.0])
@pytest.mark.parametrize("frames", [1, 2, 255, 256, 700])
def test_times_and_numbers_of_spikes(frames, rate):
    """Bytes count to 255: longer recordings are pieced together."""
    spikes = fired(frames, rate)
    for begin, end in ((0, frames), (frames // 3, frames - frames // 4)):
        found = SpikeTimes.of(spikes, begin, end)
        for pixel in np.ndindex(6, 7):
            times = begin + np.flatnonzero(spikes[begin:end, *pixel])
            assert found.count[pixel] == times.size
            assert found.first[pixel] == (times[0] if times.size else frames)
            assert found.last[pixel] == (times[-1] if times.size else -1)


@pytest.mark.parametrize("between", [0, 1, 17, 40])
def test_those_of_two_parts_are_those_of_both(between):
    spikes = fired(40, 0.05)
    both = SpikeTimes.of(spikes, 0, between).then(SpikeTimes.of(spikes, between))
    for one, other in zip(both, SpikeTimes.of(spikes), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("kind", [bool, np.int32, float])
def test_any_type_of_spikes_will_do(kind):
    spikes = fired(40, 0.3)
    for one, other in zip(SpikeTimes.of(spikes.astype(kind)), SpikeTimes.of(spikes), strict=True):
        np.testing.assert_array_equal(one, other)


def test_beyond_what_two_bytes_count():
    spikes = np.zeros((40_000, 1), np.uint8)
    spikes[[7, 39_999]] = 1
    assert [int(of[0]) for of in SpikeTimes.of(spikes)] == [7, 39_999, 2]


@pytest.mark.parametrize("frames", [2, 255, 256, 700])
def test_second_spikes(frames):
    spikes = fired(frames, 0.02).reshape(frames, -1)
    spikes[-2:, 5:9] = 1
    twice = spikes.sum(0) >= 2
    wanted = [np.flatnonzero(of)[1] if often else 0 for of, often in zip(spikes.T, twice, strict=True)]
    np.testing.assert_array_equal(second_spikes(spikes, twice), wanted)
    some = twice & (np.arange(twice.size) % 3 > 0)
    np.testing.assert_array_equal(second_spikes(spikes, some), np.where(some, wanted, 0))
