"""The plots of docs/benchmarks.md, small enough to lie beside it."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from PIL.Image import Image

from benchmarks.bench.scaling import PARTS
from benchmarks.bench.whole import TWICE
from benchmarks.timing import ratios

CAPTIONS = {
    "solvers": "Left: objective above its minimum, right: PSNR, against time; a row for each scale",
    "whole": "PSNR against time (the default's median, times the median ratio to it), right near the default; the line "
    "is the front, the star the default",
    "scaling": "Seconds of the parts of a reconstruction, left by frames, right by the side of the sensor",
    "roofline": "Operations per second against operations per byte; the lines are what a copy and arithmetic allow",
}
# The right panel of a front shows methods within this factor of the default's seconds and this far from its PSNR.
_NEAR_FACTOR, _NEAR_DECIBELS = 6.0, 1.6
# Height of a line of names, as a share of the panel's.
_LINE = 0.04
_COLOURS = {"default": "C3", TWICE: "black", "variant": "C1", "learned": "C2", "baseline": "C0"}


def plots(result: dict[str, Any]) -> dict[str, Figure | Image]:
    """The plots of what was measured, by name, which begins with the family."""
    drawn: dict[str, Figure | Image] = {}
    if result.get("solvers"):
        drawn["solvers"] = _solvers(result["solvers"])
    for case, rows in result.get("whole", {}).items():
        drawn[f"whole_{case.replace('×', 'x').replace(', ', '_')}"] = _front(case, rows)
    if "scaling" in result:
        drawn["scaling"] = _scaling(result["scaling"])
    if "roofline" in result:
        drawn["roofline"] = _roofline(result["roofline"])
    return drawn


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
    """PSNR against time, left of all methods, right of those near the default."""
    drawn = Figure(figsize=(13, 5), dpi=80, layout="constrained")
    kinds = {row["method"]: row["kind"] for row in rows}
    default = next(row for row in rows if row["kind"] == "default")
    # Times by ratios to the default round by round: the median over different recordings may order two otherwise.
    usual = float(np.median(default["seconds"]))
    places = {
        row["method"]: (usual * ratios(row["seconds"], default["seconds"]).middle, float(np.mean(row["psnr"])))
        for row in rows
    }
    near = {
        name: at for name, at in places.items()
        if 1 / _NEAR_FACTOR < at[0] / usual < _NEAR_FACTOR
        and abs(at[1] - places[default["method"]][1]) < _NEAR_DECIBELS
    }  # fmt: skip
    best = sorted(places[row["method"]] for row in rows if row["front"] and row["kind"] != TWICE)
    seconds, decibels = zip(*best, strict=True)
    for axes, shown, title in zip(drawn.subplots(1, 2), (places, near), (case, "near the default"), strict=True):
        for name, at in shown.items():
            star = kinds[name] == "default"
            size, order = (14, 3) if star else (6, 2)
            axes.plot(*at, "*" if star else "o", markersize=size, color=_COLOURS[kinds[name]], zorder=order)
        axes.set(xscale="log", xlabel="seconds, compiled (by ratios to the default)", ylabel="PSNR, dB", title=title)
        axes.xaxis.set_minor_formatter(NullFormatter())  # one power of ten may be all that there is
        axes.xaxis.set_major_locator(LogLocator(subs=(1,) if shown is places else (1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.margins(x=0.15, y=0.1)
        axes.autoscale_view()
        axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim())
        axes.step(seconds, np.maximum.accumulate(decibels), where="post", color="grey", linewidth=0.8, zorder=0)
        axes.grid(alpha=0.3, which="both")
        _name_at_the_side(axes, near if shown is near else {n: at for n, at in places.items() if n not in near})
    marks = [
        Line2D([], [], color=colour, linestyle="", marker="*" if kind == "default" else "o", label=kind)
        for kind, colour in _COLOURS.items()
    ]
    drawn.legend(handles=marks, loc="outside lower center", ncols=len(marks), fontsize=8, frameon=False)
    return drawn


def _name_at_the_side(axes: Axes, places: dict[str, tuple[float, float]]) -> None:
    """The names in a column right of the panel, from the lowest point up, each with a line to its point: points that
    lie on one another can be distinguished."""
    names = sorted(places, key=lambda name: (places[name][1], places[name][0]))
    bottom, top = axes.get_ylim()
    line = min(_LINE, 1 / max(len(names) - 1, 1))
    last = -line
    for number, name in enumerate(names):  # as high as its point, but above the last and below those to come
        height = (places[name][1] - bottom) / (top - bottom)
        last = max(min(height, 1 - line * (len(names) - 1 - number)), last + line)
        axes.annotate(
            name, places[name], xytext=(1.06, last), textcoords="axes fraction", fontsize=7, va="center",
            arrowprops={"arrowstyle": "-", "color": "grey", "linewidth": 0.5, "relpos": (0, 0.5), "shrinkA": 1},
        )  # fmt: skip


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
        label = f"copy, {bandwidth / 1e9:.0f} GB/s"
        axes.loglog(density, limit, color="k", linewidth=0.8, linestyle=style, label=label)
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
