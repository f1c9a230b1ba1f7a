"""Two statements with a benchmark of their own: what fusing an iteration is worth (`bench_plain` has the plain ones),
and what M and c cost."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.bench_cases import Size
from benchmarks.bench_plain import plain_condat_vu, plain_fista
from benchmarks.bench_timing import in_turns, keeping_memory, program, ratios
from benchmarks.frames import VELOCITY, recording
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.data_term import DataTerm, Stencil
from scsr_opt.operators.sampling import PlacedSamples, accumulate, place
from scsr_opt.priors import HuberTotalVariation
from scsr_opt.progress import Progress
from scsr_opt.solvers import FISTA, CondatVu, NormBound, Problem, Solver

_ROUNDS = 15
_IN_A_ROW = 10
_ITERATIONS = {"FISTA": (FISTA(step_size=NormBound()), plain_fista), "CondatVu": (CondatVu(), plain_condat_vu)}
_WAYS = ("fused", "plain")
SCALE = 4


def problem_of(shape: tuple[int, int]) -> tuple[Problem, Float[Array, "H W"]]:
    """A problem of the default prior with numbers drawn at random, and a first picture: what they are does not matter
    here, how many there are does."""
    planes, target, image = jax.random.split(jax.random.key(0), 3)
    data = DataTerm(
        Stencil(jax.random.uniform(planes, (5, *shape)) / 9), jax.random.uniform(target, shape), jnp.float32(1),
        Aperture(shape, SCALE), None,
    )  # fmt: skip
    return Problem(data, HuberTotalVariation(), jnp.float32(1e-3)), jax.random.uniform(image, shape)


@eqx.filter_jit
def fused_iteration(solver: Solver, problem: Problem, state: Any) -> Any:
    """One iteration as the solver does it, in one program."""
    return solver.step(problem, state)


@eqx.filter_jit
def fused_iterations(solver: Solver, problem: Problem, state: Any) -> Any:
    """`_IN_A_ROW` of them, as a solve has them: in one loop that is compiled whole."""
    return jax.lax.fori_loop(1, _IN_A_ROW, lambda _, now: solver.step(problem, now[0]), solver.step(problem, state))


def _plain_iterations(plain: Callable[..., Any], problem: Problem, state: Any) -> Any:
    for _ in range(_IN_A_ROW):
        state, said = plain(problem, state)
    return state, said


@eqx.filter_jit
def first_state(solver: Solver, problem: Problem, image: Float[Array, "H W"]) -> Any:
    return solver.init(problem, image)


@functools.lru_cache(maxsize=2)
def placed_of(frames: int, height: int, width: int, scale: int) -> PlacedSamples:
    """The spike intervals of random light that moves, at their places."""
    samples = spike_intervals(recording(frames, height, width).spikes)
    motion = Motion.of_velocity(np.broadcast_to(np.array(VELOCITY)[:, None, None], (2, height, width)))
    path = trajectory_of(motion, key=frames // 2, start=0, stop=frames)
    on_device = jax.tree.map(jnp.asarray, samples.padded())
    return place(on_device, path, scale=scale, shape=(scale * height, scale * width))


def plain_accumulation(placed: PlacedSamples) -> tuple[Float[np.ndarray, "5 H W"], Float[np.ndarray, "H W"]]:
    """M and c by NumPy: fourteen histograms, in float64."""
    height, width = placed.shape
    size, around = height * width, (0, 1, width, width + 1)
    planes, target = np.zeros((5, size)), np.zeros(size)
    weight, value = np.asarray(placed.weight), np.asarray(placed.value)
    # The product of tap a and tap b couples a with b: its plane and the tap that it is stored at.
    pairs = (
        (0, 0, 0, 0), (0, 1, 1, 1), (0, 2, 2, 2), (0, 3, 3, 3),
        (1, 0, 0, 1), (1, 2, 2, 3), (2, 1, 1, 2), (3, 0, 0, 2), (3, 1, 1, 3), (4, 0, 0, 3),
    )  # fmt: skip
    for index, down, right in zip(*map(np.asarray, jax.tree.leaves(placed.taps)), strict=True):
        taps = ((1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right)
        for offset, tap in zip(around, taps, strict=True):
            target += np.bincount(index + offset, weight * tap * value, size)
        for plane, at, first, second in pairs:
            planes[plane] += np.bincount(index + around[at], weight * taps[first] * taps[second], size)
    return (planes / placed.finest).reshape(5, height, width), (target / placed.finest).reshape(height, width)


def measure(size: Size, seed: int, progress: Progress) -> dict[str, Any]:
    """`iterations`, one for each solver, and `accumulation`, each with the seconds of both ways in turns, ready for
    JSON. An iteration is a tenth of ten in a row."""
    progress.start(2, "statements")
    try:
        problem, image = problem_of(size.picture)
        calls, programs = {}, {}
        for name, (solver, plain) in _ITERATIONS.items():
            state = first_state(solver, problem, image)
            programs[name] = program(fused_iteration, solver, problem, state)
            calls[name, "fused"] = functools.partial(fused_iterations, solver, problem, state)
            calls[name, "plain"] = functools.partial(_plain_iterations, plain, problem, state)
        taken = {name: [one / _IN_A_ROW for one in some] for name, some in _in_turns(calls, _ROUNDS).items()}
        iterations = [
            {
                "solver": name, "shape": list(size.picture), "seconds": {way: taken[name, way] for way in _WAYS},
                "ratio": ratios(taken[name, "plain"], taken[name, "fused"])._asdict(),
                "fusions": told.fusions, "moved": told.moved, "flops": told.flops,
            }
            for name, told in programs.items()
        ]  # fmt: skip
        progress.advance(1)
        frames, height, width, scale = size.accumulated
        placed = placed_of(frames, height, width, scale)
        calls = {"accumulate": lambda: accumulate(placed), "numpy": lambda: plain_accumulation(placed)}
        taken = _in_turns(calls, size.rounds)
        accumulation = {
            "frames": frames, "sensor": [height, width], "scale": scale,
            "samples": int(np.count_nonzero(np.asarray(placed.weight))), "seconds": taken,
            "ratio": ratios(taken["numpy"], taken["accumulate"])._asdict(),
        }  # fmt: skip
        progress.advance(1)
    finally:
        progress.finish()
    return {"iterations": iterations, "accumulation": accumulation}


def _in_turns(calls: dict[Any, Callable[[], Any]], rounds: int) -> dict[Any, list[float]]:
    with keeping_memory():
        for call in calls.values():
            jax.block_until_ready(call())
        return in_turns(calls, rounds)
