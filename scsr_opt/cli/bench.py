"""`scsr bench`: speed and accuracy in figures."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from scsr_opt.cli.options import Quiet, Whole, check_outputs, progress
from scsr_opt.errors import InputError


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
    json: Annotated[Path | None, Parameter(help="File for everything that was measured.")] = None,
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
    if find_spec("benchmarks") is None or find_spec("benchmarks.bench") is None:
        raise InputError(
            "scsr bench needs the project's own folder, whose benchmarks are not installed with the program: get the "
            "sources, and say make bench there."
        )
    check_outputs([], json=json, page=page)
    from benchmarks.bench import bench as run
    from benchmarks.bench_page import check_page, write

    if page is not None:
        check_page(page)
    names = [name.strip() for name in (only or "").split(",") if name.strip()]
    if only is not None and not names:
        raise InputError("--only names no family of benchmarks; give some with commas between, such as solvers,whole.")
    report = run(seed=seed, quick=quick, only=names, progress=progress(quiet))
    if json is not None:
        report.write(json)
    if page is not None:
        write(page, report)
    if not quiet:
        print(report.summary())
    return 0
