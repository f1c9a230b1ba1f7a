"""The cases of `benchmarks.stress`: one case is one way to solve one situation, in one precision.

The axes are those that have made reconstructions fail, or could: precision, scale, odd and tiny sizes, number of
frames, light, motion, bad pixels, lens, strength, step size, first picture, number of iterations, and every solver with
every prior. Each is a list of values from harmless to absurd. Most families are grids over two or three axes; one goes
through the lists of values in turns, and one draws them at random (NumPy's generator, from the seed).

Compiling is what takes time: a program belongs to a solver, a prior, a shape and a precision, and everything else is
data. So cases that share a program are run one after another, and there are many of each.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.methods import ANALYSIS, BOUNDED_STEPS, PRIORS, SLOW, SMOOTH, SOLVERS

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
# Odd and tiny sensors, each with the scales that it is tried at: a shape takes a compilation.
SIZES = {(1, 1): (1, 2, 8), (3, 5): SCALES, (1, 400): (1, 4), (400, 1): (2,)}
# Sensor of most cases: at ×2 a picture of 192 pixels, small enough for ten thousand iterations a second.
SENSOR, SCALE = (6, 8), 2
ITERATIONS = 80
# `--quick` takes of each family a tenth of its programs, and at most this many cases of these.
_PROGRAMS_LEFT_OUT, _QUICK_CASES = 10, 40


@dataclass(frozen=True)
class Case:
    """**Fields:** `family`: the part of the cases that it belongs to. `kind`: what is done, "solve" (`run`),
    "reconstruct" (the whole way from spikes, with motion and strength given), "defaults" (the same with nothing given
    but the recording), "descent" (ISTA step by step), "gradient" (through the solution), "vmap" (several at a time).
    The others are the axes. `step`: β as a multiple of 1/L, or ADMM's ρ of its first one, None for the solver's own;
    `lens`: standard deviation of its blur in high-resolution pixels; `seed`: of the recording."""

    family: str = ""
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
        """Cases that share it share the compiled programs, except for the precision."""
        return (self.kind, self.solver, self.prior, self.sensor, self.scale, self.frames, self.lens)

    def name(self) -> str:
        """The values of a case, as far as they differ from the ordinary."""
        usual = Case()
        shown = [self.family, self.kind, self.solver, self.prior, self.precision]
        for field in dataclasses.fields(self)[5:]:
            value = getattr(self, field.name)
            if value != getattr(usual, field.name):
                shown.append(f"{field.name} {'×'.join(map(str, value)) if isinstance(value, tuple) else value}")
        return ", ".join(shown)


def cases(seed: int, *, quick: bool, families: tuple[str, ...] | None = None) -> list[Case]:
    """All cases, or those of some families; those that share a program one after another."""
    found: list[Case] = []
    for family, make in FAMILIES.items():
        if families is None or family in families:
            rng = np.random.default_rng(seed)
            made = [dataclasses.replace(case, family=family) for case in make(rng)]
            found += _part(made, rng) if quick else made
    order = {program: n for n, program in enumerate(dict.fromkeys(case.program for case in found))}
    return sorted(found, key=lambda case: order[case.program])  # stable: within a program as they were made


def _part(made: list[Case], rng: np.random.Generator) -> list[Case]:
    programs = list(dict.fromkeys(case.program for case in made))[::_PROGRAMS_LEFT_OUT]
    some = [case for case in made if case.program in programs]
    return [some[n] for n in sorted(rng.permutation(len(some))[:_QUICK_CASES])]


def grid(rng: np.random.Generator, precisions: tuple[str, ...] = PRECISIONS, **axes: Any) -> Iterator[Case]:
    """Every combination of the axes' values, each on a recording of its own, in all precisions.

    `solver__prior=[("FISTA", "TV"), …]` gives pairs of values of two axes.
    """
    for values in itertools.product(*axes.values()):
        fields: dict[str, Any] = {"seed": int(rng.integers(1 << 31))}
        for names, value in zip(axes, values, strict=True):
            several = "__" in names
            fields |= dict(zip(names.split("__"), value if several else (value,), strict=True))
        for precision in precisions:
            yield Case(precision=precision, **fields)


def pairs() -> list[tuple[str, str]]:
    """Solvers with priors, those that refuse each other included."""
    found = []
    for solver, prior in itertools.product(SOLVERS, PRIORS):
        variant = "," in solver
        left_out = (
            (variant and prior not in ("TV", "Huber-TV"))
            or (solver in SMOOTH and prior not in ("TV", "Huber-TV", "ridge"))
            or (prior in SLOW and solver not in ("FISTA", "ADMM"))
        )
        if not left_out:
            found.append((solver, prior))
    return found


def _pairs_with(prior: str, solver: str = "FISTA") -> list[tuple[str, str]]:
    """Every solver with the one prior, and every prior with the one solver."""
    return [pair for pair in pairs() if pair[1] == prior or pair[0] == solver]


def _turns(rng: np.random.Generator) -> Iterator[Case]:
    """Every solver with every prior; the other axes go round, each at its own pace, so that all values meet."""
    for at, ((solver, prior), _) in enumerate(itertools.product(pairs(), range(5))):
        yield from grid(
            rng,
            solver=(solver,),
            prior=(prior,),
            light=(LIGHTS[at % 9],),
            strength=(STRENGTHS[at * 5 % 13],),
            bad=(BAD[at // 3 % 6] if at % 3 == 0 else 0.0,),
            motion=(MOTIONS[(at + at // 9) % 9],),
            start=(STARTS[(at + at // 7) % 7],),
            iterations=(12 if prior in SLOW else ITERATIONS,),
        )


def _strengths(rng: np.random.Generator) -> Iterator[Case]:
    solvers, priors = ("FISTA", "ADMM", "CondatVu", "ChambollePock", "LBFGS"), ("TV", "Huber-TV", "ridge", "wavelet")
    chosen = [
        pair for pair in itertools.product(solvers, priors) if pair[0] not in SMOOTH or pair[1] in ("Huber-TV", "ridge")
    ]
    return grid(rng, solver__prior=chosen, strength=STRENGTHS)


def _sizes(rng: np.random.Generator) -> Iterator[Case]:
    shapes = [(sensor, scale) for sensor, scales in SIZES.items() for scale in scales]
    seen = [("0.3", "diagonal"), ("all-one", "static"), ("0.01", "rows only")]
    yield from grid(rng, PRECISIONS[1:], iterations=(40,), sensor__scale=shapes, light__motion=seen)
    yield from grid(
        rng, PRECISIONS[1:], iterations=(40,), sensor=((1, 1), (3, 5)), solver__prior=_pairs_with("Huber-TV")
    )


def _long(rng: np.random.Generator) -> Iterator[Case]:
    solvers = ("FISTA", "FISTA, backtracking", "ISTA", "ADMM", "CondatVu", "ChambollePock", "LBFGS", "NonlinearCG")
    chosen = [*((solver, "Huber-TV") for solver in solvers), ("FISTA", "ridge")]
    return grid(rng, PRECISIONS[:2], iterations=(100_000,), start=("noise",), solver__prior=chosen)


def _descent(rng: np.random.Generator) -> Iterator[Case]:
    seen = [("0.3", 1e-3), ("0.3", 0.0), ("0.01", 1e-2), ("0.3", 1.0), ("all-one", 1e-2), ("0.3", 1e4)]
    priors = (*ANALYSIS, "ridge", "bounded TV")
    return grid(rng, kind=("descent",), solver=("ISTA",), prior=priors, step=(0.5, 1.0), light__strength=seen)


def _gradients(rng: np.random.Generator) -> Iterator[Case]:
    seen = [
        ("0.3", 1e-3, "diagonal", 0.0),
        ("0.3", 0.0, "diagonal", 0.0),
        ("0.3", 1e-8, "static", 0.0),
        ("all-one", 1e-2, "static", 0.0),
        ("all-zero", 1e-2, "static", 0.0),
        ("0.01", 0.1, "rows only", 0.5),
        ("0.3", 1e4, "diagonal", 0.0),
        ("0.3", 1e-2, "diagonal", 1.0),
        ("0.1", 1.0, "discontinuous", 0.9),
    ]
    return grid(rng, kind=("gradient",), prior=(*ANALYSIS, "ridge"), light__strength__motion__bad=seen)


def _vmap(rng: np.random.Generator) -> Iterator[Case]:
    chosen = [pair for pair in _pairs_with("Huber-TV") if pair[1] not in SLOW]
    seen = [("0.3", 1e-3), ("all-one", 0.1)]
    return grid(rng, PRECISIONS[:2], kind=("vmap",), iterations=(20,), solver__prior=chosen, light__strength=seen)


def _reconstruct(rng: np.random.Generator) -> Iterator[Case]:
    """`reconstruct` from the spikes, with motion, λ, prior and solver given."""

    def given(**axes: Any) -> Iterator[Case]:
        return grid(rng, ("float32",), kind=("reconstruct",), iterations=(40,), **axes)

    yield from given(motion=MOTIONS, light=LIGHTS)
    yield from given(bad=BAD, strength=(0.0, 1e-8, 1e-3, 1.0, 1e4))
    yield from given(frames=FRAMES, light=("0.3", "0.0001", "all-zero", "all-one"))
    shapes = [(sensor, scale) for sensor, scales in SIZES.items() for scale in scales[::2]]
    yield from given(sensor__scale=shapes, light=("0.3", "all-one"), motion=("static",))
    yield from given(lens=(1.0, 16.0), light=LIGHTS)
    yield from given(motion=MOTIONS, light=LIGHTS[::2], prior=("ridge",))


def _defaults(rng: np.random.Generator) -> Iterator[Case]:
    """Calls as most people make them: `reconstruct` finds motion, gains and λ, and chooses the prior."""

    def defaults(sensor: Any = ((24, 32),), **axes: Any) -> Iterator[Case]:
        return grid(rng, ("float32",), kind=("defaults",), sensor=sensor, **axes)

    yield from defaults(light=LIGHTS, motion=("diagonal", "static", "integer"))
    yield from defaults(bad=BAD[1:], light=("0.3", "0.01", "saturated"))
    yield from defaults(frames=FRAMES, light=("0.3", "0.01", "all-zero", "all-one"))
    for sensor, scales in SIZES.items():
        yield from defaults(sensor=(sensor,), scale=scales[::4], light=("0.3", "all-one"))
    yield from defaults(scale=(1, 4), light=LIGHTS[::2])
    # Larger than the part that λ is validated on, whole and with few pixels left.
    yield from defaults(sensor=((136, 150),), bad=(0.0, 0.9, 0.99), light=("0.3", "0.1", "0.001"))


def _random(rng: np.random.Generator) -> Iterator[Case]:
    """Any value of an axis with any of the others, of axes whose values are data: not sensor, scale, lens and
    iterations."""
    allowed = [pair for pair in pairs() if pair[1] not in SLOW]

    def some(values: Any) -> Any:
        return values[int(rng.integers(len(values)))]

    for _ in range(600):
        solver, prior = some(allowed)
        yield Case(
            solver=solver, prior=prior, precision=some(PRECISIONS), light=some(LIGHTS), motion=some(MOTIONS),
            frames=some(FRAMES) if rng.random() < 0.5 else 41,
            bad=some(BAD) if rng.random() < 0.5 else 0.0, strength=10 ** rng.uniform(-9, 4), start=some(STARTS),
            step=some(STEPS) if solver in (*BOUNDED_STEPS, "ADMM") and rng.random() < 0.3 else None,
            seed=int(rng.integers(1 << 31)),
        )  # fmt: skip


FAMILIES: dict[str, Callable[[np.random.Generator], Iterator[Case]]] = {
    "solvers": _turns,
    "strengths": _strengths,
    "lights": lambda rng: grid(rng, prior=("Huber-TV", "ridge"), light=LIGHTS, bad=BAD),
    "steps": lambda rng: grid(
        rng, solver=(*BOUNDED_STEPS, "ADMM"), prior=("TV", "Huber-TV"), step=STEPS, start=("grey", "1e12")
    ),
    "descent": _descent,
    "sizes": _sizes,
    "frames": lambda rng: grid(
        rng,
        solver=("FISTA", "CondatVu"),
        frames=FRAMES,
        light__motion=[("0.3", "diagonal"), ("all-one", "static"), ("0.01", "rows only")],
    ),
    "conditioning": lambda rng: grid(
        rng, solver=("FISTA", "ADMM", "LBFGS"), scale=(2, 4, 8), motion=MOTIONS[:5], strength=(0.0, 1e-3)
    ),
    "lenses": lambda rng: grid(
        rng,
        solver=("FISTA", "CondatVu"),
        lens=(1.0, 16.0),
        light__strength=[("0.3", 1e-3), ("0.3", 0.0), ("0.01", 1.0)],
    ),
    "long": _long,
    "gradients": _gradients,
    "vmap": _vmap,
    "reconstruct": _reconstruct,
    "defaults": _defaults,
    "random": _random,
}
