"""This project beside other libraries, on the two problems of `benchmarks.peers.problems`.

    python -m benchmarks.peers [--cases shifts flow] [--peers jaxopt scico …] [--folder build/peers]

Makes an environment for each peer that needs one (in `FOLDER/NAME`, once), finds the minimum of each problem (once),
then runs peer after peer, never two at a time: first this project, then the others, then this project again, so that a
machine that others use too has the chance to spoil both. Prints, for each method, the iterations and seconds to 0.1 %
above the minimum and how many times as long it takes as the default solver; all figures go to `FOLDER/results.json`.
"""

import argparse
import hashlib
import json
import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.peers.optimum import minimum
from benchmarks.peers.ours import DEFAULT
from benchmarks.peers.problems import CASES, Case, camera

PEERS: dict[str, list[str]] = {
    "jaxopt": [],
    "optimistix": [],
    "scico": ["scico==0.0.7", "jax==0.8.1", "jaxlib==0.8.1"],
    "pyproximal": ["pyproximal==0.13.0", "pylops==2.8.0"],
    "deepinv": ["deepinv==0.5.0", "torch==2.13.0", "torchvision==0.28.0"],
}
"""Packages of each peer's environment; the list is empty for a peer that runs in the project's own."""

SHARED = ["numpy==2.4.6", "scipy==1.17.1", "jaxtyping==0.3.11"]
"""Packages that the problems themselves need."""

OURS = "scsr_opt"

ROOT = Path(__file__).resolve().parents[2]


def python_of(peer: str, folder: Path) -> str:
    """The interpreter of a peer's environment, which is made if it is not there or was made of something else."""
    requirements = PEERS.get(peer, [])
    if not requirements:
        return sys.executable
    place = folder / peer
    python, stamp, wanted = place / "bin" / "python", place / "requirements.txt", "\n".join([*requirements, *SHARED])
    if not stamp.is_file() or stamp.read_text() != wanted:
        print(f"making the environment of {peer} …", file=sys.stderr, flush=True)
        subprocess.run([sys.executable, "-m", "venv", "--clear", place], check=True)
        subprocess.run([python, "-m", "pip", "--quiet", "install", *requirements, *SHARED], check=True)
        stamp.write_text(wanted)
    return str(python)


def prepared(name: str, folder: Path) -> tuple[Path, float]:
    """A problem's file and its minimum, the latter from an earlier run if the problem is still the same."""
    case, path, known = CASES[name](camera()), folder / f"{name}.npz", folder / f"{name}.json"
    case.save(path)
    digest = hashlib.sha256(b"".join(part.tobytes() for part in (case.row, case.column, case.value, case.strength)))
    settings = {"case": name, "sha256": digest.hexdigest()}
    if known.is_file():
        found = json.loads(known.read_text())
        if all(found.get(key) == value for key, value in settings.items()):
            return path, found["minimum"]
    print(f"finding the minimum of {name} …", file=sys.stderr, flush=True)
    found = minimum(Case.load(path))
    known.write_text(json.dumps(settings | found, indent=1))
    return path, found["minimum"]


def rows(peer: str, python: str, path: Path, lowest: float) -> list[dict[str, Any]]:
    """The rows that the script of a peer prints; those up to its failure, which is reported, if it fails."""
    module = "benchmarks.peers.ours" if peer == OURS else f"benchmarks.peers.peer_{peer}"
    script = subprocess.run(
        [python, "-m", module, str(path), repr(lowest)], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False
    )
    if script.returncode:
        print(f"{peer} ended with exit code {script.returncode}", file=sys.stderr)
    return [{"peer": peer, **json.loads(line)} for line in script.stdout.splitlines() if line.startswith("{")]


def merged(first: list[dict[str, Any]], second: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of two runs of the same methods, with the timings of both."""
    again = {row["name"]: row["seconds"] for row in second}
    return [row | {"seconds": row["seconds"] + again.get(row["name"], [])} for row in first]


def table(name: str, lowest: float, measured: list[dict[str, Any]]) -> str:
    """The rows of a problem as Markdown; ratios of medians, and of the fastest runs, to those of the default solver."""
    own = next(row["seconds"] for row in measured if row["peer"] == OURS and row["name"] == DEFAULT)
    lines = [
        f"Problem `{name}`, F* = {lowest:.8g}:",
        "",
        "| | method | iterations | seconds, median | fastest | times ours | fastest | PSNR |",
        "|---|---|---|---|---|---|---|---|",
    ]
    best: dict[str, float] = {}
    for row in measured:
        start = f"| {row['peer']} | {row['name']} |"
        if not row["seconds"]:
            lines.append(f"{start} never ({100 * row['above']:.2f} % above) | – | – | – | – | {row['psnr']:.2f} |")
            continue
        seconds: list[float] = row["seconds"]
        middle, least = median(seconds), min(seconds)
        ratio = middle / median(own)
        best[row["peer"]] = min(best.get(row["peer"], ratio), ratio)
        lines.append(
            f"{start} {row['iterations']} | {middle:.4f} | {least:.4f} | {ratio:.1f} | {least / min(own):.1f} | "
            f"{row['psnr']:.2f} |"
        )
    lines += ["", "Best row of each: " + ", ".join(f"{peer} {ratio:.1f}" for peer, ratio in best.items()) + "."]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--peers", nargs="+", choices=list(PEERS), default=list(PEERS))
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "peers")
    arguments = parser.parse_args()
    folder = arguments.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    # Everything that takes the machine's time for itself comes before the first clock.
    pythons = {peer: python_of(peer, folder) for peer in (OURS, *arguments.peers)}
    problems = {name: prepared(name, folder) for name in arguments.cases}
    results = {}
    for name, (path, lowest) in problems.items():
        first = rows(OURS, pythons[OURS], path, lowest)
        others = [row for peer in arguments.peers for row in rows(peer, pythons[peer], path, lowest)]
        measured = merged(first, rows(OURS, pythons[OURS], path, lowest)) + others
        results[name] = {"minimum": lowest, "rows": measured}
        (folder / "results.json").write_text(json.dumps(results, indent=1, ensure_ascii=False))
        print(table(name, lowest, measured), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
