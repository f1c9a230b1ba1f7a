"""Numerical stability under stress: thousands of cases, for the tables and plots of docs/stability.md.

    python -m benchmarks.stress [--quick] [--only steps,lenses] [--json FILE] [--page docs/stability.md]

Every solver and prior is tried on precisions, scales, sizes, lights, motions, bad pixels, strengths, step sizes and
first pictures from ordinary to absurd. Every case has to end in a finite picture or a named failure, twice the same;
float32 has to agree with float64 within derived bounds (`benchmarks.stress.bounds`), the objective to fall where theory
promises it, derivatives to be finite. The exit code is 1 if a case fails.
"""

import itertools
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from benchmarks import command
from benchmarks.stress import page
from benchmarks.stress.cases import FAMILIES, Case, cases
from benchmarks.stress.conditioning import conditions
from benchmarks.stress.run import rows_of
from scsr_opt.progress import Progress

_MOST_WORKERS = 2


def measure(options: command.Options) -> Iterator[dict[str, Any]]:
    chosen = cases(options.seed, quick=options.quick, families=options.families)
    workers = min(_MOST_WORKERS, os.cpu_count() or 1)
    yield measured(chosen, options.progress, quick=options.quick, workers=workers)


def measured(chosen: list[Case], progress: Progress, *, quick: bool, workers: int) -> dict[str, Any]:
    """Runs cases in `workers` processes (1: in this one). Returns `programs`, how many there are; the `cases`, their
    axes with what was found; and `conditions`, the condition numbers if cases of that family are among them."""
    groups = [list(group) for _, group in itertools.groupby(chosen, lambda case: case.program)]
    rows: list[dict[str, Any]] = []
    progress.start(len(chosen), "stress cases")
    try:
        for found in _examined(groups, workers):
            rows += found
            progress.advance(len(found))
    finally:
        progress.finish()
    asked = any(case.family == "conditioning" for case in chosen)
    numbers = [{**one._asdict(), "spectrum": one.spectrum.tolist()} for one in conditions(quick=quick)] if asked else []
    return {"programs": len(groups), "cases": rows, "conditions": numbers}


def _examined(groups: list[list[Case]], workers: int) -> Iterator[list[dict[str, Any]]]:
    """The rows of each group, in their order."""
    if workers == 1:
        yield from map(rows_of, groups)
        return
    # JAX has threads, which a fork would leave hanging. The processes cannot import functions of `__main__`.
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(rows_of, groups)


BENCHMARK = command.Benchmark("stress", __doc__, tuple(FAMILIES), measure, page.page, page.plots)

if __name__ == "__main__":
    result = command.main(BENCHMARK)
    sys.exit(0 if all(row["passed"] for row in result["cases"]) else 1)
