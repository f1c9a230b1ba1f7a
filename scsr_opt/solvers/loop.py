"""The loop that all native solvers share: jitted chunks of iterations, a record of each, early stop, progress."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scsr_opt._kernels.programs import ready
from scsr_opt.errors import InputError
from scsr_opt.progress import Progress, check_progress
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.record import Stage, Status, TileIterations
from scsr_opt.solvers.solver import Record, Solver, State

# Iterations between two looks from outside. At 20 the loop loses 5 % to being interrupted.
CHUNK_ITERATIONS = 20
# And between two corrections of the problem, each of which costs about as much as they do.
CORRECTION_ITERATIONS = 4


# Of a picture and a tolerance: a problem with other c and e, or None where the one so far is good enough for both.
Correction = Callable[[Float[Array, "H W"], float], Problem | None]


class Outcome(NamedTuple):
    """Result of a solve; `tiles`, iterations of single tiles, where there were any (`run_tiles`)."""

    image: Float[np.ndarray, "H W"]
    stages: tuple[Stage, ...]
    status: Status
    state: Any
    tiles: TileIterations | None = None


def run(
    solver: Solver,
    problem: Problem,
    image: Float[Array, "H W"] | None = None,
    *,
    state: Any = None,
    similar: Any = None,
    correction: Correction | None = None,
    progress: Progress | None = None,
    keep_images: bool = False,
    tolerance: float | int | None = None,
) -> Outcome:
    """Runs `solver` on `problem` from `image`, from `state`, or from the state of a `similar` problem.

    **Arguments:**
    - `image`: (H, W), X^(0); `problem.start` if None.
    - `state`: `Outcome.state` (`Solution.state`) of a run of the same solver on the same problem: what follows is what
      would have followed there. `similar`: that of a run on a problem with other data, strength, or limits.
    - `correction`: makes another problem of the picture after every `CORRECTION_ITERATIONS` iterations, and where the
      tolerance is met; only where it makes none the run ends there.
    - `progress`: receives the number of iterations done, by chunks.
    - `keep_images`: every stage keeps R^(t) and X^(t); each iteration is a chunk of its own.
    - `tolerance`: stands in for the solver's own.

    A value that is not finite ends the run at once; the picture before it is returned.

    **Errors:** `InputError` for a state of another solver or picture size, an initial image (or that of a state) that
    is not finite, or a prior that the solver cannot use.
    """
    ready()
    check_progress(progress)
    begin = time.perf_counter()
    image, problem = problem.start if image is None else image, dataclasses.replace(problem, start=None)
    if image is None:
        raise InputError("run was given no picture, nor a problem with one (Problem.start); give X^(0).")
    iterations, enough = solver.iterations, np.float32(solver.tolerance if tolerance is None else tolerance)
    solver.check(problem.prior)
    # The limits are arguments of their own, so that other limits compile nothing anew.
    solver = dataclasses.replace(solver, iterations=1, tolerance=0.0)
    if state is not None:
        _check_state(solver, problem, state)
    elif similar is not None:
        _check_state(solver, problem, similar)
        state = _warm(solver, problem, similar)
    between = CHUNK_ITERATIONS if correction is None else CORRECTION_ITERATIONS
    chunk = 1 if keep_images else between

    def advanced(before: Any, most: int) -> tuple[Any, ...]:
        start = _begin(solver, problem, image) if before is None else before
        return advance(solver, problem, start, np.int32(most), enough)

    stages: list[Stage] = []
    status = Status.iterations_exhausted
    if progress is not None:
        progress.start(None, f"solving, at most {iterations} iterations")  # most solves need few of them
    try:
        while len(stages) < iterations:
            before = state
            state, *seen = advanced(before, min(chunk, iterations - len(stages)))
            table, done, finite, met = jax.device_get(seen)
            seconds = time.perf_counter() - begin
            if not finite:
                if done == 1 and not stages:  # there is no picture before but the first one
                    _check_finite(solver, image if before is None else solver.image(before))
                # Rather than that every iteration keeps the one before it: the same way once more, but for its last.
                state = advanced(before, int(done) - 1)[0]
            pictures: dict[str, Any] = {}
            if keep_images:
                pictures = {
                    "image": np.array(solver.image(state)),
                    "gradient_step": np.array(solver.gradient_step(problem, state)),
                }
            for record in table[:done]:
                stages.append(Stage.of(len(stages) + 1, record, seconds, **pictures))
            if progress is not None:
                progress.advance(int(done))
            if not finite:
                status = Status.non_finite
                break
            if correction is not None and (met or len(stages) % between == 0):
                following = correction(solver.image(state), float(enough))
                if following is not None:
                    state = _retargeted(solver, following, problem, state)
                    problem, met = following, False
            if met:
                status = Status.converged
                break
    finally:
        if progress is not None:
            progress.finish()
    # Splitting methods keep to bounds in a copy, which the picture only tends to.
    found = problem.prior.clip(solver.image(state))
    # A copy, which can be written to; the state keeps its own.
    return Outcome(np.array(found), tuple(stages), status, state)


def _check_state(solver: Solver, problem: Problem, state: Any) -> None:
    name = type(solver).__name__
    if not isinstance(state, solver.state_type):
        raise InputError(
            f"{name} was given a state of type {type(state).__name__}; it goes on from a {solver.state_type.__name__}, "
            "the state of a solution that the same solver found."
        )
    shape = solver.image(state).shape
    if shape != problem.data.shape:
        raise InputError(
            f"{name} was given the state of a picture of shape {shape}; those of the problem are {problem.data.shape}."
        )


def _check_finite(solver: Solver, image: Float[Array, "H W"]) -> None:
    wrong = int(jnp.count_nonzero(~jnp.isfinite(image)))
    if wrong:
        raise InputError(
            f"{type(solver).__name__} was given an initial image, or a state, with {wrong} values that are not finite; "
            "begin with a finite one."
        )


@eqx.filter_jit
def _warm(solver: Solver[State], problem: Problem, state: State) -> State:
    return strongly_typed(solver.warm(problem, state))


@eqx.filter_jit
def _retargeted(solver: Solver[State], problem: Problem, before: Problem, state: State) -> State:
    return strongly_typed(solver.retargeted(problem, before, state))


def strongly_typed(state: State) -> State:
    """The state without weak types, such as a Python number leaves: `advance` gives none, and would compile twice."""
    return jax.tree.map(
        lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype) if eqx.is_array(leaf) else leaf, state
    )


@eqx.filter_jit
def _begin(solver: Solver[State], problem: Problem, image: Float[Array, "H W"]) -> State:
    """The state before the first iteration."""
    return strongly_typed(solver.init(problem, image))


@eqx.filter_jit
def advance(
    solver: Solver[State],
    problem: Problem,
    state: State,
    most: Int[Array | np.int32, ""],
    tolerance: Float[Array | np.float32, ""],
) -> tuple[State, Float[Array, "most _"], Int[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
    """Up to `most` ≤ `CHUNK_ITERATIONS` iterations: the state, their records, how many, all finite?, tolerance met?"""
    dtype = problem.data.target.dtype
    enough = jnp.asarray(tolerance, dtype)

    def go_on(carry):
        _, _, done, finite, met = carry
        return (done < most) & finite & ~met

    def one(carry):
        state, table, done, _, _ = carry
        state, record = solver.step(problem, state)
        finite = jnp.isfinite(record.data + record.prior + record.residual)
        met = finite & (solver.stopping.measure(record.residual, record.gap) <= enough)
        return state, table.at[done].set(jnp.stack(record)), done + 1, finite, met

    table = jnp.zeros((CHUNK_ITERATIONS, len(Record._fields)), dtype)
    begin = (state, table, jnp.zeros((), jnp.int32), jnp.asarray(True), jnp.asarray(False))
    return jax.lax.while_loop(go_on, one, begin)
