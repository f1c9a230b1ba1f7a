"""The command line that `benchmarks.bench`, `benchmarks.stress` and `benchmarks.choosing` share, and their pages.

A benchmark is a function that yields its result so far, a dictionary ready for JSON, after each of its parts. The
result is kept in a JSON file, and tables and plots made from it go into a page of `docs`, between two marks.
"""

import argparse
import json
import math
import os
import platform
import re
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
from matplotlib.figure import Figure
from PIL import Image

from scsr_opt._files import whole_file
from scsr_opt.cli.options import check_outputs, progress
from scsr_opt.errors import InputError
from scsr_opt.progress import Progress
from scsr_opt.report import versions


class Options(NamedTuple):
    """The request to a benchmark: `quick`, a small part of it; the `seed` of its recordings; `families`, the names
    of the parts to run; `progress`, the meter to report to."""

    quick: bool
    seed: int
    families: tuple[str, ...]
    progress: Progress


class Benchmark(NamedTuple):
    """**Fields:** `name`: of its module; `description`: its help; `families`: the names of its parts; `measure`: yields
    the result so far; `page`: the tables of a result as Markdown, given the beginning of the plots' file names;
    `plots`: the pictures of a result, by the rest of these names."""

    name: str
    description: str | None
    families: tuple[str, ...]
    measure: Callable[[Options], Iterator[dict[str, Any]]]
    page: Callable[[dict[str, Any], str], str]
    plots: Callable[[dict[str, Any]], dict[str, Figure | Image.Image]]


def main(benchmark: Benchmark, arguments: list[str] | None = None) -> dict[str, Any]:
    """Runs a benchmark as its command line asks (that of the process if None), and returns its result."""
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{benchmark.name}",
        description=benchmark.description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="small recordings and a part of the cases")
    parser.add_argument("--seed", type=int, default=0, help="of the recordings' noise and of what is drawn at random")
    parser.add_argument("--only", help=f"families with commas between: {', '.join(benchmark.families)}; default: all")
    parser.add_argument("--json", type=Path, help="file for all that was measured, written after each family")
    parser.add_argument("--page", type=Path, help="page whose tables and plots are to be written anew")
    parser.add_argument("--from", type=Path, dest="kept", help="a JSON file to make the page of; nothing is measured")
    chosen = parser.parse_args(arguments)
    try:
        families = _families(benchmark, chosen.only)
        if chosen.seed < 0:
            raise InputError(f"--seed is {chosen.seed}, but it must be a whole number of at least 0.")
        check_outputs([], True, json=chosen.json, page=chosen.page)
        if chosen.page is not None:
            check_page(chosen.page)
        if chosen.kept is not None:
            result = _read(chosen.kept)
        else:
            result = _measured(benchmark, Options(chosen.quick, chosen.seed, families, progress(False)), chosen)
        stem = "" if chosen.page is None else chosen.page.stem
        text = f"{origin(benchmark.name, result['about'])}\n\n{benchmark.page(result, stem)}"
        print(text)
        if chosen.page is not None:
            write_page(chosen.page, text, benchmark.plots(result))
        return result
    except InputError as error:
        parser.error(str(error))


def _families(benchmark: Benchmark, only: str | None) -> tuple[str, ...]:
    names = benchmark.families if only is None else tuple(name.strip() for name in only.split(","))
    for name in names:
        if name not in benchmark.families:
            raise InputError(f"--only has no family {name!r}: take some of {', '.join(benchmark.families)}.")
    return names


def _read(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"--from {path} cannot be read as JSON ({error}): name a file that --json wrote.") from None


def _measured(benchmark: Benchmark, options: Options, chosen: argparse.Namespace) -> dict[str, Any]:
    about = machine() | {"quick": options.quick, "seed": options.seed, "only": chosen.only}
    begin, result = time.perf_counter(), {}
    for found in benchmark.measure(options):
        result = finite({"about": about | {"seconds": time.perf_counter() - begin}, **found})
        if chosen.json is not None:
            with whole_file(chosen.json) as temporary:
                temporary.write_text(json.dumps(result, indent=1, ensure_ascii=False), encoding="utf-8")
    return result


def finite(value: Any) -> Any:
    """`value` with None in the place of numbers that are not finite, which JSON does not have."""
    if isinstance(value, dict):
        return {name: finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def machine() -> dict[str, Any]:
    """Hardware, versions and commit that figures belong to; None for what the system does not say."""
    # "-dirty" is added where files differ from the commit.
    asked = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        found = subprocess.run(asked, capture_output=True, text=True, cwd=Path(__file__).parent, check=False).stdout
    except OSError:  # no git
        found = ""
    return {
        "cores": os.cpu_count(),
        "processor": system_field("/proc/cpuinfo", "model name") or platform.machine(),
        "memory": system_bytes("/proc/meminfo", "MemTotal"),
        "system": platform.system(),
        "device": f"{jax.default_backend()}, {jax.devices()[0].device_kind}",
        "versions": versions(),
        "commit": found.strip() or None,
    }


def system_bytes(file: str, name: str) -> int | None:
    """The bytes that a file of Linux's `/proc` gives in kilobytes; None elsewhere."""
    found = system_field(file, name)
    return None if found is None else int(found.split()[0]) * 1024


def system_field(file: str, name: str) -> str | None:
    """The text after `name:` in a file of Linux's `/proc`; None elsewhere."""
    try:
        text = Path(file).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    found = re.search(rf"^{name}\s*:\s*(.+)$", text, re.MULTILINE)
    return None if found is None else found.group(1).strip()


def origin(name: str, about: dict[str, Any]) -> str:
    """A sentence that says by which command, on which machine and with which versions figures were made."""
    command = f"python -m benchmarks.{name}"
    command += " --quick" if about["quick"] else ""
    command += f" --seed {about['seed']}" if about["seed"] else ""
    command += f" --only {about['only']}" if about["only"] else ""
    return made_by(command, about)


def made_by(command: str, about: dict[str, Any]) -> str:
    """A sentence on the command that made figures, `about` being `machine()` and the `seconds` that it took."""
    memory = "memory unknown" if about["memory"] is None else f"{about['memory'] / 2**30:.0f} GiB"
    used = ", ".join(f"{package} {number}" for package, number in about["versions"].items())
    return (
        f"By `{command}` in {about['seconds']:.0f} s on {about['cores']} cores of {about['processor']}, {memory}, "
        f"{about['system']}; {used}; commit {about['commit']}."
    )


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    lines = [list(head)]
    lines += [["---"] * len(lines[0]), *(list(row) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def marks(name: str) -> tuple[str, str]:
    """The two comments of a page between which a benchmark writes its figures."""
    return f"<!-- {name}: begin -->", f"<!-- {name}: end -->"


def check_page(path: Path, name: str = "measured") -> None:
    """**Raises:** `InputError` if there is no page with both marks."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    begin, end = marks(name)
    if text.count(begin) != 1 or text.count(end) != 1:
        raise InputError(f"--page {path} is no page with the marks {begin} and {end}, between which figures stand.")


def write_page(path: Path, text: str, plots: dict[str, Figure | Image.Image], name: str = "measured") -> None:
    """Replaces what stands between the marks of a page, and the plots beside it (`benchmarks_solvers.png`, …)."""
    begin, end = marks(name)
    before, rest = path.read_text(encoding="utf-8").split(begin)
    after = rest.split(end)[1]
    with whole_file(path) as temporary:
        temporary.write_text(f"{before}{begin}\n\n{text}\n\n{end}{after}", encoding="utf-8")
    for stem, plot in plots.items():
        with whole_file(path.with_name(f"{path.stem}_{stem}.png")) as temporary:
            if isinstance(plot, Figure):
                plot.savefig(temporary)
            else:
                plot.save(temporary, optimize=True)
