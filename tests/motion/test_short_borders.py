"""`with_short_borders`: labels of the Potts model."""

import itertools

import numpy as np
import pytest

from scsr_opt.motion.short_borders import with_short_borders


def energy(cost, label, border):
    """Sum of the costs and of the borders, written out."""
    total = sum(cost[label[p]][p] for p in np.ndindex(label.shape))
    for row, column in np.ndindex(label.shape):
        for down, right, length in ((0, 1, 0.5), (1, 0, 0.5), (1, 1, 0.5**1.5), (1, -1, 0.5**1.5)):
            other = row + down, column + right
            if 0 <= other[0] < label.shape[0] and 0 <= other[1] < label.shape[1]:
                total += border * length * (label[row, column] != label[other])
    return total


@pytest.mark.parametrize("border", [0.0, 0.3, 1.0, 5.0])
def test_with_short_borders_two_labels_is_the_minimum(border):
    """Beside all 512 labellings of nine free pixels within fixed ones."""
    rng = np.random.default_rng(0)
    for _ in range(4):
        cost, label = rng.uniform(0, 2, (2, 5, 5)), rng.integers(0, 2, (5, 5))
        free = np.zeros((5, 5), bool)
        free[1:4, 1:4] = True
        found = with_short_borders(cost, label, free, border)
        np.testing.assert_array_equal(found[~free], label[~free])
        least = np.inf
        for some in itertools.product((0, 1), repeat=9):
            tried = label.copy()
            tried[free] = some
            least = min(least, energy(cost, tried, border))
        assert energy(cost, found, border) == pytest.approx(least, abs=0.02)  # capacities are in thousandths


def test_with_short_borders_three_labels_lowers_the_energy():
    rng = np.random.default_rng(1)
    cost, label = rng.uniform(0, 2, (3, 12, 9)), rng.integers(0, 3, (12, 9))
    found = with_short_borders(cost, label, np.ones((12, 9), bool), 0.6)
    plain = cost.argmin(0)
    assert energy(cost, found, 0.6) < min(energy(cost, plain, 0.6), energy(cost, label, 0.6))


def test_with_short_borders_weak_evidence_keeps_the_border_straight():
    """A bump of weakly wrong pixels goes, a part of certain ones stays, but for its corners."""
    right = np.indices((20, 20))[1] >= 10
    expected = right.copy()
    expected[14:, 3:10] = True
    cost = np.stack([10.0 * expected, 10.0 * ~expected])
    cost[:, 4:10, 10:12] = [[[0.0]], [[0.5]]]
    assert (cost.argmin(0) != expected).sum() == 12
    found = with_short_borders(cost, right.astype(int), np.ones((20, 20), bool), 24.0)
    assert (found != expected).sum() <= 2
