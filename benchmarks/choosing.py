"""Which solver, and which prior? The figures of docs/choosing.md.

    python -m benchmarks.choosing [--quick] [--write docs/choosing.md] [--json FILE]

Stills that come with scikit-image pan at a known speed before a simulated camera. **Solvers**: one data term of each
recording is given to all of them from the same start. How far F is above its minimum is calculated in float64 for the
pictures of the runs, which are in float32, and the minimum by a run in float64 whose duality gap says how near it is;
then runs of just as many iterations as a gap needs are timed, all solvers in turns, and the median of the rounds is
taken. Compilation is measured apart. **Priors**: each at the strength that is best for it (found by halving and
doubling), PSNR and SSIM, and what an iteration costs. With `--write` tables go between the marks of the page, and two
pictures beside it. `--quick` takes small pictures, to see that all works.
"""

import argparse
import json
import os
import platform
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from benchmarks.choosing_cases import FULL, QUICK, Case, Size, case_of
from benchmarks.choosing_page import page, write
from benchmarks.choosing_priors import compare
from benchmarks.choosing_solvers import race, races


def measure(size: Size, rounds: int) -> tuple[dict[str, Any], dict[str, Float[np.ndarray, "H W"]]]:
    """All figures, ready for JSON, and the pictures."""
    cases: dict[int, Case] = {}
    results: dict[str, Any] = {}
    for one in races(size):
        if one.scale not in cases:
            cases[one.scale] = case_of(size.pictures[0], scale=one.scale, sensor=size.sensor, light="day")
        case = cases[one.scale]
        shape = "×".join(str(n) for n in case.start.shape)
        results[f"{one.name}, ×{one.scale}, {shape}"] = race(case, one, size.seconds, rounds)
    rows, shown = compare(size, rounds)
    result = {
        "machine": f"{os.cpu_count()} {platform.machine()} cores, jax {jax.__version__}",
        "quick": size == QUICK,
        "rounds": rounds,
        "pictures": list(size.pictures),
        "conditions": [f"×{scale}, {light}" for scale, light in size.conditions],
    }
    return {**result, "solvers": results, "priors": rows}, shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small pictures")
    parser.add_argument("--rounds", type=int, default=3, help="of timing")
    parser.add_argument("--write", type=Path, help="the page to put the tables into")
    parser.add_argument("--json", type=Path, help="where all figures go")
    arguments = parser.parse_args()
    result, shown = measure(QUICK if arguments.quick else FULL, arguments.rounds)
    print(page(result))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=1, ensure_ascii=False), encoding="utf-8")
    if arguments.write is not None:
        write(arguments.write, result, shown)


if __name__ == "__main__":
    main()
