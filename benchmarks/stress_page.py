"""The tables and plots of docs/stability.md."""

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.choosing_page import MARKS, check_page, table
from benchmarks.stress import Report, fault
from benchmarks.stress_conditioning import STRENGTH, Condition
from benchmarks.stress_solve import Finding
from scsr_opt.report import whole_file

# Failures that are written out.
_SHOWN = 40
# First pictures from which every solver should come down in a few iterations.
_ORDINARY = ("grey", "zero", "noise")
_OUTCOMES = {
    "converged": "converged",
    "iterations_exhausted": "more iterations",
    "non_finite": "not finite",
    "no_samples": "no samples",
    "refused": "refused",
    "raised": "raised",
}


def _counts(findings: list[Finding], key: Callable[[Finding], str], head: str) -> str:
    """How the cases of each kind ended."""
    kinds = dict.fromkeys(key(one) for one in findings)

    def line(kind: str) -> list[str]:
        some = [one for one in findings if key(one) == kind]
        ends = Counter(one.outcome for one in some)
        failed = sum(not one.passed for one in some)
        return [kind, str(len(some)), *(str(ends[name]) for name in _OUTCOMES), f"**{failed}**" if failed else "0"]

    return table([head, "cases", *_OUTCOMES.values(), "failed"], [line(kind) for kind in kinds])


def _checks(findings: Iterable[Finding]) -> str:
    held = Counter((name, holds) for one in findings for name, holds in one.checks.items())
    names = dict.fromkeys(name for name, _ in held)
    return table(["required", "held", "not"], [[n, str(held[n, True]), str(held[n, False])] for n in names])


def _agreement(findings: list[Finding]) -> str:
    """Relative differences of the cases that begin with an ordinary picture, and shares of the bound of all."""
    rows = []
    for precision in ("float32", "bfloat16"):
        for solver in dict.fromkeys(one.case.solver for one in findings):
            some = [
                (one.case.start, one.numbers) for one in findings
                if one.case.precision == precision and one.case.solver == solver and "agrees with float64" in one.checks
            ]  # fmt: skip
            if some:
                shares = np.array([numbers["share of the bound"] for _, numbers in some])
                apart = np.array(
                    [abs(n["relative difference"]) for start, n in some
                     if start in _ORDINARY and "relative difference" in n] or [np.nan]
                )  # fmt: skip
                rows.append(
                    [precision, solver, str(len(some)), f"{np.median(apart):.0e}", f"{np.quantile(apart, 0.9):.0e}",
                     f"{np.median(shares):.0e}", f"{shares.max():.2f}"]
                )  # fmt: skip
    head = ["precision", "solver", "pictures", "ΔF/F, median", "9 in 10 below", "share of its bound, median", "largest"]
    return table(head, rows)


def _condition(rows: Iterable[Condition]) -> str:
    return table(
        ["scale", "motion", "bound on L over L", "eigenvalues above float32's rounding", "condition of these",
         f"with Huber-TV, λ = {STRENGTH:g}", "of ADMM's system"],
        [
            [f"×{one.scale}", one.motion, f"{one.bound:.3f}", f"{100 * one.seen:.0f} %", f"{one.condition:.1e}",
             f"{one.with_prior:.1e}", f"{one.with_penalty:.1e}"]
            for one in rows
        ],
    )  # fmt: skip


def page(report: Report) -> str:
    """What stands between the marks."""
    about, findings = report.about, list(report.findings)
    asked = "".join(
        [" --quick" if about["quick"] else "", f" --seed {about['seed']}" if about["seed"] else "",
         f" --only {','.join(about['only'])}" if about["only"] else ""]
    )  # fmt: skip
    versions = ", ".join(f"{name} {number}" for name, number in about["versions"].items())
    said = (
        f"By `scsr stress{asked}`: {len(findings)} cases by {about['programs']} programs in {about['seconds']:.0f} s "
        f"on {about['machine']}; {versions}; commit {about['commit']}. "
        f"**{len(report.failed)} failed.**"
    )
    parts = [MARKS[0], said]
    if report.failed:
        shown = [f"- {one.case.name()}: {fault(one)}" for one in report.failed[:_SHOWN]]
        left = len(report.failed) - len(shown)
        parts.append("\n".join(["### Cases that failed", "", *shown, *([f"- and {left} more"] if left else [])]))
    parts += ["### What was required", _checks(findings), "### How the cases ended"]
    parts.append(_counts(findings, lambda one: one.case.family, "family"))
    for head, key in (
        ("solver", lambda one: one.case.solver), ("prior", lambda one: one.case.prior),
        ("precision", lambda one: one.case.precision), ("first picture", lambda one: one.case.start),
        ("light", lambda one: one.case.light), ("motion", lambda one: one.case.motion),
    ):  # fmt: skip
        parts.append(_counts(findings, key, head))
    if any("agrees with float64" in one.checks for one in findings):
        said = (
            "ΔF/F is that of cases whose first picture is grey, zero or noise, and whose minimum is not next to 0 "
            "beside what it is added up from; the bound's share is that of all."
        )
        parts += ["### Against float64", said, _agreement(findings)]
    if report.conditions:
        parts += ["### Condition numbers", _condition(report.conditions)]
    return "\n\n".join([*parts, MARKS[1]])


def write(path: Path, report: Report) -> None:
    """Puts tables between the marks of a page, and plots beside it (`stability_agreement.png`,
    `stability_condition.png`), as far as there is something to show."""
    check_page(path)
    text = path.read_text(encoding="utf-8")
    before, rest = text.split(MARKS[0])
    with whole_file(path) as temporary:
        temporary.write_text(before + page(report) + rest.split(MARKS[1])[1], encoding="utf-8")
    plots = {"agreement": _drawn_agreement(list(report.findings)), "condition": _drawn_spectra(report.conditions)}
    for name, drawn in plots.items():
        if drawn is not None:
            with whole_file(path.with_name(f"{path.stem}_{name}.png")) as temporary:
                drawn.savefig(temporary)


def _drawn_agreement(findings: list[Finding]) -> Figure | None:
    """Differences from float64 over strength, and beside what they are allowed to be."""
    some = [one for one in findings if "relative difference" in one.numbers]
    if not some:
        return None
    drawn = Figure(figsize=(9, 3.6), dpi=80, layout="constrained")
    left, right = drawn.subplots(1, 2)
    bins = np.logspace(-9, 0, 37)
    for precision, colour in (("float32", "C0"), ("bfloat16", "C1")):
        own = [one for one in some if one.case.precision == precision]
        strength = [max(one.case.strength, 1e-10) for one in own]
        apart = [max(abs(one.numbers["relative difference"]), 1e-12) for one in own]
        left.loglog(strength, apart, ".", color=colour, alpha=0.4, label=precision)
        shares = np.clip([one.numbers["share of the bound"] for one in own], bins[0], None)
        right.hist(shares, bins, color=colour, alpha=0.5, label=precision)
    left.set(xlabel="strength λ (0 at 1e-10)", ylabel="|F − F of float64| / F")
    left.set_ylim(1e-12, 10)
    right.set(xscale="log", xlabel="share of the bound (1 = not agreeing)", ylabel="pictures")
    right.axvline(1, color="k", linewidth=1)
    for axes in (left, right):
        axes.legend(markerscale=2)
        axes.grid(alpha=0.3)
    return drawn


def _drawn_spectra(rows: Iterable[Condition]) -> Figure | None:
    """The eigenvalues of BᵀMB, a panel for each scale."""
    rows = list(rows)
    scales = sorted({one.scale for one in rows})
    if not scales:
        return None
    drawn = Figure(figsize=(3.2 * len(scales) + 1, 3.4), dpi=80, layout="constrained")
    panels = drawn.subplots(1, len(scales), sharey=True, squeeze=False)[0]
    for axes, scale in zip(panels, scales, strict=True):
        for one in rows:
            if one.scale == scale:
                part = (np.arange(one.pixels) + 1) / one.pixels
                axes.semilogy(part, np.maximum(one.spectrum, 1e-12), label=one.motion)
        axes.set(title=f"×{scale}", xlabel="share of the eigenvalues", ylim=(1e-12, 2))
        axes.axhline(2.0**-24, color="k", linewidth=0.7, linestyle=":")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("eigenvalue / largest")
    panels[0].legend(frameon=False, fontsize=8)
    return drawn
