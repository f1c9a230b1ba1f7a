"""Two statements with a benchmark of their own: what fusing an iteration is worth, and what M and c cost.

`plain_iteration` is one iteration of the default solver with the default prior as it would be written without thinking
of memory: each operator is compiled on its own, and nothing is fused across them. These are the same steps and give
the same numbers (`tests/benchmarks/test_bench.py`).
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.bench_cases import Size
from benchmarks.bench_timing import in_turns, program, ratios
from benchmarks.frames import VELOCITY, recording
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.sampling import DataTerm, PlacedSamples, Stencil, accumulate, place
from scsr_opt.priors import Dual, HuberTotalVariation
from scsr_opt.priors.analysis import dual_cycles
from scsr_opt.priors.total_variation import gradient, gradient_adjoint, to_unit_ball
from scsr_opt.progress import Progress
from scsr_opt.solvers import FISTA, Problem, Solver
from scsr_opt.solvers.proximal_gradient import ProximalGradientState

_ROUNDS = 15
SCALE = 4

_minus = jax.jit(lambda x, y: x - y)
_ahead_by = jax.jit(lambda a, x, y: x + a * y)
_beyond = jax.jit(lambda x, a, y, b, z: x + a * (x - y) + b * (x - z))
_inner = jax.jit(lambda x, y: jnp.sum(x * y))
_norm = jax.jit(jnp.linalg.norm)
_gradient = jax.jit(gradient)
_gradient_adjoint = jax.jit(gradient_adjoint)
_shorter = jax.jit(lambda dual, a: Dual(dual.down / a, dual.right / a))
_ball = jax.jit(to_unit_ball)
_apply = eqx.filter_jit(lambda operator, x: operator(x))
_back = eqx.filter_jit(lambda operator, x: operator.adjoint(x))
_value = eqx.filter_jit(lambda prior, field: jnp.sum(prior.penalties(field)))


def problem_of(shape: tuple[int, int]) -> tuple[Problem, Float[Array, "H W"]]:
    """A problem of the default prior with numbers drawn at random, and a first picture: what they are does not matter
    here, how many there are does."""
    planes, target, image = jax.random.split(jax.random.key(0), 3)
    data = DataTerm(
        Stencil(jax.random.uniform(planes, (5, *shape)) / 9), jax.random.uniform(target, shape), jnp.float32(1),
        Aperture(shape, SCALE), None,
    )  # fmt: skip
    return Problem(data, HuberTotalVariation(), jnp.float32(1e-3)), jax.random.uniform(image, shape)


def plain_iteration(problem: Problem, state: ProximalGradientState) -> tuple[ProximalGradientState, tuple[Array, ...]]:
    """One iteration of `FISTA` with `HuberTotalVariation`, operator by operator; and f, λΨ and the residual."""
    data, prior, step = problem.data, problem.prior, state.step_size
    assert isinstance(prior, HuberTotalVariation) and data.optics is None
    before = _ahead_by(-step, state.ahead, state.ahead_gradient)
    image, dual = _plain_prox(prior, before, step * problem.strength, state.prior)
    u = _apply(data.aperture, image)
    rest = _minus(_apply(data.stencil, u), data.target)
    value = 0.5 * (_inner(u, rest) - _inner(u, data.target) + data.energy)
    slope = _back(data.aperture, rest)
    penalty = problem.strength * _value(prior, _gradient(image))
    residual = _norm(_minus(image, state.ahead)) / _norm(image)
    objective = value + penalty
    uphill = _inner(_minus(state.ahead, image), _minus(image, state.image)) > 0
    uphill |= objective > state.objective
    t = jnp.where(uphill, 1, state.momentum)
    following = (1 + jnp.sqrt(1 + 4 * t**2)) / 2
    along, beyond = jnp.where(uphill, 0, (t - 1) / following), jnp.where(uphill, 0, t / following)
    after = ProximalGradientState(
        image=image, gradient=slope, gradient_step=before, momentum=following, objective=objective, prior=dual,
        ahead=_beyond(image, along, state.image, beyond, state.ahead),
        ahead_gradient=_beyond(slope, along, state.gradient, beyond, state.ahead_gradient), step_size=step,
    )  # fmt: skip
    return after, (value, penalty, residual)


def _plain_prox(prior: HuberTotalVariation, image: Array, strength: Array, state: Dual) -> tuple[Array, Dual]:
    """The dual steps of `Analysis.prox`, one operator after the other."""
    cycles, lengths = dual_cycles(prior.iterations)
    assert cycles == 1  # no momentum, then
    dual = state
    for length in lengths:
        step = length / (prior.norm_squared * strength)
        field = _gradient(_ahead_by(-strength, image, _gradient_adjoint(dual)))
        moved = Dual(*(_ahead_by(step, p, z) for p, z in zip(dual, field, strict=True)))
        dual = _ball(_shorter(moved, 1 + step * prior.knee))
    return _ahead_by(-strength, image, _gradient_adjoint(dual)), dual


@eqx.filter_jit
def fused_iteration(solver: Solver, problem: Problem, state: Any) -> Any:
    """One iteration as the solver does it, in one program."""
    return solver.step(problem, state)


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
    """`iteration` and `accumulation`, each with the seconds of both ways in turns, ready for JSON."""
    progress.start(2, "statements")
    try:
        problem, image = problem_of(size.picture)
        state, solver = first_state(FISTA(), problem, image), FISTA()
        calls = {
            "fused": lambda: fused_iteration(solver, problem, state), "plain": lambda: plain_iteration(problem, state),
        }  # fmt: skip
        taken = _in_turns(calls, _ROUNDS)
        told = program(fused_iteration, solver, problem, state)
        iteration = {
            "shape": list(size.picture), "seconds": taken, "ratio": ratios(taken["plain"], taken["fused"])._asdict(),
            "fusions": told.fusions, "moved": told.moved, "flops": told.flops,
        }  # fmt: skip
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
    return {"iteration": iteration, "accumulation": accumulation}


def _in_turns(calls: dict[str, Any], rounds: int) -> dict[str, list[float]]:
    for call in calls.values():
        jax.block_until_ready(call())
    return in_turns(calls, rounds)
