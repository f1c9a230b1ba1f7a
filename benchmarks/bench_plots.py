"""The plots of docs/benchmarks.md, small enough to lie beside it."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from benchmarks.bench_scaling import PARTS
from benchmarks.bench_timing import ratios
from benchmarks.bench_whole import TWICE

SAID = {
    "solvers": "Left: objective above its minimum, right: PSNR, against time; a row for each scale",
    "whole": "PSNR against time (the default's median, times the median ratio to it), right near the default; the line "
    "is the front, the star the default",
    "scaling": "Seconds of the parts of a reconstruction, left by frames, right by the side of the sensor",
    "roofline": "Operations per second against operations per byte; the lines are what a copy and arithmetic allow",
}
# What the right one of the fronts shows: so many times the seconds of the default, so many dB from its own.
_NEAR_SECONDS, _NEAR_DECIBELS = 6.0, 1.6
# Height of a line of names, as a share of the panel's.
_LINE = 0.04
_COLOURS = {"default": "C3", TWICE: "black", "variant": "C1", "learned": "C2", "baseline": "C0"}


def plots(figures: dict[str, Any]) -> dict[str, Callable[[], Figure]]:
    """What there is to draw, by name, which begins with its family; drawn when it is called."""
    found: dict[str, Callable[[], Figure]] = {}
    if figures.get("solvers"):
        found["solvers"] = partial(_solvers, figures["solvers"])
    for case, rows in figures.get("whole", {}).items():
        found[f"whole_{case.replace('×', 'x').replace(', ', '_')}"] = partial(_front, case, rows)
    if "scaling" in figures:
        found["scaling"] = partial(_scaling, figures["scaling"])
    if "roofline" in figures:
        found["roofline"] = partial(_roofline, figures["roofline"])
    return found


def _solvers(rows: list[dict[str, Any]]) -> Figure:
    """Every solver at the default prior."""
    scales = list(dict.fromkeys(row["scale"] for row in rows))
    drawn = Figure(figsize=(9, 3.4 * len(scales) + 0.6), dpi=80, layout="constrained")
    panels = drawn.subplots(len(scales), 2, squeeze=False)
    names = list(dict.fromkeys(row["solver"] for row in rows if row["part"] == "solvers"))
    for (left, right), scale in zip(panels, scales, strict=True):
        for row in rows:
            if row["scale"] != scale or row["part"] != "solvers":
                continue
            number = names.index(row["solver"])
            style: dict[str, Any] = {"color": f"C{number % 10}", "linestyle": "-" if number < 10 else "--"}
            times = [look["seconds"] for look in row["looks"]]
            # What float32 cannot tell from the minimum lies on the lower edge.
            left.loglog(times, [max(look["gap"], 1e-7) for look in row["looks"]], label=row["solver"], **style)
            right.semilogx(times, [look["psnr"] for look in row["looks"]], **style)
        left.set(title=f"×{scale}", xlabel="seconds, compiled", ylabel="objective above its minimum, relative")
        right.set(title=f"×{scale}", xlabel="seconds, compiled", ylabel="PSNR, dB")
        left.grid(alpha=0.3)
        right.grid(alpha=0.3)
    handles, labels = panels[0][0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    return drawn


def _front(case: str, rows: list[dict[str, Any]]) -> Figure:
    """Left all, right what is near the default."""
    drawn = Figure(figsize=(12, 4.6), dpi=80, layout="constrained")
    panels = drawn.subplots(1, 2, width_ratios=(1, 1.2))
    kinds = {row["method"]: row["kind"] for row in rows}
    default = next(row for row in rows if row["kind"] == "default")
    times = default["seconds"]
    # Along the axis as round by round: the median over different recordings may order two methods otherwise.
    places = {
        row["method"]: (
            float(np.median(times)) * ratios(row["seconds"], times).middle, float(np.mean(row["psnr"]))
        )
        for row in rows
    }  # fmt: skip
    usual = places[default["method"]]
    near = {
        name for name, (seconds, decibels) in places.items()
        if 1 / _NEAR_SECONDS < seconds / usual[0] < _NEAR_SECONDS and abs(decibels - usual[1]) < _NEAR_DECIBELS
    }  # fmt: skip
    seconds, decibels = zip(
        *sorted(places[row["method"]] for row in rows if row["front"] and row["kind"] != TWICE), strict=True
    )
    for axes, shown, ticks in zip(panels, (set(places), near), ((1,), (1, 2, 5)), strict=True):
        for name in sorted(shown, key=lambda name: (kinds[name] == "default", places[name][1])):
            star = kinds[name] == "default"
            axes.plot(
                *places[name], marker="*" if star else "o", markersize=14 if star else 6, color=_COLOURS[kinds[name]]
            )
        axes.set(xscale="log", xlabel="seconds, compiled (by ratios to the default)", ylabel="PSNR, dB")
        axes.xaxis.set_minor_formatter(NullFormatter())  # one power of ten may be all that there is
        axes.xaxis.set_major_locator(LogLocator(subs=ticks))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.margins(x=0.15, y=0.1)
        axes.autoscale_view()
        axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim())
        axes.step(seconds, np.maximum.accumulate(decibels), where="post", color="grey", linewidth=0.8, zorder=0)
        axes.grid(alpha=0.3, which="both")
    panels[0].set_title(case)
    marks = [
        Line2D([], [], color=colour, linestyle="", marker="*" if kind == "default" else "o", label=kind)
        for kind, colour in _COLOURS.items()
    ]
    drawn.legend(handles=marks, loc="outside lower center", ncols=len(marks), fontsize=8, frameon=False)
    panels[1].set_title("near the default")
    _name_at_the_side(panels[1], {name: places[name] for name in near})
    drawn.draw_without_rendering()  # only then it is known where what lies
    _name_beside(panels[0], {name: at for name, at in places.items() if name not in near})
    return drawn


def _name_at_the_side(axes: Axes, places: dict[str, tuple[float, float]]) -> None:
    """The names in a column right of the panel, from the lowest point up, each with a line to its point: points that
    lie on one another are told apart."""
    names = sorted(places, key=lambda name: (places[name][1], places[name][0]))
    bottom, top = axes.get_ylim()
    wanted = [(places[name][1] - bottom) / (top - bottom) for name in names]
    line = min(_LINE, 1 / max(len(names) - 1, 1))
    heights: list[float] = []
    for number, height in enumerate(wanted):  # as high as its point, but above the last and below those to come
        height = min(height, 1 - line * (len(names) - 1 - number))
        heights.append(max(height, heights[-1] + line) if heights else height)
    for name, height in zip(names, heights, strict=True):
        axes.annotate(
            name, places[name], xytext=(1.06, height), textcoords="axes fraction", fontsize=7, va="center",
            arrowprops={"arrowstyle": "-", "color": "grey", "linewidth": 0.5, "relpos": (0, 0.5), "shrinkA": 1},
        )  # fmt: skip


def _name_beside(axes: Axes, places: dict[str, tuple[float, float]]) -> None:
    """The names beside their points, each where it covers none of those before, or lowest of all."""
    points = 72 / axes.figure.dpi
    left, right = (edge * points for edge in axes.get_window_extent().intervalx)
    taken: list[tuple[float, float, float]] = []
    for name, at in sorted(places.items(), key=lambda place: place[1][1]):
        x, y = axes.transData.transform(at) * points
        wide = 4.0 * len(name)
        beside = [dx for dx in (6.0, -6 - wide) if left < x + dx and x + dx + wide < right] or [6.0]
        offsets = [(dx, dy) for dy in (-2.5, 6.0, -11.0, 14.5, -19.5) for dx in beside]

        def free(offset: tuple[float, float], x: float = x, y: float = y, wide: float = wide) -> bool:
            begin, bottom = x + offset[0], y + offset[1]
            return all(begin > e or begin + wide < b or abs(bottom - other) > 8 for b, e, other in taken)

        dx, dy = next(filter(free, offsets), offsets[-1])
        taken.append((x + dx, x + dx + wide, y + dy))
        behind = {"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 0.5}
        axes.annotate(name, at, xytext=(dx, dy), textcoords="offset points", fontsize=7, bbox=behind)


def _scaling(found: dict[str, Any]) -> Figure:
    drawn = Figure(figsize=(9, 3.6), dpi=80, layout="constrained")
    axes = drawn.subplots(1, 2, sharey=True)
    for one, axis, name in zip(axes, ("frames", "sensor"), ("frames", "side of the sensor, pixels"), strict=True):
        rows = found[axis]
        at = [row["frames"] if axis == "frames" else row["side"] for row in rows]
        for part in PARTS[1:]:
            one.loglog(at, [np.median([s[part] for s in row["seconds"]]) for row in rows], marker=".", label=part)
        iteration = [float(np.median(row["iteration_seconds"])) for row in rows]
        one.loglog(at, iteration, marker=".", color="k", linestyle=":", label="an iteration")
        one.set(xlabel=name)
        one.grid(alpha=0.3)
    axes[0].set_ylabel("seconds, compiled")
    axes[0].legend(fontsize=8)
    return drawn


def _roofline(found: dict[str, Any]) -> Figure:
    """Kernels whose operations are counted by hand; each has a copy of its own size to be compared with."""
    rows = [row for row in found["kernels"] if row["operations"]]
    drawn = Figure(figsize=(10, 4.6), dpi=80, layout="constrained")
    axes = drawn.subplots()
    density = np.logspace(-1, 2.5, 200)
    bandwidths = [bandwidth for _, bandwidth in found["copies"]]
    for bandwidth, style in ((max(bandwidths), "--"), (min(bandwidths), "-")):
        limit = np.minimum(density * bandwidth, found["peak_operations"]) / 1e9
        said = f"copy, {bandwidth / 1e9:.0f} GB/s"
        axes.loglog(density, limit, color="k", linewidth=0.8, linestyle=style, label=said)
    peak = found["peak_operations"] / 1e9
    axes.axhline(peak, color="grey", linewidth=0.8, label=f"product of matrices, {peak:.0f} Gop/s")
    for number, row in enumerate(rows):
        at = (row["operations"] / row["moved"], row["operations"] / float(np.median(row["seconds"])) / 1e9)
        marker = "osv^D"[number // 10 % 5]
        axes.plot(*at, marker, color=f"C{number % 10}", label=f"{row['kernel']}, {100 * row['share']:.0f} %")
    axes.set(xlabel="operations for each byte that has to move", ylabel="Gop/s")
    drawn.legend(fontsize=8, loc="outside right center", frameon=False)
    axes.grid(alpha=0.3)
    return drawn
