"""What `scsr stress` tries: one case is one way to solve one situation, in one precision.

The axes are those that have made reconstructions fail, or could: precision, scale, odd and tiny sizes, number of
frames, light, motion, bad pixels, lens, strength, step size, first picture, number of iterations, and every solver with
every prior. Each is a list of values from harmless to absurd. A part of the cases is a grid over two or three axes, a
part goes through the lists of what is data in turns, a part draws it at random (NumPy's generator, from the seed).

Compiling is what costs time: a program belongs to a solver, a prior, a shape and a precision, and everything else is
data. So cases that share a program are run one after another, and there are many of each.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.stress_methods import ANALYSIS, BOUNDED_STEPS, PRIORS, SLOW, SMOOTH, SOLVERS

# bfloat16: M and c rounded to it and the arithmetic in float32, which is what storing them so amounts to.
PRECISIONS = ("float64", "float32", "bfloat16")
STRENGTHS = (0.0, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4)
# Intensity of the brightest points, 1 = white, which fires 0.6 times a frame; recordings without and full of spikes.
LIGHTS = ("1", "0.3", "0.1", "0.01", "0.001", "0.0001", "saturated", "all-zero", "all-one")
MOTIONS = (
    "diagonal", "static", "rows only", "columns only", "integer", "wrong", "discontinuous", "huge", "not a number",
)  # fmt: skip
BAD = (0.0, 0.1, 0.5, 0.9, 0.99, 1.0)
STARTS = ("grey", "zero", "noise", "garbage", "1e12", "1e30", "other")
STEPS = (0.01, 0.5, 1.0, 1.5, 1.99, 2.5, 10.0)
FRAMES = (1, 2, 7, 41, 101, 2000)
SCALES = (1, 2, 3, 4, 5, 6, 7, 8)
# Odd and tiny sensors, each with the scales that it is tried at: a shape costs a compilation.
SIZES = {(1, 1): (1, 2, 8), (3, 5): SCALES, (1, 400): (1, 4), (400, 1): (2,)}
_SIZES_QUICK = {(1, 1): (8,), (3, 5): (3,), (1, 400): (1,)}
# Sensor of most cases: at ×2 a picture of 192 pixels, small enough for ten thousand iterations a second.
SENSOR, SCALE = (6, 8), 2
ITERATIONS = 80


@dataclass(frozen=True)
class Case:
    """**Fields:** `family`: which part of the cases it belongs to. `kind`: what is done, "solve" (`run`), "reconstruct"
    (the whole way from spikes, motion and strength handed in), "defaults" (the same with nothing handed in but the
    recording), "descent" (ISTA step by step), "gradient" (through the solution), "vmap" (several at a time). The others
    are the axes. `step`: β as a multiple of 1/L, or ADMM's ρ of its first one, None for the solver's own; `lens`:
    standard deviation of its blur in high-resolution pixels; `seed`: of the recording."""

    family: str
    kind: str = "solve"
    solver: str = "FISTA"
    prior: str = "Huber-TV"
    precision: str = "float32"
    sensor: tuple[int, int] = SENSOR
    scale: int = SCALE
    frames: int = 41
    light: str = "0.3"
    motion: str = "diagonal"
    bad: float = 0.0
    lens: float | None = None
    strength: float = 1e-3
    step: float | None = None
    start: str = "grey"
    iterations: int = ITERATIONS
    seed: int = 0

    @property
    def program(self) -> tuple[Any, ...]:
        """Cases that share it share what is compiled, but for the precision."""
        return (self.kind, self.solver, self.prior, self.sensor, self.scale, self.frames, self.lens)

    def name(self) -> str:
        """What it is, as far as it differs from the ordinary."""
        usual = Case(self.family)
        shown = [self.family, self.kind, self.solver, self.prior, self.precision]
        for field in dataclasses.fields(self)[5:]:
            value = getattr(self, field.name)
            if value != getattr(usual, field.name):
                shown.append(f"{field.name} {'×'.join(map(str, value)) if isinstance(value, tuple) else value}")
        return ", ".join(shown)


def cases(seed: int, *, quick: bool) -> list[Case]:
    """All of them, those that share a program together."""
    found: list[Case] = []
    for family, make in FAMILIES.items():
        found += [dataclasses.replace(case, family=family) for case in make(np.random.default_rng(seed), quick)]
    order = {program: n for n, program in enumerate(dict.fromkeys(case.program for case in found))}
    return sorted(found, key=lambda case: order[case.program])  # stable: within a program as they were made


def _in_each(precisions: tuple[str, ...], made: Iterator[Case]) -> Iterator[Case]:
    for case in made:
        for precision in precisions:
            yield dataclasses.replace(case, precision=precision)


def _pairs(quick: bool) -> Iterator[tuple[str, str]]:
    """Solvers with priors, those that refuse each other included."""
    for number, (solver, prior) in enumerate(itertools.product(SOLVERS, PRIORS)):
        variant = "," in solver
        if variant and prior not in ("TV", "Huber-TV"):
            continue
        if solver in SMOOTH and prior not in ("TV", "Huber-TV", "ridge"):
            continue
        if prior in SLOW and solver not in ("FISTA", "ADMM"):
            continue
        if quick and (number % 8 and not (solver in ("ISTA", "FISTA") and prior in ("TV", "Huber-TV"))):
            continue
        yield solver, prior


def _turns(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    """Every solver with every prior; the other axes go round, each at its own pace, so that all values meet."""
    each = 2 if quick else 5
    for number, (solver, prior) in enumerate(_pairs(quick)):
        for turn in range(each):
            at = number * each + turn
            case = Case(
                "",
                solver=solver,
                prior=prior,
                light=LIGHTS[at % 9],
                strength=STRENGTHS[at * 5 % 13],
                bad=BAD[at // 3 % 6] if at % 3 == 0 else 0.0,
                motion=MOTIONS[(at + at // 9) % 9],
                start=STARTS[(at + at // 7) % 7],
                seed=int(rng.integers(1 << 31)),
                iterations=12 if prior in SLOW else ITERATIONS,
            )
            yield from _in_each(PRECISIONS, iter([case]))


def _strengths(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    chosen = itertools.product(
        ("FISTA",) if quick else ("FISTA", "ADMM", "CondatVu", "ChambollePock", "LBFGS"),
        ("Huber-TV",) if quick else ("TV", "Huber-TV", "ridge", "wavelet"),
        STRENGTHS[::3] if quick else STRENGTHS,
    )
    made = (
        Case("", solver=solver, prior=prior, strength=strength, seed=int(rng.integers(1 << 31)))
        for solver, prior, strength in chosen
        if solver not in SMOOTH or prior in ("Huber-TV", "ridge")
    )
    return _in_each(PRECISIONS, made)


def _lights(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    made = (
        Case("", prior=prior, light=light, bad=bad, seed=int(rng.integers(1 << 31)))
        for prior, light, bad in itertools.product(
            ("Huber-TV",) if quick else ("Huber-TV", "ridge"), LIGHTS, (0.0, 1.0) if quick else BAD
        )
    )
    return _in_each(PRECISIONS, made)


def _steps(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    made = (
        Case("", solver=solver, prior=prior, step=step, start=start, seed=int(rng.integers(1 << 31)))
        for solver, prior, step, start in itertools.product(
            BOUNDED_STEPS if quick else (*BOUNDED_STEPS, "ADMM"),
            ("TV",) if quick else ("TV", "Huber-TV"),
            STEPS,
            ("grey",) if quick else ("grey", "1e12"),
        )
    )
    return _in_each(PRECISIONS[1:] if quick else PRECISIONS, made)


def _frames(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    made = (
        Case("", solver=solver, frames=frames, light=light, motion=motion, seed=int(rng.integers(1 << 31)))
        for solver, frames, (light, motion) in itertools.product(
            ("FISTA",) if quick else ("FISTA", "CondatVu"),
            FRAMES[:2] if quick else FRAMES,
            (("0.3", "diagonal"), ("all-one", "static"), ("0.01", "rows only")),
        )
    )
    return _in_each(PRECISIONS, made)


def _descent(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    made = (
        Case("", kind="descent", solver="ISTA", prior=prior, step=step, light=light, strength=strength, seed=seed)
        for seed, (prior, step, (light, strength)) in enumerate(
            itertools.product(
                ("TV",) if quick else (*ANALYSIS, "ridge", "bounded TV"),
                (1.0,) if quick else (0.5, 1.0),
                (("0.3", 1e-3), ("0.3", 0.0), ("0.01", 1e-2), ("0.3", 1.0), ("all-one", 1e-2), ("0.3", 1e4)),
            )
        )
    )
    return _in_each(PRECISIONS, made)


def _sizes(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    made = (
        Case(
            "", sensor=sensor, scale=scale, light=light, motion=motion, iterations=40, seed=int(rng.integers(1 << 31))
        )  # fmt: skip
        for sensor, scales in (_SIZES_QUICK if quick else SIZES).items()
        for scale in scales
        for light, motion in (("0.3", "diagonal"), ("all-one", "static"), ("0.01", "rows only"))
    )
    tiny = (
        Case("", solver=solver, prior=prior, sensor=sensor, light="0.3", iterations=40, seed=7)
        for sensor, (solver, prior) in itertools.product(
            ((1, 1), (3, 5)), () if quick else [(s, p) for s, p in _pairs(False) if s == "FISTA" or p == "Huber-TV"]
        )
    )
    return _in_each(PRECISIONS[1:], itertools.chain(made, tiny))


def _conditioning(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    chosen = itertools.product(
        ("FISTA",) if quick else ("FISTA", "ADMM", "LBFGS"),
        (8,) if quick else (2, 4, 8),
        MOTIONS[:5],
        (1e-3,) if quick else (0.0, 1e-3),
    )
    made = (
        Case("", solver=solver, scale=scale, motion=motion, strength=strength, seed=int(rng.integers(1 << 31)))
        for solver, scale, motion, strength in chosen
    )
    return _in_each(PRECISIONS, made)


def _lenses(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    made = (
        Case("", solver=solver, lens=lens, light=light, strength=strength, seed=int(rng.integers(1 << 31)))
        for solver, lens in itertools.product(
            ("FISTA",) if quick else ("FISTA", "CondatVu"), (16.0,) if quick else (1.0, 16.0)
        )
        for light, strength in (("0.3", 1e-3), ("0.3", 0.0), ("0.01", 1.0))
    )
    return _in_each(PRECISIONS, made)


def _long(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    every = ("FISTA", "FISTA, backtracking", "ISTA", "ADMM", "CondatVu", "ChambollePock", "LBFGS", "NonlinearCG")
    made = (
        Case("", solver=solver, prior=prior, iterations=5000 if quick else 100_000, start="noise", seed=3)
        for solver, prior in (
            *((solver, "Huber-TV") for solver in (every[:2] if quick else every)),
            *(() if quick else (("FISTA", "ridge"),)),
        )
    )
    return _in_each(PRECISIONS[1:2] if quick else PRECISIONS[:2], made)


def _gradients(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    made = (
        Case(
            "",
            kind="gradient",
            prior=prior,
            light=light,
            strength=strength,
            motion=motion,
            bad=bad,
            seed=int(rng.integers(1 << 31)),
        )  # fmt: skip
        for prior in (("TV",) if quick else (*ANALYSIS, "ridge"))
        for light, strength, motion, bad in (
            ("0.3", 1e-3, "diagonal", 0.0),
            ("0.3", 0.0, "diagonal", 0.0),
            ("0.3", 1e-8, "static", 0.0),
            ("all-one", 1e-2, "static", 0.0),
            ("all-zero", 1e-2, "static", 0.0),
            ("0.01", 0.1, "rows only", 0.5),
            ("0.3", 1e4, "diagonal", 0.0),
            ("0.3", 1e-2, "diagonal", 1.0),
            ("0.1", 1.0, "discontinuous", 0.9),
        )  # fmt: skip
    )
    return _in_each(PRECISIONS, made)


def _vmap(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    made = (
        Case("", kind="vmap", solver=solver, prior=prior, strength=strength, iterations=20, light=light, seed=11)
        for solver, prior in (
            [("FISTA", "TV")] if quick else [(s, p) for s, p in _pairs(False) if p == "Huber-TV" or s == "FISTA"]
        )
        for light, strength in (("0.3", 1e-3), ("all-one", 0.1))
        if prior not in SLOW and not (solver in SMOOTH and prior != "Huber-TV")
    )
    return _in_each(PRECISIONS[:2], made)


def _door(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    """The whole way from spikes to a picture."""

    def door(**axes: Any) -> Case:
        return Case("", kind="reconstruct", seed=int(rng.integers(1 << 31)), iterations=40, **axes)

    for motion, light in itertools.product(MOTIONS, LIGHTS[::4] if quick else LIGHTS):
        yield door(motion=motion, light=light)
    for bad, strength in itertools.product((1.0,) if quick else BAD, (1e-3,) if quick else (0.0, 1e-8, 1e-3, 1.0, 1e4)):
        yield door(bad=bad, strength=strength)
    for frames, light in itertools.product((1, 2000) if quick else FRAMES, ("0.3", "0.0001", "all-zero", "all-one")):
        yield door(frames=frames, light=light)
    if not quick:
        for sensor, scales in SIZES.items():
            for scale, light in itertools.product(scales[::2], ("0.3", "all-one")):
                yield door(sensor=sensor, scale=scale, light=light, motion="static")
        for lens in (1.0, 16.0):
            yield from (door(lens=lens, light=light) for light in LIGHTS)
        for motion, light in itertools.product(MOTIONS, LIGHTS[::2]):
            yield door(motion=motion, light=light, prior="ridge")


def _defaults(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    """As most people call it: motion, gains, λ and prior are `reconstruct`'s to find and choose."""

    def defaults(**axes: Any) -> Case:
        return Case("", kind="defaults", seed=int(rng.integers(1 << 31)), **{"sensor": (24, 32), **axes})

    true = ("diagonal", "static", "integer")
    for light, motion in itertools.product(LIGHTS[::4] if quick else LIGHTS, true[:1] if quick else true):
        yield defaults(light=light, motion=motion)
    for bad, light in itertools.product((0.5, 1.0) if quick else BAD[1:], ("0.3", "0.01", "saturated")):
        yield defaults(bad=bad, light=light)
    if not quick:
        for frames, light in itertools.product(FRAMES, ("0.3", "0.01", "all-zero", "all-one")):
            yield defaults(frames=frames, light=light)
        for sensor, scales in SIZES.items():
            for scale, light in itertools.product(scales[::4], ("0.3", "all-one")):
                yield defaults(sensor=sensor, scale=scale, light=light)
        for scale, light in itertools.product((1, 4), LIGHTS[::2]):
            yield defaults(scale=scale, light=light)
        # Larger than the part that λ is validated on, whole and with few pixels left.
        for bad, light in itertools.product((0.0, 0.9, 0.99), ("0.3", "0.1", "0.001")):
            yield defaults(sensor=(136, 150), bad=bad, light=light)


def _random(rng: np.random.Generator, quick: bool) -> Iterator[Case]:
    """Any value of an axis with any of the others; those for which nothing is compiled anew: not sensor, scale, lens
    and iterations."""
    allowed = [pair for pair in _pairs(quick) if pair[1] not in SLOW]

    def some(values: Any) -> Any:
        return values[int(rng.integers(len(values)))]

    for _ in range(40 if quick else 600):
        solver, prior = some(allowed)
        yield Case(
            "", solver=solver, prior=prior, precision=some(PRECISIONS), light=some(LIGHTS), motion=some(MOTIONS),
            frames=some(FRAMES) if rng.random() < 0.5 else 41,
            bad=some(BAD) if rng.random() < 0.5 else 0.0, strength=10 ** rng.uniform(-9, 4), start=some(STARTS),
            step=some(STEPS) if solver in (*BOUNDED_STEPS, "ADMM") and rng.random() < 0.3 else None,
            seed=int(rng.integers(1 << 31)),
        )  # fmt: skip


FAMILIES: dict[str, Callable[[np.random.Generator, bool], Iterator[Case]]] = {
    "solvers": _turns,
    "strengths": _strengths,
    "lights": _lights,
    "steps": _steps,
    "descent": _descent,
    "sizes": _sizes,
    "frames": _frames,
    "conditioning": _conditioning,
    "lenses": _lenses,
    "long": _long,
    "gradients": _gradients,
    "vmap": _vmap,
    "door": _door,
    "defaults": _defaults,
    "random": _random,
}
