"""The tables and pictures of docs/choosing.md."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from PIL import Image, ImageDraw, ImageFont

from benchmarks.choosing_solvers import GAPS
from scsr_opt.errors import InputError
from scsr_opt.report import detailed_part, quantise, whole_file

MARKS = ("<!-- measured: begin -->", "<!-- measured: end -->")


def check_page(path: Path) -> None:
    """**Raises:** `InputError` if there is no page with both marks."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    if any(text.count(mark) != 1 for mark in MARKS):
        raise InputError(
            f"--page {path} is no page with the marks {MARKS[0]} and {MARKS[1]}, as docs/benchmarks.md has them."
        )


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    lines = [list(head)]
    lines += [["---"] * len(lines[0]), *(list(row) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _race_table(name: str, result: dict[str, Any]) -> str:
    def line(solver: str, row: dict[str, Any]) -> list[str]:
        cells = [f"{1e3 * np.median(one['seconds']):.1f} ({one['iterations']})" for one in row["reached"]]
        cells += ["–"] * (len(GAPS) - len(cells))
        residual = next((f"{one['residual']:.1e}" for one in row["reached"] if one["gap"] == 1e-4), "–")
        return [f"`{solver}`", *cells, residual, f"{row['compile_seconds']:.1f}"]

    head = ["ms (iterations) to a gap of", *(f"{gap:.0e}" for gap in GAPS), "residual at 1e-04", "compiling, s"]
    lines = [line(solver, row) for solver, row in result["rows"].items()]
    known = f"λ = {result['strength']:.2g}; the minimum is known to within {result['certain']:.0e} of itself."
    return f"**{name}**; {known}\n\n{table(head, lines)}"


def _prior_table(rows: dict[str, Any], pictures: Sequence[str], conditions: Sequence[str]) -> str:
    usual = np.median(rows["TV"]["seconds"])

    def line(name: str, row: dict[str, Any]) -> list[str]:
        scores = row["scores"]
        cells = []
        for condition in conditions:
            some = [scores[f"{condition}, {picture}"] for picture in pictures]
            cells.append(
                ", ".join(f"{one['psnr']:.2f}" for one in some) + f" / {np.mean([o['ssim'] for o in some]):.3f}"
            )
        strengths = [one["strength"] for one in scores.values()]
        spread = f"{min(strengths):.3g} … {max(strengths):.3g}"
        return [name, *cells, spread, f"{np.median(row['seconds']) / usual:.1f}"]

    head = [f"{', '.join(pictures)}, dB / mean SSIM", *conditions, "best λ over that of `reconstruct`", "time"]
    return table(head, [line(name, row) for name, row in rows.items()])


def page(result: dict[str, Any]) -> str:
    """What stands between the marks."""
    command = "python -m benchmarks.choosing" + (" --quick" if result["quick"] else "")
    said = f"By `{command}`, {result['rounds']} rounds, on {result['machine']}."
    races = [_race_table(name, race) for name, race in result["solvers"].items()]
    shown = _prior_table(result["priors"], result["pictures"], result["conditions"])
    return "\n\n".join([MARKS[0], said, "### Solvers", *races, "### Priors", shown, MARKS[1]])


def write(target: Path, result: dict[str, Any], shown: dict[str, Float[np.ndarray, "H W"]]) -> None:
    text = target.read_text(encoding="utf-8")
    before, rest = text.split(MARKS[0])
    with whole_file(target) as temporary:
        temporary.write_text(before + page(result) + rest.split(MARKS[1])[1], encoding="utf-8")
    with whole_file(target.with_name("choosing_solvers.png")) as temporary:
        _curves(result["solvers"]).savefig(temporary)
    with whole_file(target.with_name("choosing_priors.png")) as temporary:
        _panels(shown).save(temporary, optimize=True)


def _curves(results: dict[str, Any]) -> Figure:
    """Gap against time, a panel for each problem; a solver has its colour in all of them."""
    names = list(dict.fromkeys(name for result in results.values() for name in result["rows"]))
    rows, columns = math.ceil(len(results) / 3), min(len(results), 3)
    drawn = Figure(figsize=(4.2 * columns, 3.4 * rows + 0.6), dpi=90, layout="constrained")
    panels = drawn.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for axes, (title, result) in zip(panels, results.items(), strict=False):
        for name, row in result["rows"].items():
            number = names.index(name)
            times = [1e3 * np.median(one["seconds"]) for one in row["reached"]]
            style: dict[str, Any] = {"color": f"C{number % 10}", "linestyle": "-" if number < 10 else "--"}
            axes.loglog(times, [one["above"] for one in row["reached"]], marker=".", label=name, **style)
        axes.set(title=title, xlabel="milliseconds, compiled")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
    for axes in panels[len(results) :]:
        axes.remove()
    drawn.supylabel("objective above its minimum, relative")
    lines = {name: line for axes in panels for line, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    drawn.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    return drawn


def _panels(shown: dict[str, Float[np.ndarray, "H W"]], zoom: int = 3, columns: int = 4) -> Image.Image:
    """The same part of every picture, each pixel a square of whole screen pixels, one grey scale for all."""
    top, left, tall, wide = detailed_part(shown["truth"], scale=4, share=0.4)
    label, margin = 20, 6
    down, right = tall * zoom + label + margin, wide * zoom + margin
    drawn = Image.new("L", (columns * right + margin, math.ceil(len(shown) / columns) * down + margin), 255)
    pen, font = ImageDraw.Draw(drawn), ImageFont.load_default(13)
    for number, (name, image) in enumerate(shown.items()):
        y, x = margin + number // columns * down, margin + number % columns * right
        pixels = quantise(np.kron(image[top : top + tall, left : left + wide], np.ones((zoom, zoom))))
        pen.text((x, y), name, fill=0, font=font)
        drawn.paste(Image.fromarray(pixels), (x, y + label))
    return drawn
