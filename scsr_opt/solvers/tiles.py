"""An active set: only those tiles of a picture are iterated further that are not finished.

What rests is found in a few iterations, what moves or was hardly seen in many, and the residual of the whole picture is
a mean of both. So the whole picture, if it has more than a few tiles, is iterated only until that is near the
tolerance. How far each tile then is from optimal is measured by the slope of F: by how much a step along it, as long
as each pixel allows, changes the tile. Where that is above a limit, F is minimised over the tile's pixels alone, their
surroundings held, by the same solver: in a window that reaches as far as a pixel's gradient does, with steps of length
0 outside the tile. No two tiles that touch are solved for at once (they have four colours), so that F falls with each,
as in any descent by blocks of coordinates.

Then the whole picture is looked at again, and tiles that a neighbour's change moved are iterated, too. A solve ends
with an iteration of the WHOLE picture, whose residual meets the tolerance, and that of no tile is above its limit.
"""

import dataclasses
import math
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import maximum_filter

from scsr_opt._kernels.device import on_device
from scsr_opt.operators.aperture import Aperture
from scsr_opt.priors.analysis import Analysis
from scsr_opt.progress import NoProgress, Progress, check_progress
from scsr_opt.solvers.loop import CORRECTION_ITERATIONS, Correction, Outcome, advance, run
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA, ISTA, ProximalGradientState
from scsr_opt.solvers.record import Stage, Status, TileIterations
from scsr_opt.solvers.settings import TileSettings
from scsr_opt.solvers.solver import Record, Solver
from scsr_opt.solvers.step_size import Separable
from scsr_opt.solvers.stopping import FixedPoint


def is_tileable(solver: Solver, problem: Problem, settings: TileSettings = TileSettings()) -> bool:
    """True where a problem can be solved tile by tile: each pixel has its own step size, and is coupled with near ones
    only."""
    data = problem.data
    if not isinstance(data.aperture, Aperture) or data.optics is not None:
        return False
    if not isinstance(solver, FISTA | ISTA) or not isinstance(solver.step_size, Separable):
        return False
    near = isinstance(problem.prior, Analysis) and problem.prior.separable
    return (
        near and isinstance(solver.stopping, FixedPoint) and min(data.shape) >= _window(data.aperture.scale, settings)
    )


def run_tiles(
    solver: Solver,
    problem: Problem,
    image: Float[Array, "H W"],
    *,
    similar: Any = None,
    correction: Correction | None = None,
    progress: Progress | None = None,
    tolerance: float | int | None = None,
    finished_tiles: bool = True,
    settings: TileSettings = TileSettings(),
) -> Outcome:
    """Iterations as by `run`, until each tile is finished, too; for problems that are `is_tileable`.

    **Arguments:** those of `run`, and
    - `finished_tiles`: whether tiles that are finished are left alone (`Shortcuts`). If not, iterations are of the
      whole picture until all are.
    - `settings`: size of the tiles, and when the whole picture is iterated, and when a tile.

    Each `Stage` is an iteration of the whole picture. The solver's limit of iterations holds for each tile; where it is
    met, tiles may have changed since the last stage.
    """
    check_progress(progress)
    if progress is not None:
        progress.start(None, f"solving, at most {solver.iterations} iterations")
    try:
        given: dict[str, Any] = {"similar": similar, "correction": correction, "progress": progress}
        given |= {"tolerance": tolerance, "finished_tiles": finished_tiles, "settings": settings}
        return _run(solver, problem, image, **given)
    finally:
        if progress is not None:
            progress.finish()


class _Within(NoProgress):
    """Progress of a part of the solve, without a start and an end of its own."""

    def __init__(self, progress: Progress):
        self._progress = progress

    def advance(self, done: int) -> None:
        self._progress.advance(done)


def _run(
    solver: Solver,
    problem: Problem,
    image: Float[Array, "H W"],
    *,
    similar: Any,
    correction: Correction | None,
    progress: Progress | None,
    tolerance: float | int | None,
    finished_tiles: bool,
    settings: TileSettings,
) -> Outcome:
    """`run_tiles`, without the start and end of its progress."""
    begun = time.perf_counter()
    # As `run` rounds it, which hands it on to corrections.
    enough = float(np.float32(solver.tolerance if tolerance is None else tolerance))
    current = problem

    def corrected(image: Float[Array, "H W"], tolerance: float) -> Problem | None:
        nonlocal current
        # The first iterations of a whole picture that tiles will follow are corrected once; other ones, and tiles, as
        # the tolerance asks that is to be met at last.
        good = enough if tolerance <= enough else math.inf
        following = None if correction is None else correction(image, good)
        current = current if following is None else following
        return following

    def whole(tolerance: float, iterations: int, **begin: Any) -> tuple[Any, Status]:
        """Iterations of the whole picture, with corrections on the way."""
        limited = dataclasses.replace(solver, iterations=iterations)
        touched, within = None if correction is None else corrected, None if progress is None else _Within(progress)
        since, done = time.perf_counter() - begun, len(stages)
        outcome = run(limited, current, image, correction=touched, progress=within, tolerance=tolerance, **begin)
        for stage in outcome.stages:
            stages.append(dataclasses.replace(stage, number=done + stage.number, seconds=since + stage.seconds))
        return outcome.state, outcome.status

    def left() -> int:
        return solver.iterations - len(stages) - int(alone.max())

    side, stages = _side(problem, settings), list[Stage]()
    alone = np.zeros([-(-length // side) for length in problem.data.shape], int)
    # The limits are arguments of their own, as in `run`: other ones compile nothing anew.
    steps, worst = dataclasses.replace(solver, iterations=1, tolerance=0.0), float("nan")
    limit = settings.limit_tolerances * enough
    # No tile's residual is above the whole picture's times the root of their number: few tiles would then be finished,
    # or nearly so.
    above = settings.whole_tolerances * math.sqrt(math.prod(problem.data.shape)) / side > settings.limit_tolerances
    first = settings.whole_tolerances if similar is None else settings.whole_similar_tolerances
    first = first if finished_tiles and above else 1
    state, status = whole(first * enough, left(), similar=similar)
    finite, visits, stale = state, 0, False
    while status is Status.converged:
        gradient, steps_down = _slopes(current, state.image, state.prior, state.step_size)
        slopes = by_tile(np.asarray(steps_down), np.asarray(state.image), side)
        if not np.isfinite(slopes).all():
            state, status = finite, Status.non_finite
            break
        finite = state = _restarted(state, gradient) if stale else state
        active = slopes > limit
        # Neighbours that would soon be moved by them are iterated with them.
        active |= (maximum_filter(active, 3) > 0) & (slopes > settings.finished_share * limit)
        stale = False
        if left() < (2 if active.any() else 1):
            status = Status.iterations_exhausted
            break
        if active.any() and finished_tiles and visits < settings.most_visits:
            most, steep = min(left() - 1, settings.most_iterations), np.where(active, slopes, 0)
            state, took = _on_tiles(steps, current, state, steep, limit, most, settings)
            before, alone = int(alone.max()), alone + took
            visits, stale, worst = visits + 1, True, float("nan")
            if progress is not None:
                progress.advance(int(alone.max()) - before)
            corrected(state.image, enough)
            continue
        if active.any():
            state, ended = whole(0.0, min(left(), CORRECTION_ITERATIONS), state=state)
            status = status if ended.usable else ended
            continue
        if corrected(state.image, enough) is not None:
            stale = True
            continue
        residual = math.inf
        for _ in range(min(left(), CORRECTION_ITERATIONS)):
            following, table, _, finite_step, _ = advance(steps, current, state, np.int32(1), np.float32(0))
            record, change = np.asarray(table)[0], np.asarray(following.image) - np.asarray(state.ahead)
            residuals = by_tile(change, np.asarray(following.image), side)
            if not finite_step:
                status = Status.non_finite
                break
            state, residual, worst = following, float(Record(*record).residual), float(residuals.max())
            stages.append(Stage.of(len(stages) + 1, record, time.perf_counter() - begun))
            if progress is not None:
                progress.advance(1)
            if residual <= enough:
                break
        if status.usable and residual <= enough and worst <= limit:
            if corrected(state.image, enough) is None:
                break
            stale = True
    found = np.array(current.prior.clip(state.image))
    return Outcome(found, tuple(stages), status, state, TileIterations(len(stages), alone, side, worst, limit))


def _restarted(state: ProximalGradientState, gradient: Float[Array, "H W"]) -> ProximalGradientState:
    """The state before the next iteration, without momentum, where ∇f has become another."""
    none, unknown = (on_device(np.asarray(number, state.image.dtype)) for number in (1, np.inf))
    return state._replace(
        gradient=gradient, ahead=state.image, ahead_gradient=gradient, momentum=none, objective=unknown
    )


@eqx.filter_jit
def _slopes(
    problem: Problem, image: Float[Array, "H W"], dual: Any, step_size: Float[Array, "H W"]
) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """∇f, and by how much a step along the slope of F, ∇f + λK*p, would change the picture."""
    assert isinstance(problem.prior, Analysis)  # `is_tileable` saw to it
    gradient = problem.data.gradient(image)
    slope = gradient + problem.strength * problem.prior.adjoint(dual)
    return gradient, step_size * slope


def by_tile(
    change: Float[np.ndarray, "H W"], image: Float[np.ndarray, "H W"], side: int
) -> Float[np.ndarray, "rows columns"]:
    """The root mean square of a change in each tile of side × side pixels, as a share of the picture's; what of a tile
    is outside the picture counts as not changed."""
    squares = np.add.reduceat(np.square(change), np.arange(0, change.shape[0], side), axis=0)
    squares = np.add.reduceat(squares, np.arange(0, change.shape[1], side), axis=1)
    level = max(np.linalg.norm(image) / np.sqrt(image.size), np.finfo(image.dtype).tiny ** 0.5)
    return np.sqrt(squares / side**2) / level


def _on_tiles(
    solver: Solver,
    problem: Problem,
    state: ProximalGradientState,
    slopes: Float[np.ndarray, "rows columns"],
    limit: float,
    most: int,
    settings: TileSettings,
) -> tuple[ProximalGradientState, Int[np.ndarray, "rows columns"]]:
    """Iterations of the tiles that have slopes, up to `most` of each: the state, of which picture and dual variables
    are up to date, and how many."""
    # Steepest first, so that those that need about the same number of iterations are in one batch.
    size, enough = settings.batch, settings.finished_share * limit
    order = np.argsort(-slopes, axis=None, kind="stable")[: np.count_nonzero(slopes)]
    tiles = np.stack(np.unravel_index(order, slopes.shape), axis=1)
    colour = tiles[:, 0] % 2 * 2 + tiles[:, 1] % 2
    # Padded to one length, with tiles outside the picture, for which nothing is done.
    batches, filled = np.full((-(-slopes.size // size) + 4, size, 2), -1, np.int32), 0
    for own in (tiles[colour == number] for number in range(4)):
        needed = -(-len(own) // size)
        batches[filled : filled + needed].reshape(-1, 2)[: len(own)] = own
        filled += needed
    image, prior, took = _batches(
        solver, problem, state, batches, np.int32(filled), np.float32(enough), np.int32(most), settings
    )
    iterations, used = np.zeros(slopes.shape, int), batches[..., 0] >= 0
    iterations[tuple(batches[used].T)] = np.asarray(took)[used]
    return state._replace(image=image, prior=prior), iterations


@eqx.filter_jit
def _batches(
    solver: Solver,
    problem: Problem,
    state: ProximalGradientState,
    batches: Int[Array | np.ndarray, "batches n 2"],
    filled: Int[Array | np.int32, ""],
    enough: Float[Array | np.float32, ""],
    most: Int[Array | np.int32, ""],
    settings: TileSettings,
) -> tuple[Float[Array, "H W"], Any, Int[Array, "batches n"]]:
    """Batch after batch, iterations of tiles that do not touch until the residual of each is `enough`: the picture, the
    prior's state, and how many."""
    scale, shape = problem.data.aperture.scale, problem.data.shape
    side, window = settings.side_px * scale, _window(scale, settings)
    level = _level(state.image)

    def cut(tree: Any, corner: Int[Array, "2"]) -> Any:
        """The window of all pictures in a tree."""

        def leaf(field: Any) -> Any:
            if not eqx.is_array(field) or field.shape[-2:] != shape:
                return field
            stack = field.shape[:-2]
            return jax.lax.dynamic_slice(field, (0,) * len(stack) + (corner[0], corner[1]), (*stack, window, window))

        return jax.tree.map(leaf, tree)

    def solved(image: Float[Array, "H W"], dual: Any, tiles: Int[Array, "n 2"]) -> tuple[Any, ...]:
        """Picture and dual variable after the iterations of a batch, and how many."""

        def opened(tile: Int[Array, "2"]) -> tuple[Any, ...]:
            corner = jnp.clip(tile * side - scale, 0, jnp.array(shape) - window)
            part = cut(problem, corner)
            part = eqx.tree_at(lambda part: part.data.aperture, part, Aperture((window, window), scale))
            rows, columns = ((corner[axis] + jnp.arange(window)) // side == tile[axis] for axis in (0, 1))
            own = rows[:, None] & columns[None]
            begun = solver.init(part, cut(image, corner))
            # Steps of the picture's own length, which its limit is meant for.
            step_size = jnp.where(own, cut(state.step_size, corner), 0)
            begun = begun._replace(prior=cut(dual, corner), step_size=step_size)
            return part, begun, own, corner

        parts, states, own, corners = eqx.filter_vmap(opened)(tiles)
        step = eqx.filter_vmap(lambda part, state: solver.step(part, state)[0])

        def one(carry: Any) -> Any:
            before, done, finished, took = carry
            after = step(parts, before)
            change = jnp.sqrt(jnp.sum((after.image - before.ahead) ** 2, (1, 2)) / side**2)
            return after, done + 1, finished | (change <= enough * level), jnp.where(finished, took, took + 1)

        nothing = jnp.zeros(tiles.shape[0], jnp.int32)
        begin = states, jnp.zeros((), jnp.int32), tiles[:, 0] < 0, nothing
        states, _, _, took = jax.lax.while_loop(lambda carry: (carry[1] < most) & ~jnp.all(carry[2]), one, begin)

        def put(field: Array, windows: Array, which: Array) -> Array:
            for number in range(tiles.shape[0]):
                new = jnp.where(which[number], windows[number], cut(field, corners[number]))
                field = jax.lax.dynamic_update_slice(field, new, tuple(corners[number]))
            return field

        # The dual variable of a difference is kept at the first of its two pixels.
        above = jnp.pad(own[:, 1:], ((0, 0), (0, 1), (0, 0)))
        edges = own | above | jnp.pad(own[:, :, 1:], ((0, 0), (0, 0), (0, 1)))
        dual = jax.tree.map(lambda field, windows: put(field, windows, edges), dual, states.prior)
        return put(image, states.image, own), dual, took

    def batch(number: Array, carry: Any) -> Any:
        image, dual, took = carry
        image, dual, own = solved(image, dual, jnp.asarray(batches)[number])
        return image, dual, took.at[number].set(own)

    begin = state.image, state.prior, jnp.zeros(batches.shape[:2], jnp.int32)
    return jax.lax.fori_loop(0, filled, batch, begin)


def _side(problem: Problem, settings: TileSettings) -> int:
    """Side of a tile, pixels of the picture."""
    return settings.side_px * problem.data.aperture.scale


def _window(scale: int, settings: TileSettings) -> int:
    """Side of a window, pixels: f at a pixel depends on pixels less than s + 1 away, as BᵀMB couples no others."""
    return (settings.side_px + 2) * scale


def _level(image: Float[Array, "H W"]) -> Float[Array, ""]:
    """The root mean square, and no less than what can be divided by."""
    return jnp.maximum(jnp.sqrt(jnp.mean(image**2)), jnp.finfo(image.dtype).tiny ** 0.5)
