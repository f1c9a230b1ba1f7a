"""The simulation of many workers, where its result is known; figures of real workers are those of the page."""

import numpy as np
import pytest

from benchmarks.planning import Costs, Course, bytes_of_frames, seconds_of_a_task, simulated, tiled
from scsr_opt import Recording

COSTS = Costs(start=5.0, first=2.0, following=1.0, handing_out=0.01, read=1e6, written=2e5)
"""A group takes 11 s, reads 1 MB and writes 2 MB."""


def run(groups: int, workers: int, storage: float = np.inf, costs: Costs = COSTS) -> Course:
    return simulated(costs, groups, workers, storage)


def test_one_worker_does_one_thing_after_the_other():
    found = run(7, 1, storage=1e6)
    assert found.seconds == pytest.approx(5 + 7 * (0.01 + 1 + 11 + 2))
    assert found.workers == pytest.approx(7 * 11 / found.seconds) and found.limit == "solving"


def test_workers_share_groups_evenly():
    assert run(8, 4).seconds == pytest.approx(5 + 2 * 11, abs=0.1)
    assert run(9, 4).seconds == pytest.approx(5 + 3 * 11, abs=0.1)


def test_more_workers_than_groups_do_not_help():
    assert run(3, 1000).seconds == pytest.approx(run(3, 3).seconds)


def test_storage_limits_many_workers():
    """3 MB a group through 1 MB/s: never more than a group in 3 s."""
    found = run(300, 100, storage=1e6)
    assert 300 * 3 <= found.seconds <= 300 * 3 + 5 + 11 + 3
    assert found.limit == "storage" and found.storage > 0.95


def test_scheduler_limits_very_many_workers():
    slow = Costs(start=0.0, first=0.01, following=0.01, handing_out=0.5, read=0.0, written=0.0)
    found = run(100, 50, costs=slow)
    assert found.seconds == pytest.approx(50.1, abs=0.1) and found.limit == "scheduler"


def test_tiled_recording_repeats_its_pixels():
    spikes = np.random.default_rng(0).integers(0, 2, (5, 6, 7), np.uint8)
    found = tiled(Recording.from_array(spikes, white_rate=0.3), 16)
    assert found.shape == (5, 16, 16) and found.white_rate == 0.3
    np.testing.assert_array_equal(found.spikes[:, 6:12, 7:14], spikes)
    np.testing.assert_array_equal(found.spikes[:, 12:, 14:], spikes[:, :4, :2])


def test_bytes_of_a_group():
    assert bytes_of_frames(range(0, 10_000, 400), (10, 10)) == (9 * 400 + 801) * 13


@pytest.mark.slow  # starts a worker
def test_seconds_of_a_task():
    assert 0 < seconds_of_a_task(20) < 1
