"""Labels of pixels that cost little and have short borders: the Potts model, by expansion moves (Boykov, Veksler and
Zabih, 2001, "Fast approximate energy minimization via graph cuts"), each the exact minimum by a maximum flow."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

# Flows are whole numbers: parts of one unit of cost.
_PARTS = 1000
# Neighbours with their weights, so that sums over them are about the length of a border in pixels.
_NEIGHBOURS = (((0, 1), 0.5), ((1, 0), 0.5), ((1, 1), 0.5**1.5), ((1, -1), 0.5**1.5))
_MOST_ROUNDS = 5


def with_short_borders(
    cost: Float[np.ndarray, "labels h w"],
    label: Int[np.ndarray, "h w"],
    free: Bool[np.ndarray, "h w"],
    border: float,
) -> Int[np.ndarray, "h w"]:
    """Labels l that make Σ cost[l(p), p] + `border` · (length of the borders between labels, pixels) small.

    With two labels the result is the minimum; with more it is what five rounds of expansions of each label find.

    **Arguments:** `cost` of each label at each pixel, in any unit; `label`, where to begin: only that of `free` pixels
    changes; `border`, cost of a border as long as the side of a pixel.

    **Returns:** the labels, (h, w).
    """
    for _ in range(_MOST_ROUNDS):
        before = label
        for one in range(len(cost)):
            label = _expanded(cost, label, free, border, one)
        if np.array_equal(label, before):
            break
    return label


def _expanded(
    cost: Float[np.ndarray, "labels h w"],
    label: Int[np.ndarray, "h w"],
    free: Bool[np.ndarray, "h w"],
    border: float,
    one: int,
) -> Int[np.ndarray, "h w"]:
    """The best labels of those in which each free pixel keeps its label or takes the label `one`."""
    known = np.asarray(binary_dilation(free, np.ones((3, 3))), bool)  # a node for each of these pixels
    nodes = int(known.sum())
    number = np.full(label.shape, -1)
    number[known] = np.arange(nodes)
    kept, taken = np.take_along_axis(cost, label[None], 0)[0], np.where(free, cost[one], np.inf)
    excess = np.where(label == one, 0.0, np.minimum(taken - kept, 1e4))[known]  # cost of `one` beyond that of keeping
    edges: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for first, second, length in _pairs():
        both = known[first] & known[second]
        a, b = number[first][both], number[second][both]
        at_a, at_b = label[first][both], label[second][both]
        # Cost of the pair where neither takes `one`, only b does, only a does; it is 0 where both do.
        neither, only_b, only_a = (border * length * of for of in (at_a != at_b, at_a != one, at_b != one))
        np.add.at(excess, a, only_a - neither)
        np.add.at(excess, b, -only_a)
        edges.append((a, b, only_a + only_b - neither))
    source, sink = nodes, nodes + 1
    every = np.arange(nodes)
    edges += [
        (np.full(nodes, source), every, np.maximum(excess, 0)),
        (every, np.full(nodes, sink), np.maximum(-excess, 0)),
    ]
    begin, end, capacity = (np.concatenate(of) for of in zip(*edges, strict=True))
    whole = np.rint(_PARTS * capacity).astype(np.int32)
    graph = csr_array((whole, (begin, end)), shape=(nodes + 2, nodes + 2))
    left = graph - maximum_flow(graph, source, sink).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    keeps = np.zeros(nodes + 2, bool)
    keeps[breadth_first_order(left, source, return_predecessors=False)] = True
    changed = label.copy()
    changed[known] = np.where(keeps[:nodes], label[known], one)
    return changed


def _pairs() -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice], float]]:
    """Pairs of neighbouring pixels: where the first ones and the second ones are, and the weight of such a pair."""
    for (down, right), weight in _NEIGHBOURS:
        rows = slice(None, -down or None), slice(down, None)
        columns = (
            slice(max(-right, 0), -right if right > 0 else None),
            slice(max(right, 0), right if right < 0 else None),
        )
        yield (rows[0], columns[0]), (rows[1], columns[1]), weight
