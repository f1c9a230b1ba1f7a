"""`scsr bench`: speed and accuracy in figures."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from scsr_opt.cli.measuring import measure
from scsr_opt.cli.options import Quiet, Whole


def bench(
    *,
    quick: Annotated[
        bool, Parameter(negative="", help="Small recordings and a part of the methods, in under three minutes.")
    ] = False,
    seed: Annotated[Whole, Parameter(help="Of the recordings' noise.")] = 0,
    only: Annotated[
        str | None,
        Parameter(
            help="Names of families with commas between: solvers, whole, scaling, roofline, statements. Default: all."
        ),
    ] = None,
    json: Annotated[
        Path | None,
        Parameter(help="File for everything that was measured. With it, a run that was stopped goes on where it was."),
    ] = None,
    page: Annotated[
        Path | None,
        Parameter(help="A page with the two marks of docs/benchmarks.md: tables go between them, plots beside it."),
    ] = None,
    quiet: Quiet = False,
) -> int:
    """Measure how fast and how accurate it is, on recordings that it simulates.

    Solvers, priors, data terms and precisions to a gap above the minimum; whole reconstructions, learned models and
    baselines by time and PSNR; growth with frames and sensor; kernels beside what memory allows; and what an iteration
    and the accumulation of M and c cost. All that is compared runs in one process, in turns. Works in the project's
    folder only, where `benchmarks` lies.
    """
    measure(
        "bench",
        "family of benchmarks; give some with commas between, such as solvers,whole",
        quick=quick,
        seed=seed,
        only=only,
        json=json,
        page=page,
        quiet=quiet,
    )
    return 0
