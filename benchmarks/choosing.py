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
import math
import os
import platform
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from skimage import data
from skimage.metrics import structural_similarity

from scsr_opt import priors, reconstruct, solvers
from scsr_opt.camera.pictures import as_intensity
from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.camera.scenes import Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.demo import psnr
from scsr_opt.motion.estimate import given
from scsr_opt.motion.trajectory import trajectory_of
from scsr_opt.operators.sampling import DataTerm, accumulate, place, with_exposure
from scsr_opt.priors.prior import Prior
from scsr_opt.report import detailed_part, quantise, whole_file
from scsr_opt.solvers import Problem, Solver, run

FRAMES, VELOCITY, POSITIONS = 101, (0.07, -0.12), 3
LIGHTS = {"day": Sensor(white_rate=0.6, photons=1000.0), "dim": Sensor(white_rate=0.1, photons=25.0)}
GAPS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
MARKS = ("<!-- measured: begin -->", "<!-- measured: end -->")


class Size(NamedTuple):
    """How much is done: `sensor` and `side` in pixels (solvers' sensor, priors' picture), the `pictures` of the priors
    (the first is the solvers'), `conditions` (scale, light), `exact` iterations for the minimum, and in how many
    `seconds` a solver has to reach a gap."""

    sensor: int
    side: int
    pictures: tuple[str, ...]
    conditions: tuple[tuple[int, str], ...]
    exact: int
    seconds: float


FULL = Size(100, 144, ("camera", "brick", "moon"), ((2, "day"), (2, "dim"), (4, "day")), 600, 1.5)
QUICK = Size(40, 72, ("camera",), ((2, "day"),), 200, 0.5)


class Case(NamedTuple):
    """A recording as a data term, `start` and `strength` as `reconstruct` would take them, and the truth."""

    scale: int
    term: DataTerm
    start: Float[Array, "H W"]
    strength: float
    truth: Float[np.ndarray, "H W"]


def case_of(name: str, *, scale: int, sensor: int, light: str) -> Case:
    """A part of a picture that `sensor` pixels see, above its middle, panning."""
    picture, size = as_intensity(getattr(data, name)()), sensor * scale
    top, left = (picture.shape[0] - size) // 4, (picture.shape[1] - size) // 2
    scene = Translation(
        picture[top : top + size, left : left + size], (VELOCITY[0] * scale, VELOCITY[1] * scale), key=FRAMES // 2
    )
    made = simulate(scene, scale=scale, frames=FRAMES, sensor=LIGHTS[light])
    rate, key = made.white_rate, FRAMES // 2
    samples = spike_intervals(made.spikes, white_rate=rate)
    samples = eqx.tree_at(lambda s: s.weight, samples, samples.weight / np.float32(FRAMES))
    path = trajectory_of(given(VELOCITY, sensor, sensor), key=key, start=0, stop=FRAMES)
    padded = jax.tree.map(jnp.asarray, samples.padded())
    placed = place(padded, path, scale=scale, positions=POSITIONS, shape=(size, size))
    # Corrected for the exposures once, at a picture that all share: from then on it is one data term.
    found = reconstruct(made.spikes, scale=scale, key=key, white_rate=rate, velocity=VELOCITY)
    term = with_exposure(accumulate(placed), placed, jnp.asarray(found.image))
    seen = jnp.asarray(interval_rates(made.spikes, np.array([key - 10.0, key + 10.0]), white_rate=rate)[0])
    start = jax.image.resize(seen, (size, size), "linear")
    return Case(scale, term, start, found.stats["strength"], made.truth(key))


# Solvers


class Race(NamedTuple):
    """A problem, `factor` times the best strength of its `prior`, and the `entries`: solvers with how many dual steps
    the prior makes. `patient` finds the minimum."""

    name: str
    scale: int
    prior: Prior
    factor: float
    entries: dict[str, tuple[Solver, int]]
    patient: Solver


def races(size: Size) -> list[Race]:
    fista, admm, condat = solvers.FISTA(), solvers.ADMM(), solvers.CondatVu()
    # Deconvolution overshoots black and white: a minimiser is looked for well beyond them.
    gap = solvers.DualityGap(-1, 2)
    momentum = solvers.FISTA(iterations=size.exact, tolerance=1e-7, stopping=gap)
    splitting = solvers.ADMM(iterations=2 * size.exact, tolerance=1e-7, stopping=gap)
    few: dict[str, tuple[Solver, int]] = {f"FISTA, {steps} dual steps": (fista, steps) for steps in (5, 10, 20)}
    tv = few | {
        "FISTA, 5, Backtracking": (solvers.FISTA(step_size=solvers.Backtracking()), 5),
        "ISTA": (solvers.ISTA(), 5),
        "ADMM": (admm, 5),
        "ChambollePock": (solvers.ChambollePock(), 5),
        "CondatVu": (condat, 5),
        "JaxoptFISTA": (solvers.JaxoptFISTA(), 5),
        "JaxoptISTA": (solvers.JaxoptISTA(), 5),
        "JaxoptADMM": (solvers.JaxoptADMM(), 5),
    }
    splits: dict[str, tuple[Solver, int]] = {"FISTA": (fista, 10), "ADMM": (admm, 10), "CondatVu": (condat, 10)}
    smooth = splits | {"NonlinearCG": (solvers.NonlinearCG(), 10), "LBFGS": (solvers.LBFGS(), 10)}
    usual = priors.TotalVariation()
    every = [
        Race("TV", 2, usual, 1, tv, momentum),
        Race("TV, λ ten times the best", 2, usual, 10, few | {"CondatVu": (condat, 5)}, momentum),
        Race("Huber-TV", 2, priors.HuberTotalVariation(), 1, smooth, momentum),
        Race("wavelet L1", 2, priors.WaveletL1(), 1, splits, splitting),
        Race("TV", 4, usual, 1, tv, momentum),
    ]
    return [race for race in every if race.scale in {scale for scale, _ in size.conditions}]


class Exact(NamedTuple):
    """A problem in float64, the lowest objective that was found, and how far that is above the minimum at most,
    relative to it."""

    problem: Problem
    lowest: float
    certain: float

    def above(self, image: np.ndarray) -> float:
        with jax.enable_x64(True):
            return float(_objective(self.problem, jnp.asarray(image, jnp.float64))) / self.lowest - 1


@eqx.filter_jit
def _objective(problem: Problem, image: Float[Array, "H W"]) -> Float[Array, ""]:
    return problem.data.value(image) + problem.strength * problem.prior.value(image)


def exact(problem: Problem, start: Float[Array, "H W"], patient: Solver) -> Exact:
    """By a solver that measures its duality gap, with long proximal steps."""
    with jax.enable_x64(True):
        double = jax.tree.map(lambda v: v.astype(jnp.float64) if eqx.is_inexact_array(v) else v, problem)
        found = run(patient, _with_steps(double, 20), jnp.asarray(start, jnp.float64))
        lowest = float(_objective(double, jnp.asarray(found.image)))
    return Exact(double, lowest, found.stages[-1].gap)


def _with_steps(problem: Problem, dual_steps: int) -> Problem:
    prior: Any = problem.prior
    return replace(problem, prior=replace(prior, iterations=dual_steps))


def approach(
    solver: Solver, problem: Problem, start: Array, exact: Exact, seconds: float
) -> list[tuple[float, int, float]]:
    """For each gap that is reached in time: the gap there, iterations from the start, the residual there.

    It looks after every iteration at first, later after a twentieth more each time.
    """
    found, done, state, spent = [], 0, None, 0.0
    while len(found) < len(GAPS) and spent < seconds:
        more = max(done // 20, 1)
        begin = time.perf_counter()
        outcome = run(replace(solver, iterations=more), problem, start, state=state, tolerance=0.0)
        spent, done, state = spent + time.perf_counter() - begin, done + more, outcome.state
        above = exact.above(outcome.image)
        while len(found) < len(GAPS) and above <= GAPS[len(found)]:
            found.append((above, done, outcome.stages[-1].residual))
    return found


def seconds_of(solver: Solver, problem: Problem, start: Array, iterations: int) -> float:
    begin = time.perf_counter()
    run(replace(solver, iterations=iterations), problem, start, tolerance=0.0)
    return time.perf_counter() - begin


def race(case: Case, race: Race, seconds: float, rounds: int) -> dict[str, Any]:
    """All solvers on one problem: for each, seconds to compile and a row for each gap that it reached."""
    strength = race.factor * best(case, race.prior, case.strength, race.entries["CondatVu"][0]).strength
    problem = Problem(case.term, race.prior, jnp.asarray(strength, jnp.float32))
    reference = exact(problem, case.start, race.patient)
    jax.clear_caches()
    problems = {name: _with_steps(problem, steps) for name, (_, steps) in race.entries.items()}
    rows: dict[str, Any] = {}
    for name, (solver, _) in race.entries.items():
        first, second = (seconds_of(solver, problems[name], case.start, 21) for _ in range(2))
        found = approach(solver, problems[name], case.start, reference, seconds)
        reached = [
            {"gap": gap, "above": above, "iterations": iterations, "residual": residual, "seconds": []}
            for gap, (above, iterations, residual) in zip(GAPS, found, strict=False)
        ]
        rows[name] = {"compile_seconds": first - second, "reached": reached}
    for _ in range(rounds):
        for name, (solver, _) in race.entries.items():
            for row in rows[name]["reached"]:
                row["seconds"].append(seconds_of(solver, problems[name], case.start, row["iterations"]))
    return {"strength": strength, "minimum": reference.lowest, "certain": reference.certain, "rows": rows}


# Priors


class Best(NamedTuple):
    """The picture at the strength of the highest PSNR; `psnr` in dB."""

    strength: float
    psnr: float
    ssim: float
    image: Float[np.ndarray, "H W"]


def tried() -> list[tuple[str, Prior, float, Solver]]:
    """The rows of the table of priors: each with a strength to begin with, relative to that of total variation, and
    the solver; what denoises on the host is stopped by number."""
    tv, few = priors.TotalVariation(), solvers.FISTA(iterations=15)
    fista = solvers.FISTA(iterations=60, tolerance=3e-4)
    alike = priors.nl_means()
    return [
        ("TV", tv, 1, fista),
        ("TV, anisotropic", priors.TotalVariation(isotropic=False), 1, fista),
        ("TV, bounded 0 … 1", priors.Bounded(tv, 0, 1), 1, fista),
        ("Huber-TV", priors.HuberTotalVariation(), 1, fista),
        ("TGV", priors.TotalGeneralizedVariation(), 1, fista),
        ("bilateral TV", priors.BilateralTotalVariation(), 0.25, fista),
        ("wavelet L1", priors.WaveletL1(), 4, fista),
        ("RED, NLM", priors.RED(alike), 128, few),
        ("plug-and-play, NLM", priors.PlugAndPlay(alike), 0.1, few),
        ("plug-and-play, bilateral", priors.PlugAndPlay(priors.bilateral()), 0.006, few),
    ]


def best(case: Case, prior: Prior, strength: float, solver: Solver | None = None) -> Best:
    """From `strength`, by factors of 2 for as long as the PSNR grows."""
    solver = solvers.FISTA(tolerance=3e-4) if solver is None else solver

    def at(strength: float) -> Best:
        image = run(solver, Problem(case.term, prior, jnp.asarray(strength, jnp.float32)), case.start).image
        border = 8 * case.scale
        inner = (slice(border, -border),) * 2
        likeness: Any = structural_similarity(case.truth[inner], np.clip(image, 0, 1)[inner], data_range=1.0)
        return Best(strength, psnr(case.truth, image, border), float(likeness), image)

    top = at(strength)
    for factor in (2.0, 0.5):
        begun = top.strength
        while (next_one := at(top.strength * factor)).psnr > top.psnr:
            top = next_one
        if top.strength != begun:
            break
    return top


def compare(size: Size, rounds: int) -> tuple[dict[str, Any], dict[str, Float[np.ndarray, "H W"]]]:
    """All priors on all recordings; and the pictures of the first still at ×4."""
    rows: dict[str, Any] = {name: {"scores": {}, "seconds": []} for name, *_ in tried()}
    shown: dict[str, Float[np.ndarray, "H W"]] = {}
    for scale, light in size.conditions:
        for picture in size.pictures:
            case = case_of(picture, scale=scale, sensor=size.side // scale, light=light)
            found = {name: best(case, prior, factor * case.strength, solver) for name, prior, factor, solver in tried()}
            for name, one in found.items():
                rows[name]["scores"][f"×{scale}, {light}, {picture}"] = {
                    "psnr": one.psnr, "ssim": one.ssim, "strength": one.strength / case.strength
                }  # fmt: skip
            if scale == size.conditions[-1][0] and not shown:
                labelled = {f"{name} {one.psnr:.2f}": one.image for name, one in found.items()}
                shown = {"enlarged": np.asarray(case.start), "truth": case.truth} | labelled
                for _ in range(rounds):
                    for name, prior, factor, solver in tried():
                        problem = Problem(case.term, prior, jnp.asarray(factor * case.strength, jnp.float32))
                        rows[name]["seconds"].append(seconds_of(solver, problem, case.start, 20) / 20)
    return rows, shown


# The page


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
            times = [np.median(one["seconds"]) for one in row["reached"]]
            style: dict[str, Any] = {"color": f"C{number % 10}", "linestyle": "-" if number < 10 else "--"}
            axes.loglog(times, [one["above"] for one in row["reached"]], marker=".", label=name, **style)
        axes.set(title=title, xlabel="seconds, compiled")
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
