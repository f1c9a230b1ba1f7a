"""Numerical stability under stress: thousands of cases, each held against what theory promises (`scsr stress`).

`stress_cases` says what is tried, `stress_checks` what is required and where the bounds come from, `stress_run` does
one case, `stress_conditioning` calculates condition numbers, `stress_page` writes docs/stability.md.
"""

import dataclasses
import gc
import itertools
import json
import math
import multiprocessing
import os
import platform
import subprocess
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from benchmarks.journal import Journal
from benchmarks.stress_cases import FAMILIES, Case, cases
from benchmarks.stress_conditioning import Condition, conditions
from benchmarks.stress_run import examine
from benchmarks.stress_solve import Finding
from scsr_opt.errors import InputError
from scsr_opt.progress import NoProgress, Progress
from scsr_opt.report import versions, whole_file

# Linux lets a process have 65,530 mappings of memory, and a compiled program takes some tens.
_MANY_MAPPINGS = 20_000


@dataclass(frozen=True)
class Report:
    """What was found. **Fields:** `findings`, one for each case; `conditions`; `about`: machine, versions, commit,
    seed, seconds and what was asked for, ready for JSON."""

    findings: tuple[Finding, ...]
    conditions: tuple[Condition, ...]
    about: dict[str, Any]

    @property
    def failed(self) -> list[Finding]:
        return [finding for finding in self.findings if not finding.passed]

    def summary(self) -> str:
        """In lines: the failures, and how many cases there were."""
        lines = [f"failed: {finding.case.name()}: {fault(finding)}" for finding in self.failed]
        total = f"{len(self.findings)} cases, {len(self.failed)} failed, in {self.about['seconds']:.0f} s"
        return "\n".join([*lines, total])

    def write(self, path: Path) -> None:
        """All of it as JSON; numbers that are not finite as null."""
        told = {
            "about": self.about,
            "failed": len(self.failed),
            "conditions": [{**one._asdict(), "spectrum": one.spectrum.tolist()} for one in self.conditions],
            "cases": [
                {
                    **dataclasses.asdict(one.case), "outcome": one.outcome, "passed": one.passed, "checks": one.checks,
                    "numbers": {name: v if math.isfinite(v) else None for name, v in one.numbers.items()},
                    "said": one.said,
                }
                for one in self.findings
            ],
        }  # fmt: skip
        with whole_file(path) as temporary:
            temporary.write_text(json.dumps(told, indent=1, ensure_ascii=False, allow_nan=False), encoding="utf-8")


def fault(finding: Finding) -> str:
    """What a case that failed did not keep."""
    broken = ", ".join(name for name, holds in finding.checks.items() if not holds)
    return f"not so: {broken} ({finding.said or finding.outcome})"


def stress(
    *,
    seed: int = 0,
    quick: bool = False,
    only: Sequence[str] = (),
    workers: int | None = None,
    kept: Path | None = None,
    progress: Progress | None = None,
) -> Report:
    """Runs all cases, or those of the families `only`.

    **Arguments:** `seed`: of what is random. `quick`: a tenth of the cases. `workers`: processes, as many as there are
    cores (two at most) if not given; 1 stays in this one. `kept`: a file for the cases that are done, so that a run
    which was stopped goes on from there (`Journal`). `progress`: told of the cases.

    **Raises:** `InputError` for a family that does not exist, a seed below 0, or fewer than one worker.
    """
    unknown = [name for name in only if name not in FAMILIES]
    if unknown:
        raise InputError(f"There is no family of cases {unknown[0]!r}: take some of {', '.join(FAMILIES)}.")
    if seed < 0:
        raise InputError(f"seed is {seed}, but it must be a whole number of at least 0.")
    workers = min(2, os.cpu_count() or 1) if workers is None else workers
    if workers < 1:
        raise InputError(f"workers is {workers}, but it must be at least 1.")
    progress = NoProgress() if progress is None else progress
    chosen = [case for case in cases(seed, quick=quick) if not only or case.family in only]
    groups = [list(group) for _, group in itertools.groupby(chosen, lambda case: case.program)]
    asked = {**machine(), "seed": seed, "quick": quick, "only": list(only), "programs": len(groups)}
    with Journal(kept, asked) as journal:
        progress.start(len(chosen), "stress cases")
        try:
            done = len(journal.found)
            progress.advance(sum(len(group) for group in groups[:done]))
            begin = time.perf_counter()
            for number, found in enumerate(_examined(groups[done:], workers), done):
                journal.add(str(number), (found, time.perf_counter() - begin))
                begin = time.perf_counter()
                progress.advance(len(found))
        finally:
            progress.finish()
        begin = time.perf_counter()
        found_conditions = conditions(quick=quick) if not only or "conditioning" in only else []
    seconds = time.perf_counter() - begin + sum(taken for _, taken in journal.found.values())
    findings = [finding for found, _ in journal.found.values() for finding in found]
    about = {**asked, "seconds": seconds}
    return Report(tuple(findings), tuple(found_conditions), about)


def _examined(groups: list[list[Case]], workers: int) -> Iterator[list[Finding]]:
    """The findings of each group, in their order."""
    if workers == 1:
        yield from map(_group, groups)
        return
    # JAX has threads, which a fork would leave hanging.
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(_group, groups)


def _group(of: list[Case]) -> list[Finding]:
    found = [examine(case) for case in of]
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > _MANY_MAPPINGS:
        jax.clear_caches()
        gc.collect()
    return found


def machine() -> dict[str, Any]:
    """What the figures were made on, and with."""
    try:
        # "-dirty" is added where files differ from it.
        asked = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
        found = subprocess.run(asked, capture_output=True, text=True, cwd=Path(__file__).parent, check=False)
        commit = found.stdout.strip() or None
    except OSError:  # no git
        commit = None
    return {
        "machine": f"{os.cpu_count()} {platform.machine()} cores, {platform.system()}",
        "device": f"{jax.default_backend()}, {jax.devices()[0].device_kind}",
        "versions": versions(),
        "commit": commit,
    }
