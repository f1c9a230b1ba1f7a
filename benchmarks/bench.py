"""Speed and accuracy in figures: what solvers, reconstructions and kernels reach, and in what time (`scsr bench`).

`bench_cases` says on what, `bench_timing` how it is measured. Each family has a module: `bench_solvers`,
`bench_whole`, `bench_scaling`, `bench_roofline`, `bench_iteration`; `bench_published` holds what others published.
`bench_page` and `bench_plots` write docs/benchmarks.md, `bench_counts` counts what noise cannot change, for the tests.
"""

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks import bench_iteration, bench_roofline, bench_scaling, bench_solvers, bench_whole
from benchmarks.bench_cases import FULL, QUICK, Size
from benchmarks.bench_timing import hardware
from benchmarks.journal import Journal
from benchmarks.stress import machine
from scsr_opt.errors import InputError
from scsr_opt.progress import NoProgress, Progress
from scsr_opt.report import whole_file

FAMILIES: dict[str, Callable[[Size, int, Progress], Any]] = {
    "solvers": bench_solvers.measure,
    "whole": bench_whole.measure,
    "scaling": bench_scaling.measure,
    "roofline": bench_roofline.measure,
    "statements": bench_iteration.measure,
}


@dataclass(frozen=True)
class Report:
    """What was measured. **Fields:** `figures` by family; `about`: machine, versions, commit, seed, seconds and what
    was asked for. Both ready for JSON."""

    figures: dict[str, Any]
    about: dict[str, Any]

    def summary(self) -> str:
        """In lines: the main figure of each family."""
        lines = [line for family in self.figures for line in _SAID[family](self.figures[family])]
        return "\n".join([*lines, f"{', '.join(self.figures)} in {self.about['seconds']:.0f} s"])

    def write(self, path: Path) -> None:
        """All of it as JSON; numbers that are not finite as null."""
        told = json.dumps(_finite({"about": self.about, "figures": self.figures}), indent=1, ensure_ascii=False)
        with whole_file(path) as temporary:
            temporary.write_text(told, encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def bench(
    *,
    seed: int = 0,
    quick: bool = False,
    only: Sequence[str] = (),
    size: Size | None = None,
    kept: Path | None = None,
    progress: Progress | None = None,
) -> Report:
    """Measures all families, or those of `only`.

    **Arguments:** `seed`: of the recordings' noise. `quick`: small recordings and a part of the methods. `size`: stands
    in for what `quick` chooses. `kept`: a file for the families that are done, so that a run which was stopped goes on
    from there (`Journal`). `progress`: told of the cases.

    **Raises:** `InputError` for a family that does not exist, or a seed below 0.
    """
    unknown = [name for name in only if name not in FAMILIES]
    if unknown:
        raise InputError(f"There is no family of benchmarks {unknown[0]!r}: take some of {', '.join(FAMILIES)}.")
    if seed < 0:
        raise InputError(f"seed is {seed}, but it must be a whole number of at least 0.")
    size = (QUICK if quick else FULL) if size is None else size
    progress = NoProgress() if progress is None else progress
    asked = {**machine(), **hardware(), "seed": seed, "quick": quick, "only": list(only), "size": size._asdict()}
    with Journal(kept, asked) as journal:
        for name, measure in FAMILIES.items():
            if name in journal.found or (only and name not in only):
                continue
            begin = time.perf_counter()
            figures = measure(size, seed, progress)
            journal.add(name, (figures, time.perf_counter() - begin))
            if name == "solvers":  # two precisions of much that nobody needs any more
                jax.clear_caches()
    seconds = {name: taken for name, (_, taken) in journal.found.items()}
    about = {**asked, "seconds_of": seconds, "seconds": sum(seconds.values())}
    return Report({name: figures for name, (figures, _) in journal.found.items()}, about)


def _said_of_solvers(rows: list[dict[str, Any]]) -> list[str]:
    said = []
    for scale in dict.fromkeys(row["scale"] for row in rows):
        times = {
            row["solver"]: float(np.median(one["seconds"]))
            for row in rows
            for one in row["reached"]
            if row["scale"] == scale and row["part"] == "solvers" and one["gap"] == 1e-3
        }
        if times:
            best = min(times, key=lambda name: times[name])
            usual = f"; {times['FISTA'] * 1e3:.1f} ms by FISTA" if "FISTA" in times else ""
            said.append(f"×{scale}: a gap of 1e-3 in {times[best] * 1e3:.1f} ms by {best}{usual}")
    return said


def _said_of_whole(found: dict[str, Any]) -> list[str]:
    said = []
    for case, rows in found.items():
        usual = next(row for row in rows if row["kind"] == "default")
        where = "on the front of time and accuracy" if usual["front"] else "not on the front of time and accuracy"
        seconds = float(np.median(usual["seconds"]))
        said.append(f"{case}: reconstruct {np.mean(usual['psnr']):.2f} dB in {seconds:.2f} s, {where}")
    return said


def _said_of_scaling(found: dict[str, Any]) -> list[str]:
    return [f"scaling: {len(found['frames'])} numbers of frames, {len(found['sensor'])} sensors"]


def _said_of_roofline(found: dict[str, Any]) -> list[str]:
    return [f"{row['kernel']}: {100 * row['share']:.0f} % of the limit" for row in found["kernels"]]


def _said_of_statements(found: dict[str, Any]) -> list[str]:
    other = found["accumulation"]
    return [
        *(
            f"one iteration of {one['solver']} at {one['shape'][0]}×{one['shape'][1]}: "
            f"{1e3 * np.median(one['seconds']['fused']):.1f} ms, {one['ratio']['middle']:.2f} times as fast as unfused"
            for one in found["iterations"]
        ),
        f"M and c of {other['frames']} frames: {1e3 * np.median(other['seconds']['accumulate']):.0f} ms",
    ]


_SAID: dict[str, Callable[[Any], list[str]]] = {
    "solvers": _said_of_solvers,
    "whole": _said_of_whole,
    "scaling": _said_of_scaling,
    "roofline": _said_of_roofline,
    "statements": _said_of_statements,
}
