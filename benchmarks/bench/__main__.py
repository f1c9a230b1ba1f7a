"""Speed and accuracy in figures: the tables and plots of docs/benchmarks.md.

    python -m benchmarks.bench [--quick] [--only solvers,whole] [--json FILE] [--page docs/benchmarks.md]

On recordings that it simulates: solvers, priors, data terms and precisions to a gap above the minimum; whole
reconstructions, learned models and baselines by time and PSNR; growth with frames and sensor; and kernels beside what
memory allows. All that is compared runs in one process, in turns.
"""

from collections.abc import Callable, Iterator
from typing import Any

from benchmarks import command
from benchmarks.bench import kernels, page, plots, scaling, solvers, whole
from benchmarks.bench.size import FULL, QUICK, Size
from scsr_opt.progress import Progress

FAMILIES: dict[str, Callable[[Size, int, Callable[[int], None]], Any]] = {
    "solvers": solvers.measure,
    "whole": whole.measure,
    "scaling": scaling.measure,
    "roofline": kernels.measure,
}


def measure(options: command.Options) -> Iterator[dict[str, Any]]:
    size = QUICK if options.quick else FULL
    yield from measured(size, options.families, options.seed, options.progress)


def measured(size: Size, families: tuple[str, ...], seed: int, progress: Progress) -> Iterator[dict[str, Any]]:
    """The figures of the families so far, after each of them."""
    found: dict[str, Any] = {}
    for name in families:
        progress.start(None, name)
        try:
            found[name] = FAMILIES[name](size, seed, progress.advance)
        finally:
            progress.finish()
        yield found


BENCHMARK = command.Benchmark("bench", __doc__, tuple(FAMILIES), measure, page.page, plots.plots)

if __name__ == "__main__":
    command.main(BENCHMARK)
