"""`scsr stress`: numerical stability, case by case."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from scsr_opt.cli.measuring import measure
from scsr_opt.cli.options import Quiet, Whole


def stress(
    *,
    quick: Annotated[bool, Parameter(negative="", help="A tenth of the cases, in under three minutes.")] = False,
    seed: Annotated[Whole, Parameter(help="Of the recordings and of what is drawn at random.")] = 0,
    only: Annotated[
        str | None,
        Parameter(
            help="Names of families of cases with commas between: solvers, strengths, lights, steps, descent, sizes, "
            "frames, conditioning, lenses, long, gradients, vmap, door, defaults, random. Default: all."
        ),
    ] = None,
    json: Annotated[
        Path | None,
        Parameter(
            help="File for every case with what was found. With it, a run that was stopped goes on where it was."
        ),
    ] = None,
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
    report = measure(
        "stress",
        "family of cases; give some with commas between, such as steps,sizes",
        quick=quick,
        seed=seed,
        only=only,
        json=json,
        page=page,
        quiet=quiet,
    )
    return 1 if report.failed else 0
