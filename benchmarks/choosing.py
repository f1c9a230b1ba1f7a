"""Solvers and priors compared: the tables and pictures of docs/choosing.md.

    python -m benchmarks.choosing [--quick] [--json FILE] [--page docs/choosing.md]

Stills that come with scikit-image pan at a known speed before a simulated camera. *Solvers*: all are given the same
problem and first picture, and the runs to each gap above its minimum are timed in turns (`benchmarks.race`). *Priors*:
each at the strength that is best for it (found by halving and doubling), PSNR and SSIM, and what an iteration costs.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from PIL import Image, ImageDraw, ImageFont

from benchmarks import command
from benchmarks.race import GAPS, Entry, minimum, race, with_dual_steps
from benchmarks.recordings import Posed, posed, quality, recorded
from benchmarks.timing import in_turns
from scsr_opt import priors, solvers
from scsr_opt.camera.sampling_rules import Intervals
from scsr_opt.priors import Prior
from scsr_opt.report import detailed_part, quantise
from scsr_opt.solvers import Problem, Solver, run

ROUNDS = 3
_TIMED_ITERATIONS = 20


class Size(NamedTuple):
    """Amount of work: `sensor` of the solvers, and `side` of the priors' pictures, pixels; the `stills` of the priors
    (the first is the solvers'); `conditions` (scale, light); `exact` iterations for the minimum; and in how many
    `seconds` a solver has to reach a gap."""

    sensor: int
    side: int
    stills: tuple[str, ...]
    conditions: tuple[tuple[int, str], ...]
    exact: int
    seconds: float


FULL = Size(100, 144, ("camera", "brick", "moon"), ((2, "day"), (2, "dim"), (4, "day")), 600, 1.5)
QUICK = Size(40, 72, ("camera",), ((2, "day"),), 200, 0.5)


@cache
def compared_priors() -> dict[str, tuple[Prior, float, Solver]]:
    """The priors that are compared, each with a strength to begin with, relative to that of total variation, and the
    solver; priors that denoise on the host are stopped by number."""
    tv, few = priors.TotalVariation(), solvers.FISTA(iterations=15)
    fista = solvers.FISTA(iterations=60, tolerance=3e-4)
    alike = priors.nl_means()
    return {
        "TV": (tv, 1, fista),
        "TV, anisotropic": (priors.TotalVariation(isotropic=False), 1, fista),
        "TV, bounded 0 … 1": (priors.Bounded(tv, 0, 1), 1, fista),
        "Huber-TV": (priors.HuberTotalVariation(), 1, fista),
        "ridge": (priors.RidgeRegulariser.load(), 1, fista),
        "TGV": (priors.TotalGeneralizedVariation(), 1, fista),
        "bilateral TV": (priors.BilateralTotalVariation(), 0.25, fista),
        "wavelet L1": (priors.WaveletL1(), 4, fista),
        "RED, NLM": (priors.RED(alike), 128, few),
        "plug-and-play, NLM": (priors.PlugAndPlay(alike), 0.1, few),
        "plug-and-play, bilateral": (priors.PlugAndPlay(priors.bilateral()), 0.006, few),
    }


class Race(NamedTuple):
    """A problem with `factor` times the best strength of its `prior`, the `entries` (solvers, each with the number of
    dual steps of a proximal step), and the solver that finds the minimum."""

    name: str
    scale: int
    prior: Prior
    factor: float
    entries: dict[str, tuple[Solver, int]]
    patient: Solver


def races(size: Size) -> list[Race]:
    fista, admm, condat = solvers.FISTA(), solvers.ADMM(), solvers.CondatVu()
    momentum, splitting = solvers.FISTA(iterations=size.exact), solvers.ADMM(iterations=2 * size.exact)
    few: dict[str, tuple[Solver, int]] = {f"FISTA, {steps} dual steps": (fista, steps) for steps in (4, 10, 20)}
    tv = few | {
        "FISTA, 4 dual steps, Backtracking": (solvers.FISTA(step_size=solvers.Backtracking()), 4),
        "ISTA": (solvers.ISTA(), 4),
        "ADMM": (admm, 4),
        "ChambollePock": (solvers.ChambollePock(), 4),
        "CondatVu": (condat, 4),
        "JaxoptFISTA": (solvers.JaxoptFISTA(), 4),
        "JaxoptISTA": (solvers.JaxoptISTA(), 4),
        "JaxoptADMM": (solvers.JaxoptADMM(), 4),
    }
    splits: dict[str, tuple[Solver, int]] = {"FISTA": (fista, 10), "ADMM": (admm, 10), "CondatVu": (condat, 10)}
    smooth = splits | {"NonlinearCG": (solvers.NonlinearCG(), 10), "LBFGS": (solvers.LBFGS(), 10)}
    usual = priors.TotalVariation()
    every = [
        Race("TV", 2, usual, 1, tv, momentum),
        Race("TV, λ ten times the best", 2, usual, 10, few | {"CondatVu": (condat, 4)}, momentum),
        Race("Huber-TV", 2, priors.HuberTotalVariation(), 1, smooth, momentum),
        Race("wavelet L1", 2, priors.WaveletL1(), 1, splits, splitting),
        Race("TV", 4, usual, 1, tv, momentum),
    ]
    return [one for one in every if one.scale in {scale for scale, _ in size.conditions}]


class Best(NamedTuple):
    """The picture at the strength of the highest PSNR; `psnr` in dB."""

    strength: float
    psnr: float
    ssim: float
    image: Float[np.ndarray, "H W"]


def best(case: Posed, prior: Prior, strength: float, solver: Solver) -> Best:
    """Searches from `strength`, by factors of 2 for as long as the PSNR grows."""

    def at(strength: float) -> Best:
        image = run(solver, _problem(case, prior, strength), case.start).image
        return Best(strength, *quality(case.truth, image, case.scale), image)

    top = at(strength)
    for factor in (2.0, 0.5):
        begun = top.strength
        while (next_one := at(top.strength * factor)).psnr > top.psnr:
            top = next_one
        if top.strength != begun:
            break
    return top


def _problem(case: Posed, prior: Prior, strength: float) -> Problem:
    return Problem(case.term, prior, jnp.asarray(strength, jnp.float32))


def _case(still: str, scale: int, sensor: int, light: str, seed: int) -> Posed:
    """A recording as one problem that all solvers and priors share, corrected for the exposures once; λ is that of
    `reconstruct` with Huber-TV."""
    made = recorded(still, scale=scale, sensor=sensor, light=light, seed=seed)
    return posed(made, Intervals(), validate=True, prior=priors.HuberTotalVariation(), exposed=True)


def compare_solvers(one: Race, case: Posed, seconds: float) -> dict[str, Any]:
    """All solvers of a race on its problem: `strength`, to which the minimum is `certain`, and `rows` by solver."""
    fista = solvers.FISTA(tolerance=3e-4)
    problem = _problem(case, one.prior, one.factor * best(case, one.prior, case.strength, fista).strength)
    known = minimum(problem, case.start, one.patient)
    assert known is not None
    jax.clear_caches()  # each row says what its own compilation takes
    entries = {
        name: Entry(solver, with_dual_steps(problem, steps), case.start, known)
        for name, (solver, steps) in one.entries.items()
    }
    rows = race(entries, case.truth, case.scale, seconds=seconds, rounds=ROUNDS)
    return {"strength": float(problem.strength), "certain": known.certain, "rows": rows}


def compare_priors(size: Size, seed: int) -> dict[str, Any]:
    """Returns `rows`, of each prior its `scores` by recording and the `seconds` of an iteration; and `shown`, one part
    of all pictures of the first still at the last scale, 8 bits a pixel."""
    rows: dict[str, Any] = {name: {"scores": {}, "seconds": []} for name in compared_priors()}
    shown: dict[str, Any] = {}
    for scale, light in size.conditions:
        for still in size.stills:
            case = _case(still, scale, size.side // scale, light, seed)
            found = {
                name: best(case, prior, factor * case.strength, solver)
                for name, (prior, factor, solver) in compared_priors().items()
            }
            for name, top in found.items():
                rows[name]["scores"][f"×{scale}, {light}, {still}"] = {
                    "psnr": top.psnr, "ssim": top.ssim, "strength": top.strength / case.strength
                }  # fmt: skip
            if scale == size.conditions[-1][0] and not shown:
                labelled = {f"{name} {top.psnr:.2f}": top.image for name, top in found.items()}
                shown = _detail({"enlarged": np.asarray(case.start), "truth": case.truth} | labelled)
                for name, seconds in in_turns(_timed(case), ROUNDS).items():
                    rows[name]["seconds"] = [one / _TIMED_ITERATIONS for one in seconds]
    return {"rows": rows, "shown": shown}


def _timed(case: Posed) -> dict[str, Any]:
    """Runs of a fixed number of iterations with each prior, compiled."""
    calls = {}
    for name, (prior, factor, solver) in compared_priors().items():
        problem = _problem(case, prior, factor * case.strength)
        fixed = replace(solver, iterations=_TIMED_ITERATIONS)
        calls[name] = partial(run, fixed, problem, case.start, tolerance=0.0)
        calls[name]()
    return calls


def _detail(images: dict[str, Float[np.ndarray, "H W"]]) -> dict[str, list[list[int]]]:
    top, left, tall, wide = detailed_part(images["truth"], scale=4, share=0.4)
    return {name: quantise(image[top : top + tall, left : left + wide]).tolist() for name, image in images.items()}


def measure(options: command.Options) -> Iterator[dict[str, Any]]:
    size = QUICK if options.quick else FULL
    yield from measured(size, options.families, options.seed)


def measured(size: Size, families: tuple[str, ...], seed: int) -> Iterator[dict[str, Any]]:
    """The results so far: after the solvers, and after the priors."""
    found: dict[str, Any] = {
        "stills": list(size.stills), "conditions": [f"×{scale}, {light}" for scale, light in size.conditions],
    }  # fmt: skip
    if "solvers" in families:
        cases: dict[int, Posed] = {}
        found["solvers"] = {}
        for one in races(size):
            if one.scale not in cases:
                cases[one.scale] = _case(size.stills[0], one.scale, size.sensor, "day", seed)
            shape = "×".join(str(n) for n in cases[one.scale].start.shape)
            title = f"{one.name}, ×{one.scale}, {shape}"
            found["solvers"][title] = compare_solvers(one, cases[one.scale], size.seconds)
        yield found
    if "priors" in families:
        found["priors"] = compare_priors(size, seed)
        yield found


def page(result: dict[str, Any], stem: str) -> str:
    parts = []
    if "solvers" in result:
        parts += ["### Solvers", *(_race_table(name, found) for name, found in result["solvers"].items())]
    if "priors" in result:
        rows, stills, conditions = result["priors"]["rows"], result["stills"], result["conditions"]
        parts += ["### Priors", _prior_table(rows, stills, conditions)]
    return "\n\n".join(parts)


def _race_table(name: str, found: dict[str, Any]) -> str:
    def line(solver: str, row: dict[str, Any]) -> list[str]:
        cells = [f"{1e3 * np.median(one['seconds']):.1f} ({one['iterations']})" for one in row["reached"]]
        cells += ["–"] * (len(GAPS) - len(cells))
        residual = next((f"{one['residual']:.1e}" for one in row["reached"] if one["gap"] == 1e-4), "–")
        return [f"`{solver}`", *cells, residual, f"{row['compile_seconds']:.1f}"]

    head = [
        "ms (iterations) to a gap of",
        *(f"{gap:.0e}" for gap in GAPS),
        "residual at a gap of 1e-04",
        "compiling, s",
    ]
    known = f"λ = {found['strength']:.2g}; the minimum is known to a relative error of {found['certain']:.0e}."
    return f"**{name}**; {known}\n\n" + command.table(head, [line(*row) for row in found["rows"].items()])


def _prior_table(rows: dict[str, Any], stills: list[str], conditions: list[str]) -> str:
    usual = np.median(rows["TV"]["seconds"])

    def line(name: str, row: dict[str, Any]) -> list[str]:
        cells = []
        for condition in conditions:
            some = [row["scores"][f"{condition}, {still}"] for still in stills]
            ratios = ", ".join(f"{one['psnr']:.2f}" for one in some)
            cells.append(f"{ratios} / {np.mean([one['ssim'] for one in some]):.3f}")
        strengths = [one["strength"] for one in row["scores"].values()]
        spread = f"{min(strengths):.3g} … {max(strengths):.3g}"
        return [name, *cells, spread, f"{np.median(row['seconds']) / usual:.1f}"]

    head = [
        f"{', '.join(stills)}, dB / mean SSIM",
        *conditions,
        "best λ relative to that of `reconstruct`",
        "time relative to TV",
    ]
    return command.table(head, [line(name, row) for name, row in rows.items()])


def plots(result: dict[str, Any]) -> dict[str, Figure | Image.Image]:
    drawn: dict[str, Figure | Image.Image] = {}
    if "solvers" in result:
        drawn["solvers"] = _curves(result["solvers"])
    if "priors" in result:
        drawn["priors"] = _panels(result["priors"]["shown"])
    return drawn


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


def _panels(shown: dict[str, list[list[int]]], zoom: int = 3, columns: int = 4) -> Image.Image:
    """One part of every picture, each pixel a square of screen pixels, one grey scale for all."""
    tall, wide = np.shape(shown["truth"])
    label, margin = 20, 6
    down, right = tall * zoom + label + margin, wide * zoom + margin
    drawn = Image.new("L", (columns * right + margin, math.ceil(len(shown) / columns) * down + margin), 255)
    pen, font = ImageDraw.Draw(drawn), ImageFont.load_default(13)
    for number, (name, image) in enumerate(shown.items()):
        y, x = margin + number // columns * down, margin + number % columns * right
        pixels = np.kron(np.asarray(image, np.uint8), np.ones((zoom, zoom), np.uint8))
        pen.text((x, y), name, fill=0, font=font)
        drawn.paste(Image.fromarray(pixels), (x, y + label))
    return drawn


BENCHMARK = command.Benchmark("choosing", __doc__, ("solvers", "priors"), measure, page, plots)

if __name__ == "__main__":
    command.main(BENCHMARK)
