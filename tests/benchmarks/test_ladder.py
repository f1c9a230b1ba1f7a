"""The table of run time against error: what is asked for, on one recording, beside what was published."""

import itertools
from types import SimpleNamespace

from benchmarks import ladder


def test_a_line_for_each_model_and_what_was_published(quick_compilation, monkeypatch):
    # Half a second from each look at the clock to the next.
    clock = itertools.count(0.0, 0.5)
    monkeypatch.setattr(ladder, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    made = ladder.turning(2, 12, 20)
    assert made.spikes.shape == (ladder.FRAMES, 12, 20) and made.truth(50).shape == (24, 40)
    *ours, network, video = ladder.rows(made, ["ridge"], rounds=1)
    assert [line[:3] for line in ours] == [["`ridge`", "0.50", "1.00"]]
    assert float(ours[0][3]) > 20 and 0.5 < float(ours[0][4]) <= 1
    assert network[1:3] == ["1.09", "2.18"] and video[1:3] == ["0.04", "0.09"]
