"""The loop that all native solvers share: jitted chunks of iterations, a record of each, early stop, progress."""

import abc
import time
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scsr_opt.errors import InputError
from scsr_opt.progress import Progress
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.solution import Result, Stage

State = TypeVar("State")

# Iterations between two looks from outside. At 20 the loop loses 5 % to being interrupted.
CHUNK = 20


class Record(NamedTuple):
    """The numbers of a `Stage`, as arrays."""

    data: Float[Array, "..."]
    prior: Float[Array, "..."]
    residual: Float[Array, "..."]
    step_size: Float[Array, "..."]


class Solver(eqx.Module, Generic[State]):
    """A method for `Problem`. It is a value; what changes from iteration to iteration is in its state.

    **Fields:**
    - `iterations`: the most that are done.
    - `tolerance`: it ends when the relative residual ‖X − G(X)‖ / ‖X‖, G one proximal-gradient step, is below it.
    """

    iterations: eqx.AbstractVar[int]
    tolerance: eqx.AbstractVar[float | int]

    def __check_init__(self):
        if self.iterations < 1:
            raise InputError(f"{type(self).__name__} was given {self.iterations} iterations; it needs at least 1.")
        if not self.tolerance >= 0:
            raise InputError(
                f"{type(self).__name__} was given tolerance {self.tolerance}; it is a relative residual of at least 0 "
                "(0: use all iterations)."
            )

    @abc.abstractmethod
    def init(self, problem: Problem, image: Float[Array, "H W"]) -> State:
        """The state before the first iteration, from a first picture."""

    def warm(self, problem: Problem, state: State) -> State:
        """The state before the first iteration, from that of a run on a similar problem."""
        return self.init(problem, self.image(state))

    @abc.abstractmethod
    def step(self, problem: Problem, state: State) -> tuple[State, Record]:
        """One iteration."""

    @abc.abstractmethod
    def image(self, state: State) -> Float[Array, "H W"]:
        """X^(t)."""

    @abc.abstractmethod
    def gradient_step(self, state: State) -> Float[Array, "H W"]:
        """R^(t) of Eq. 5, the argument of the latest proximal step."""


class Outcome(NamedTuple):
    """What a solve gives back."""

    image: Float[np.ndarray, "H W"]
    stages: tuple[Stage, ...]
    result: Result
    state: Any


def run(
    solver: Solver,
    problem: Problem,
    image: Float[Array, "H W"],
    *,
    state: Any = None,
    similar: Any = None,
    progress: Progress | None = None,
    keep_images: bool = False,
    tolerance: float | int | None = None,
) -> Outcome:
    """Runs `solver` on `problem` from `image`, or goes on from `state`, or begins with that of a `similar` problem.

    A value that is not finite ends the run at once; the picture before it is returned. With `keep_images` every stage
    keeps R^(t) and X^(t), and each iteration is a chunk of its own. `tolerance` stands in for the solver's own.
    """
    begin = time.perf_counter()
    iterations, enough = solver.iterations, jnp.float32(solver.tolerance if tolerance is None else tolerance)
    # The limits are handed over apart, so that other limits compile nothing anew.
    solver = eqx.tree_at(lambda s: (s.iterations, s.tolerance), solver, (1, 0.0))
    if state is None:
        state = _init(solver, problem, image) if similar is None else _warm(solver, problem, similar)
    chunk = 1 if keep_images else CHUNK
    stages: list[Stage] = []
    result = Result.iterations_exhausted
    if progress is not None:
        progress.start(iterations, "solving")
    try:
        while len(stages) < iterations:
            most = jnp.asarray(min(chunk, iterations - len(stages)), jnp.int32)
            state, records, done, finite, met = _advance(solver, problem, state, most, enough, chunk)
            done, seconds = int(done), time.perf_counter() - begin
            pictures: dict[str, Any] = {}
            if keep_images:
                pictures = {
                    "image": np.asarray(solver.image(state)),
                    "gradient_step": np.asarray(solver.gradient_step(state)),
                }
            table = np.stack([np.asarray(column)[:done] for column in records], axis=1).astype(float)
            for data, prior, residual, step_size in table:
                stages.append(
                    Stage(len(stages) + 1, data + prior, data, prior, residual, step_size, seconds, **pictures)
                )
            if progress is not None:
                progress.advance(done)
            if not bool(finite):
                result = Result.non_finite
                break
            if bool(met):
                result = Result.converged
                break
    finally:
        if progress is not None:
            progress.finish()
    return Outcome(np.asarray(solver.image(state)), tuple(stages), result, state)


@eqx.filter_jit
def _init(solver: Solver[State], problem: Problem, image: Float[Array, "H W"]) -> State:
    return solver.init(problem, image)


@eqx.filter_jit
def _warm(solver: Solver[State], problem: Problem, state: State) -> State:
    return solver.warm(problem, state)


@eqx.filter_jit
def _advance(
    solver: Solver[State],
    problem: Problem,
    state: State,
    most: Int[Array, ""],
    tolerance: Float[Array, ""],
    chunk: int,
) -> tuple[State, Record, Int[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
    """Up to `most` ≤ `chunk` iterations: the state, their records, how many, all finite?, tolerance met?"""
    dtype = problem.data.target.dtype
    records = Record(*(jnp.zeros(chunk, dtype) for _ in Record._fields))

    def go_on(carry):
        _, _, done, finite, met = carry
        return (done < most) & finite & ~met

    def one(carry):
        before, records, done, _, _ = carry
        after, record = solver.step(problem, before)
        finite = jnp.isfinite(record.data + record.prior + record.residual)
        met = finite & (record.residual <= tolerance.astype(dtype))
        state = jax.tree.map(lambda new, old: jnp.where(finite, new, old), after, before)
        records = Record(*(column.at[done].set(value) for column, value in zip(records, record, strict=True)))
        return state, records, done + 1, finite, met

    begin = (state, records, jnp.zeros((), jnp.int32), jnp.asarray(True), jnp.asarray(False))
    return jax.lax.while_loop(go_on, one, begin)
