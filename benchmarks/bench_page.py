"""The tables and plots of docs/benchmarks.md.

    python -m benchmarks.bench_page build/benchmarks.json docs/benchmarks.md

writes the page anew from figures that were kept (`scsr bench --json`), without measuring anything.
"""

import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import bench_plots
from benchmarks.bench import Report
from benchmarks.bench_cases import GAPS
from benchmarks.bench_published import OURS, PUBLISHED, SETS, mean
from benchmarks.bench_scaling import PARTS
from benchmarks.bench_solvers import DEFAULT_SOLVER
from benchmarks.bench_timing import Spread, ratios, spread
from benchmarks.bench_whole import TWICE, beats, chance
from benchmarks.choosing_page import MARKS, check_page, table
from scsr_opt.report import whole_file

_MEGA, _GIGA, _MILLI = 1e6, 1e9, 1e3
# The gap below which PSNR hardly changes.
_COMPARED = 1e-3
_PARTS = {
    "solvers": "Every solver",
    "priors": "Every prior",
    "data terms": "Spikes counted in windows of 8 frames",
    "precisions": "In float64",
}


def write(path: Path, report: Report) -> None:
    """Puts tables between the marks of a page, and plots of what was measured beside it, named after it
    (`benchmarks_solvers.png`, …)."""
    check_page(path)
    before, rest = path.read_text(encoding="utf-8").split(MARKS[0])
    with whole_file(path) as temporary:
        temporary.write_text(before + page(report, path.stem) + rest.split(MARKS[1])[1], encoding="utf-8")
    for name, drawn in bench_plots.plots(report.figures).items():
        with whole_file(path.with_name(f"{path.stem}_{name}.png")) as temporary:
            drawn().savefig(temporary)


def page(report: Report, stem: str) -> str:
    """What stands between the marks; `stem` begins the names of the plots."""
    about = report.about
    asked = "".join(
        [" --quick" if about["quick"] else "", f" --seed {about['seed']}" if about["seed"] else "",
         f" --only {','.join(about['only'])}" if about["only"] else ""]
    )  # fmt: skip
    memory = "memory unknown" if about["memory"] is None else f"{about['memory'] / 2**30:.0f} GiB"
    versions = ", ".join(f"{name} {number}" for name, number in about["versions"].items())
    said = (
        f"By `scsr bench{asked}` in {about['seconds']:.0f} s on {about['cores']} cores of {about['processor']}, "
        f"{memory}, {about['system']}; {versions}; commit {about['commit']}."
    )
    parts = [MARKS[0], said]
    drawn = bench_plots.plots(report.figures)
    for family, found in report.figures.items():
        parts += _SECTIONS[family](found)
        for name in drawn:
            if name.split("_")[0] == family:
                parts.append(f"![{bench_plots.SAID[family]}]({stem}_{name}.png)")
    return "\n\n".join([*parts, *_published(), MARKS[1]])


def milliseconds(values: Iterable[float]) -> str:
    """Median and quartiles, ms."""
    return _with_quartiles(Spread(*(_MILLI * v for v in spread(list(values)))))


def _with_quartiles(one: Spread) -> str:
    digits = 0 if one.middle >= 100 else 1 if one.middle >= 10 else 2
    return f"{one.middle:.{digits}f} ({one.low:.{digits}f} … {one.high:.{digits}f})"


def _solvers(rows: list[dict[str, Any]]) -> list[str]:
    parts = ["### Solvers, priors, data terms, precisions"]
    head = [
        "ms (iterations) to a gap of", *(f"{gap:.0e}" for gap in GAPS), f"{_COMPARED:.0e}, over the default's",
        "ms an iteration (quartiles)", "compiling, s", "memory, MB", "PSNR, dB", "SSIM", "minimum known to",
    ]  # fmt: skip
    for scale in dict.fromkeys(row["scale"] for row in rows):
        own = [row for row in rows if row["scale"] == scale]
        height, width = own[0]["shape"]
        usual = _compared(next((row for row in own if row["solver"] == DEFAULT_SOLVER), None))
        parts.append(
            f"**×{scale}, {height}×{width}**; λ = {own[0]['strength']:.2g} for {own[0]['prior']}, the default."
        )
        for part, title in _PARTS.items():
            some = [row for row in own if row["part"] == part]
            if some:
                parts += [f"{title}:", table(head, [_solver_line(row, usual) for row in some])]
    return parts


def _compared(row: dict[str, Any] | None) -> list[float] | None:
    """Seconds of each round to the gap at which solvers are compared; None where it was not reached."""
    return next((one["seconds"] for one in (row or {}).get("reached", []) if one["gap"] == _COMPARED), None)


def _solver_line(row: dict[str, Any], usual: list[float] | None) -> list[str]:
    to = {one["gap"]: one for one in row["reached"]}
    cells = [
        f"{_MILLI * np.median(to[gap]['seconds']):.1f} ({to[gap]['iterations']})" if gap in to else "–" for gap in GAPS
    ]
    last, own = row["looks"][-1], _compared(row)
    over = "–" if own is None or usual is None else _with_quartiles(ratios(own, usual))
    return [
        f"`{row['solver']}`, {row['prior']}", *cells, over, milliseconds(row["iteration_seconds"]),
        f"{row['compile_seconds']:.1f}", "–" if row["memory"] is None else f"{row['memory'] / _MEGA:.1f}",
        f"{last['psnr']:.2f}", f"{last['ssim']:.3f}", "–" if row["certain"] is None else f"{row['certain']:.0e}",
    ]  # fmt: skip


def _whole(found: dict[str, Any]) -> list[str]:
    parts = ["### Whole reconstructions"]
    head = [
        "method",
        "PSNR, dB",
        "SSIM",
        "seconds (quartiles over the recordings)",
        "time over the default's",
        "memory, MB",
        "on the front",
    ]
    for case, rows in found.items():
        usual = next(row for row in rows if row["kind"] == "default")
        verdict = "**is**" if usual["front"] else "is **not**"
        over = ", ".join(
            f"`{row['method']}` ({np.mean(row['psnr']):.2f} dB, "
            f"{ratios(row['seconds'], usual['seconds']).middle:.2f} times as long)"
            for row in rows
            if row["kind"] != TWICE and beats(row, usual, chance(rows))
        )
        said = f"**{case}** ({'; '.join(usual['recordings'])}): the default {verdict} on the front"
        parts.append(said + (f", beaten by {over}." if over else "."))
        lines = []
        for row in sorted(rows, key=lambda row: -np.mean(row["psnr"])):
            times = spread(np.ravel(row["seconds"]))
            ratio = ratios(row["seconds"], usual["seconds"])
            name = f"**`{row['method']}`**, the default" if row is usual else f"`{row['method']}`"
            on_it = "–" if row["kind"] == TWICE else "yes" if row["front"] else "no"
            lines.append(
                [name, f"{np.mean(row['psnr']):.2f}", f"{np.mean(row['ssim']):.3f}",
                 f"{times.middle:.3f} ({times.low:.3f} … {times.high:.3f})", _with_quartiles(ratio),
                 "–" if row["peak"] is None else f"{row['peak'] / _MEGA:.0f}", on_it]
            )  # fmt: skip
        parts.append(table(head, lines))
    return parts


def _scaling(found: dict[str, Any]) -> list[str]:
    head = [
        "frames", "sensor", "samples", *(f"{part}, s" for part in PARTS), "iterations", "ms an iteration (quartiles)",
        "first call, s", "memory, MB", "PSNR, dB", "SSIM",
    ]  # fmt: skip

    def line(row: dict[str, Any]) -> list[str]:
        parts = [f"{np.median([one[part] for one in row['seconds']]):.3f}" for part in PARTS]
        return [
            str(row["frames"]), f"{row['side']}×{row['side']}", f"{row['samples']}", *parts, str(row["iterations"]),
            milliseconds(row["iteration_seconds"]), f"{row['first_seconds']:.1f}",
            "–" if row["peak"] is None else f"{row['peak'] / _MEGA:.0f}", f"{row['psnr']:.2f}", f"{row['ssim']:.3f}",
        ]  # fmt: skip

    parts = ["### How it grows"]
    parts += [table(head, [line(row) for row in found[axis]]) for axis in ("frames", "sensor") if found[axis]]
    for one in found["skipped"]:
        parts.append(
            f"Left out, as about {one['needed'] / _GIGA:.1f} GB are not free: {one['frames']} frames on "
            f"{one['side']}×{one['side']} pixels."
        )
    return parts


def _roofline(found: dict[str, Any]) -> list[str]:
    def counted(value: float | None) -> str:
        return "–" if value is None else f"{value / _MEGA:.0f}"

    def line(row: dict[str, Any]) -> list[str]:
        rate = row["moved"] / float(np.median(row["seconds"])) / _GIGA
        return [
            row["kernel"], milliseconds(row["seconds"]), counted(row["moved"]), counted(row["xla_moved"]),
            counted(row["operations"]), counted(row["xla_operations"]), str(row["fusions"]), f"{rate:.1f}",
            f"{row['bandwidth'] / _GIGA:.1f}", f"{100 * row['share']:.0f} %",
        ]  # fmt: skip

    head = [
        "kernel", "ms (quartiles)", "MB at least", "MB by XLA", "Mop by hand", "Mop by XLA", "fusions", "GB/s",
        "GB/s of a copy", "share of the limit",
    ]  # fmt: skip
    (height, width), (frames, rows, columns, scale) = found["shape"], found["accumulated"]
    said = (
        f"Pictures of {height}×{width}, float32; samples of {frames} frames of {columns}×{rows} pixels at ×{scale}. A "
        f"product of matrices comes to {found['peak_operations'] / _GIGA:.0f} Gop/s."
    )
    return ["### How far from what memory allows", said, table(head, [line(row) for row in found["kernels"]])]


def _statements(found: dict[str, Any]) -> list[str]:
    other = found["accumulation"]
    rate = other["samples"] / float(np.median(other["seconds"]["accumulate"])) / _MEGA

    def fused(one: dict[str, Any]) -> str:
        moved = "" if one["moved"] is None else f", which move {one['moved'] / _MEGA:.0f} MB by XLA's count"
        return (
            f"**One iteration of `{one['solver']}` with Huber-TV at {one['shape'][0]}×{one['shape'][1]}** takes "
            f"{milliseconds(one['seconds']['fused'])} ms in one program and {milliseconds(one['seconds']['plain'])} ms "
            f"operator by operator, {_with_quartiles(Spread(**one['ratio']))} times as long (round by round; median "
            f"and quartiles). In one program it is {one['fusions']} fused kernels{moved}."
        )

    return [
        "### Two statements",
        *map(fused, found["iterations"]),
        f"**M and c of {other['frames']} frames of {other['sensor'][1]}×{other['sensor'][0]} at ×{other['scale']}** "
        f"({other['samples']} samples) are accumulated in {milliseconds(other['seconds']['accumulate'])} ms, "
        f"{rate:.0f} million samples a second; by NumPy's `bincount` in {milliseconds(other['seconds']['numpy'])} ms, "
        f"{_with_quartiles(Spread(**other['ratio']))} times as long.",
    ]


def _published() -> list[str]:
    own = [
        [one.method, one.recordings, mean(one.twice), mean(one.four_times), f"[{one.page}]({one.page})"] for one in OURS
    ]
    return [
        "### Beside what was published",
        "Published, Table 1 of the paper (PSNR in dB/SSIM), on recordings that are not public:",
        table(["method", *SETS], [[name, *figures] for name, figures in PUBLISHED.items()]),
        "Ours, on other recordings, those of the scoreboard (mean over the scenes). **The two tables cannot be "
        "compared number by number:** pictures, motion, light and noise differ, and with them what is possible.",
        table(["method", "recordings", "×2", "×4", "from"], own),
    ]


_SECTIONS: dict[str, Callable[[Any], list[str]]] = {
    "solvers": _solvers,
    "whole": _whole,
    "scaling": _scaling,
    "roofline": _roofline,
    "statements": _statements,
}


def main(kept: str, written: str) -> None:
    """`written`: the page of the figures in the file `kept`."""
    found = json.loads(Path(kept).read_text(encoding="utf-8"))
    write(Path(written), Report(found["figures"], found["about"]))


if __name__ == "__main__":
    main(*sys.argv[1:])
