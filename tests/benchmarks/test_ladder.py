"""The table of run time against error: what is asked for, on one recording, beside what was published."""

import numpy as np

from benchmarks import ladder


def test_a_line_for_each_model_and_what_was_published(quick_compilation):
    made = ladder.turning(2, 12, 20)
    assert made.spikes.shape == (ladder.FRAMES, 12, 20) and made.truth(50).shape == (24, 40)
    *ours, network, video = ladder.rows(made, ["ridge"], rounds=1)
    assert [line[0] for line in ours] == ["`ridge`"] and ours[0][2] == "1.00"
    assert float(ours[0][3]) > 20 and 0.5 < float(ours[0][4]) <= 1
    assert network[1:3] == [f"{1.088:.2f}", network[2]] and np.isclose(float(video[1]), 0.04)
