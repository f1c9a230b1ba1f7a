"""`scsr stress`: numerical stability, case by case."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from scsr_opt.cli.options import Quiet, Whole, check_outputs, progress
from scsr_opt.errors import InputError


def stress(
    *,
    quick: Annotated[bool, Parameter(negative="", help="A tenth of the cases, in under three minutes.")] = False,
    seed: Annotated[Whole, Parameter(help="Of the recordings and of what is drawn at random.")] = 0,
    only: Annotated[
        str | None,
        Parameter(
            help="Names of families of cases with commas between: solvers, strengths, lights, steps, descent, sizes, "
            "conditioning, lenses, long, gradients, vmap, door, random. Default: all."
        ),
    ] = None,
    json: Annotated[Path | None, Parameter(help="File for every case with what was found.")] = None,
    page: Annotated[
        Path | None,
        Parameter(help="A page with the two marks of docs/stability.md: tables go between them, plots beside it."),
    ] = None,
    quiet: Quiet = False,
) -> int:
    """Try every solver and prior on what could break them.

    Precisions, scales, sizes, lights, motions, bad pixels, strengths, step sizes and first pictures from ordinary to
    absurd. Every case has to end in a finite picture or a named failure, twice the same; float32 has to agree with
    float64 within derived bounds, the objective to fall where theory says so, derivatives to be finite. The exit code
    is 1 if a case fails. Works in the project's folder only, where `benchmarks` lies.
    """
    if find_spec("benchmarks") is None or find_spec("benchmarks.stress") is None:
        raise InputError(
            "scsr stress needs the project's own folder, whose benchmarks are not installed with the program: get the "
            "sources, and say make stress there."
        )
    check_outputs([], json=json, page=page)
    from benchmarks.stress import stress as run
    from benchmarks.stress_page import check_page, write

    if page is not None:
        check_page(page)
    names = [name.strip() for name in (only or "").split(",") if name.strip()]
    if only is not None and not names:
        raise InputError("--only names no family of cases; give some with commas between, such as steps,sizes.")
    report = run(seed=seed, quick=quick, only=names, progress=progress(quiet))
    if json is not None:
        report.write(json)
    if page is not None:
        write(page, report)
    if not quiet:
        print(report.summary())
    return 1 if report.failed else 0
