"""`quality="best"` must not invent: recordings that no network was trained for."""

import numpy as np
import pytest

from benchmarks.adversarial import KINDS, SHAPE, Finding, case, cases, compared

MOST_MISFIT, MOST_MISFIT_OF_FAULTS = 1.05, 1.3
"""The misfit to the measurements over that of the solution before, at most: it may rise by chance, and more where
measurements are noise alone, or of rows that are dead, which the solution before had followed."""
MOST_LOST = 0.5
"""Decibels that a picture may lose, at most. What no sample shows, detail within sensor pixels, is a guess of the
prior's: of letters of square dots, gratings and plain surfaces the usual priors guess better (docs/learned.md)."""
GUESSED = ("text", "grating", "flat")


@pytest.mark.parametrize("kind", KINDS)
def test_case_every_kind_has_a_recording_and_a_truth(kind):
    one = case(kind, 2, np.random.default_rng(0))
    assert one.recording.shape[1:] == SHAPE and one.kind == kind
    assert (one.truth is None) == (kind == "noise")
    if one.truth is not None:
        assert one.truth.shape == (2 * SHAPE[0], 2 * SHAPE[1])


def _agrees(found: Finding) -> bool:
    most = MOST_MISFIT_OF_FAULTS if found.kind in ("noise", "dead rows") else MOST_MISFIT
    return found.misfit < most and (found.kind in GUESSED or not found.gain < -MOST_LOST)


@pytest.mark.parametrize("kind", ["noise", "text", "dead rows"])
def test_compared_best_is_not_worse_and_agrees_with_the_data(kind):
    found = compared(case(kind, 4, np.random.default_rng(3)), 4)
    assert _agrees(found), found


@pytest.mark.slow  # four hundred solves
@pytest.mark.parametrize("scale", [2, 4])
def test_compared_two_hundred_recordings(scale):
    wrong = [found for one in cases(100, scale) if not _agrees(found := compared(one, scale))]
    assert not wrong, wrong
