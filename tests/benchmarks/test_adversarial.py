"""`quality="best"` must not invent: recordings that no network was trained for."""

import numpy as np
import pytest

from benchmarks.adversarial import KINDS, SHAPE, Finding, case, cases, compared

# A picture may lose this much, dB, where there is nothing that photographs teach (noise-like and hidden details);
# the misfit to the measurements may rise by as much as their number lets it by chance.
MOST_LOST, MOST_MISFIT = 0.5, 1.05


@pytest.mark.parametrize("kind", KINDS)
def test_case_every_kind_has_a_recording_and_a_truth(kind):
    one = case(kind, 2, np.random.default_rng(0))
    assert one.recording.shape[1:] == SHAPE and one.kind == kind
    assert (one.truth is None) == (kind == "noise")
    if one.truth is not None:
        assert one.truth.shape == (2 * SHAPE[0], 2 * SHAPE[1])


def _agrees(found: Finding) -> bool:
    return not found.gain < -MOST_LOST and found.misfit < MOST_MISFIT


@pytest.mark.parametrize("kind", ["noise", "text", "photo"])
def test_compared_best_is_not_worse_and_agrees_with_the_data(kind):
    found = compared(case(kind, 4, np.random.default_rng(3)), 4)
    assert _agrees(found), found


@pytest.mark.slow  # four hundred solves
@pytest.mark.parametrize("scale", [2, 4])
def test_compared_two_hundred_recordings(scale):
    wrong = [found for one in cases(100, scale) if not _agrees(found := compared(one, scale))]
    assert not wrong, wrong
