"""The tables and plots of docs/stability.md, made of the rows that `benchmarks.stress` keeps."""

from collections import Counter
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL.Image import Image

from benchmarks.command import table
from benchmarks.stress.conditioning import STRENGTH

Row = dict[str, Any]
# Failures that are written out.
_SHOWN = 40
# Initial images from which every solver should converge in a few iterations.
_ORDINARY = ("grey", "zero", "noise")
_OUTCOMES = {
    "converged": "converged",
    "iterations_exhausted": "more iterations",
    "non_finite": "not finite",
    "no_samples": "no samples",
    "refused": "refused",
    "raised": "raised",
}


AXES = {
    "family": "family",
    "solver": "solver",
    "prior": "prior",
    "precision": "precision",
    "start": "initial image",
    "light": "light",
    "motion": "motion",
}
"""The axes that have a table of how their cases ended, with its head."""


def page(result: dict[str, Any], stem: str) -> str:
    """The tables; `stem` is not used, as the page itself shows the plots."""
    rows: list[Row] = result["cases"]
    failed = [row for row in rows if not row["passed"]]
    parts = [f"{len(rows)} cases by {result['programs']} programs. **{len(failed)} failed.**"]
    if failed:
        shown = [f"- {row['name']}: {fault(row)}" for row in failed[:_SHOWN]]
        left = len(failed) - len(shown)
        parts.append("\n".join(["### Cases that failed", "", *shown, *([f"- and {left} more"] if left else [])]))
    parts += ["### What was required", _checks(rows), "### How the cases ended"]
    parts += [_outcomes(rows, axis, head) for axis, head in AXES.items()]
    if any("agrees with float64" in row["checks"] for row in rows):
        text = (
            "ΔF/F is given for cases whose initial image is grey, zero or noise, and whose minimum is not small "
            "against the terms of its sum; the share of the bound is given for all cases."
        )
        parts += ["### Against float64", text, _agreement(rows)]
    if result["conditions"]:
        parts += ["### Condition numbers", _conditions(result["conditions"])]
    return "\n\n".join(parts)


def fault(row: Row) -> str:
    """A sentence on the requirements that a case did not meet."""
    broken = ", ".join(name for name, holds in row["checks"].items() if not holds)
    return f"not so: {broken} ({row['message'] or row['outcome']})"


def _outcomes(rows: list[Row], axis: str, head: str) -> str:
    """Outcomes of the cases, by the values of an axis."""

    def line(value: str) -> list[str]:
        some = [row for row in rows if row[axis] == value]
        ends = Counter(row["outcome"] for row in some)
        failed = sum(not row["passed"] for row in some)
        return [value, str(len(some)), *(str(ends[name]) for name in _OUTCOMES), f"**{failed}**" if failed else "0"]

    values = dict.fromkeys(row[axis] for row in rows)
    return table([head, "cases", *_OUTCOMES.values(), "failed"], [line(value) for value in values])


def _checks(rows: list[Row]) -> str:
    held = Counter((name, holds) for row in rows for name, holds in row["checks"].items())
    names = dict.fromkeys(name for name, _ in held)
    return table(["required", "held", "not"], [[n, str(held[n, True]), str(held[n, False])] for n in names])


def _share(row: Row) -> float:
    """The share of the bound; infinite where it is no finite number."""
    share = row["numbers"]["share of the bound"]
    return np.inf if share is None else share


def _agreement(rows: list[Row]) -> str:
    """Relative differences of the cases that begin with an ordinary picture, and shares of the bound of all."""
    lines = []
    for precision in ("float32", "bfloat16"):
        for solver in dict.fromkeys(row["solver"] for row in rows):
            some = [
                row for row in rows
                if row["precision"] == precision and row["solver"] == solver and "agrees with float64" in row["checks"]
            ]  # fmt: skip
            if some:
                shares = np.array([_share(row) for row in some])
                ordinary = [row["numbers"] for row in some if row["start"] in _ORDINARY]
                apart = [abs(n["relative difference"]) for n in ordinary if n.get("relative difference") is not None]
                apart = apart or [np.nan]
                lines.append(
                    [precision, solver, str(len(some)), f"{np.median(apart):.0e}", f"{np.quantile(apart, 0.9):.0e}",
                     f"{np.median(shares):.0e}", f"{shares.max():.2f}"]
                )  # fmt: skip
    head = [
        "precision",
        "solver",
        "pictures",
        "ΔF/F, median",
        "ΔF/F, 90 % quantile",
        "share of the bound, median",
        "largest",
    ]
    return table(head, lines)


def _conditions(rows: list[Row]) -> str:
    return table(
        ["scale", "motion", "bound on L over L", "eigenvalues above float32's rounding", "condition number of these",
         f"with Huber-TV, λ = {STRENGTH:g}", "of ADMM's system"],
        [
            [f"×{row['scale']}", row["motion"], f"{row['bound']:.3f}", f"{100 * row['seen']:.0f} %",
             f"{row['condition']:.1e}", f"{row['with_prior']:.1e}", f"{row['with_penalty']:.1e}"]
            for row in rows
        ],
    )  # fmt: skip


def plots(result: dict[str, Any]) -> dict[str, Figure | Image]:
    """The plots that there is something to show of."""
    drawn: dict[str, Figure | Image] = {}
    differing = [row for row in result["cases"] if row["numbers"].get("relative difference") is not None]
    if differing:
        drawn["agreement"] = _drawn_agreement(differing)
    if result["conditions"]:
        drawn["condition"] = _drawn_spectra(result["conditions"])
    return drawn


def _drawn_agreement(rows: list[Row]) -> Figure:
    """Differences from float64 over strength, and beside what they are allowed to be."""
    drawn = Figure(figsize=(9, 3.6), dpi=80, layout="constrained")
    left, right = drawn.subplots(1, 2)
    bins = np.logspace(-9, 0, 37)
    for precision, colour in (("float32", "C0"), ("bfloat16", "C1")):
        own = [row for row in rows if row["precision"] == precision]
        strength = [max(row["strength"], 1e-10) for row in own]
        apart = [max(abs(row["numbers"]["relative difference"]), 1e-12) for row in own]
        left.loglog(strength, apart, ".", color=colour, alpha=0.4, label=precision)
        shares = np.clip([_share(row) for row in own], bins[0], bins[-1])
        right.hist(shares, bins, color=colour, alpha=0.5, label=precision)
    left.set(xlabel="strength λ (0 at 1e-10)", ylabel="|F − F of float64| / F", ylim=(1e-12, 10))
    right.set(xscale="log", xlabel="share of the bound (1 = not agreeing)", ylabel="pictures")
    right.axvline(1, color="k", linewidth=1)
    for axes in (left, right):
        axes.legend(markerscale=2)
        axes.grid(alpha=0.3)
    return drawn


def _drawn_spectra(rows: list[Row]) -> Figure:
    """The eigenvalues of BᵀMB, a panel for each scale."""
    scales = sorted({row["scale"] for row in rows})
    drawn = Figure(figsize=(3.2 * len(scales) + 1, 3.4), dpi=80, layout="constrained")
    panels = drawn.subplots(1, len(scales), sharey=True, squeeze=False)[0]
    for axes, scale in zip(panels, scales, strict=True):
        for row in rows:
            if row["scale"] == scale:
                part = (np.arange(row["pixels"]) + 1) / row["pixels"]
                axes.semilogy(part, np.maximum(row["spectrum"], 1e-12), label=row["motion"])
        axes.set(title=f"×{scale}", xlabel="share of the eigenvalues", ylim=(1e-12, 2))
        axes.axhline(2.0**-24, color="k", linewidth=0.7, linestyle=":")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("eigenvalue / largest")
    panels[0].legend(frameon=False, fontsize=8)
    return drawn
