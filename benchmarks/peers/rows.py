"""Rows of the table: a method run to 0.1 % of the minimum and then timed, the same way for all.

The number of iterations is looked for first, without timing: runs of 1, 2, 4, … iterations from the start until
one is near enough, then halving between the last two. Then that very run, with nothing watching it, is timed several
times over. What a library compiles or sets up is done before, as far as the library keeps it.

A row's script is run in the environment of its peer, as `python -m benchmarks.peers.NAME CASE.npz MINIMUM`, and prints
a line of JSON for each method.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks.peers.problems import Case

NEAR = 1e-3
"""How far above the minimum a run may end, relative to it."""

_ROUNDS, _LONGEST = 5, 20.0


class Method(NamedTuple):
    """One way of a library to solve a problem.

    **Fields:**
    - `name`: algorithm and settings.
    - `prepare`: makes a run of some iterations from the start, which returns the picture, on the host. Only the run is
      timed.
    - `most`: after how many iterations to give up.
    """

    name: str
    prepare: Callable[[int], Callable[[], Float[np.ndarray, "..."]]]
    most: int = 400


def report(methods: Callable[[Case], Iterable[Method]]) -> None:
    """Measures the methods for the problem that the command line names and prints their rows."""
    parser = argparse.ArgumentParser()
    parser.add_argument("case", type=Path)
    parser.add_argument("minimum", type=float)
    arguments = parser.parse_args()
    case = Case.load(arguments.case)
    for method in methods(case):
        print(json.dumps(measure(case, arguments.minimum, method)), flush=True)


def measure(case: Case, minimum: float, method: Method) -> dict[str, str | int | float | list[float] | None]:
    """One row: `name`, `iterations` to `NEAR` and all timings in `seconds` (none if it never came there), `above`: how
    far above the minimum the run ended, relative to it, and its `psnr`."""
    iterations = _enough(case, minimum * (1 + NEAR), method)
    shown = iterations or method.most
    image, seconds = method.prepare(shown)(), []
    for _ in range(_ROUNDS if iterations else 0):
        run = method.prepare(shown)
        begin = time.perf_counter()
        image = run()
        seconds.append(time.perf_counter() - begin)
    return {
        "name": method.name,
        "iterations": iterations,
        "seconds": seconds,
        "above": case.objective(image) / minimum - 1,
        "psnr": case.psnr(image),
    }


def _enough(case: Case, target: float, method: Method) -> int | None:
    """The fewest iterations that reach the target, or none if the most do not or it takes too long."""
    begin, low, high = time.perf_counter(), 0, 1
    while case.objective(method.prepare(high)()) > target:
        if high == method.most or time.perf_counter() - begin > _LONGEST:
            return None
        low, high = high, min(2 * high, method.most)
    while high - low > 1:
        middle = (low + high) // 2
        if case.objective(method.prepare(middle)()) <= target:
            high = middle
        else:
            low = middle
    return high
