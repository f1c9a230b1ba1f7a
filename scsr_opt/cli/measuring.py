"""What `scsr bench` and `scsr stress` share: a benchmark of the project's folder, run and written."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from scsr_opt.cli.options import check_outputs, progress
from scsr_opt.errors import InputError


def measure(
    name: str,
    families: str,
    *,
    quick: bool,
    seed: int,
    only: str | None,
    json: Path | None,
    page: Path | None,
    quiet: bool,
) -> Any:
    """Runs `benchmarks.<name>`, writes its report to `json` and `page`, says its summary, and returns it.

    A run that is stopped leaves what it has done beside `json`, in a file that ends in `.partial`: the same command
    goes on from there.

    **Arguments:** `families`: what `only` names, with an example, for the sentence that refuses an empty one; the
    others as of the command.

    **Raises:** `InputError` outside the project's folder, for outputs that cannot be written, or families not known.
    """
    if find_spec("benchmarks") is None or find_spec(f"benchmarks.{name}") is None:
        raise InputError(
            f"scsr {name} needs the project's own folder, whose benchmarks are not installed with the program: get the "
            f"sources, and say make {name} there."
        )
    check_outputs([], json=json, page=page)
    from scsr_opt.device import check_device

    check_device()
    library, pages = import_module(f"benchmarks.{name}"), import_module(f"benchmarks.{name}_page")
    if page is not None:
        pages.check_page(page)
    names = [one.strip() for one in (only or "").split(",") if one.strip()]
    if only is not None and not names:
        raise InputError(f"--only names no {families}.")
    kept = None if json is None else json.with_name(f"{json.name}.partial")
    report = getattr(library, name)(seed=seed, quick=quick, only=names, kept=kept, progress=progress(quiet))
    if json is not None:
        report.write(json)
    if page is not None:
        pages.write(page, report)
    if not quiet:
        print(report.summary())
    return report
