"""The tables of docs/benchmarks.md."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from benchmarks.bench.plots import CAPTIONS, plots
from benchmarks.bench.scaling import PARTS
from benchmarks.bench.solvers import DEFAULT_SOLVER
from benchmarks.bench.whole import TWICE, beats, chance
from benchmarks.command import table
from benchmarks.race import GAPS
from benchmarks.timing import Spread, ratios, spread

_MEGA, _GIGA, _MILLI = 1e6, 1e9, 1e3
# The gap below which PSNR hardly changes.
_COMPARED_GAP = 1e-3
_PARTS = {
    "solvers": "Every solver",
    "priors": "Every prior",
    "data terms": "Spikes counted in windows of 8 frames",
    "precisions": "In float64",
}


def page(result: dict[str, Any], stem: str) -> str:
    """The tables of all families that were measured; `stem` begins the names of the plots."""
    parts, drawn = [], plots(result)
    for family, section in _SECTIONS.items():
        if family in result:
            parts += section(result[family])
            parts += [f"![{CAPTIONS[family]}]({stem}_{name}.png)" for name in drawn if name.split("_")[0] == family]
    return "\n\n".join(parts)


def milliseconds(values: Iterable[float]) -> str:
    """Median and quartiles, ms."""
    return _with_quartiles(Spread(*(_MILLI * v for v in spread(list(values)))))


def _with_quartiles(one: Spread) -> str:
    digits = 0 if one.middle >= 100 else 1 if one.middle >= 10 else 2
    return f"{one.middle:.{digits}f} ({one.low:.{digits}f} … {one.high:.{digits}f})"


def _solvers(rows: list[dict[str, Any]]) -> list[str]:
    parts = ["### Solvers, priors, data terms, precisions"]
    head = [
        "ms (iterations) to a gap of", *(f"{gap:.0e}" for gap in GAPS),
        f"time to {_COMPARED_GAP:.0e}, relative to the default", "ms an iteration (quartiles)", "compiling, s",
        "memory, MB", "PSNR, dB", "SSIM", "relative error of the minimum",
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
    return next((one["seconds"] for one in (row or {}).get("reached", []) if one["gap"] == _COMPARED_GAP), None)


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
        "time relative to the default",
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
        text = f"**{case}** ({'; '.join(usual['recordings'])}): the default {verdict} on the front"
        parts.append(text + (f", beaten by {over}." if over else "."))
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
        "kernel", "ms (quartiles)", "MB, by hand", "MB, by XLA", "10⁶ operations, by hand", "by XLA", "fusions", "GB/s",
        "GB/s of a copy", "share of the limit",
    ]  # fmt: skip
    (height, width), (frames, rows, columns, scale) = found["shape"], found["accumulated"]
    text = (
        f"Pictures of {height}×{width}, float32; samples of {frames} frames of {columns}×{rows} pixels at ×{scale}. A "
        f"product of matrices comes to {found['peak_operations'] / _GIGA:.0f} Gop/s."
    )
    return ["### How far from what memory allows", text, table(head, [line(row) for row in found["kernels"]])]


_SECTIONS: dict[str, Callable[[Any], list[str]]] = {
    "solvers": _solvers,
    "whole": _whole,
    "scaling": _scaling,
    "roofline": _roofline,
}
