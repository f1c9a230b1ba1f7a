"""How a reconstruction is solved, where the true data term is not the quadratic that the solvers take.

A quadratic is put on or above the true data term that touches it near the picture so far, and solved for
(majorise–minimise). Two things ask for that:

- Exposures during which the picture moves (`with_exposure`). Only c and e change then, so that they do on the way,
  while the solver keeps its momentum.
- A robust loss (`robust_factors`). M changes too, and each round is a solve of its own.
"""

import functools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scsr_opt.errors import InputError
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.losses import Loss, robust_factors
from scsr_opt.operators.operator import LinearOperator
from scsr_opt.operators.sampling import PlacedSamples, accumulate
from scsr_opt.priors.prior import Prior
from scsr_opt.progress import Progress
from scsr_opt.solvers.loop import Outcome, Solver, run
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.solution import Stage
from scsr_opt.solvers.stopping import relative
from scsr_opt.solvers.tiles import TILE, by_tile, divides, run_active

# A picture is where the quadratic touches the data term if it is less than so many tolerances away: with a step size
# for each pixel pictures are as good as at 10 with one for all, a correction earlier (docs/measurements.md).
_NEAR = 30.0
# And in each tile if it is less than so many: what is far in one place alone is lost in a whole picture
# (docs/measurements.md).
_NEAR_IN_TILE = 40.0
# The share of the rows of tiles, at most, that work is done in apart from the others.
_FEW_ROWS = 0.5
# How far beyond a picture it is made to touch, in changes of the picture since the last time: the next iterations lead
# there. With all of the change pictures as good took half as much again, or did not come to an end
# (docs/measurements.md).
_AHEAD = 0.7
# Rounds of a robust loss after the first solve, at most. What is weighted anew next need not be solved to the end; one
# that changed the picture by less than so many tolerances is followed by the last one.
ROUNDS = 10
_LOOSE, _SETTLED = 5.0, 10.0


class Found(NamedTuple):
    """What the rounds end with: the last solve's outcome, with the stages of all, and B X of its picture."""

    outcome: Outcome
    blurred: Float[Array, "rows columns"]


@dataclass(frozen=True)
class Rounds:
    """minimise over X of ½ Σ_j ω_j ρ(r_j·B X − Y_j) + λ Ψ(X), r_j along the exposure, by `solver`.

    **Fields:** `solver`; `prior` Ψ; `strength` λ; `optics`, the lens in B; `robust` ρ, the square if None; `progress`,
    `keep_images` as of `run`; `skip`: whether tiles that are finished are left alone, where that can be (`run_active`)
    and not every iteration is to be seen.
    """

    solver: Solver
    prior: Prior
    strength: Float[Array, ""]
    optics: LinearOperator | None
    robust: Loss | None
    progress: Progress | None
    keep_images: bool
    skip: bool = False

    def __call__(
        self,
        placed: PlacedSamples,
        image: Float[Array, "H W"],
        state: Any = None,
        *,
        near: Float[Array, "H W"] | None = None,
        term: DataTerm | None = None,
    ) -> Found:
        """Solves from the picture `image`, or from one that is known to be `near` the solution, or goes on from the
        `state` of a solve of something similar. `term`: what `term` makes of `placed`, where that is done.

        **Raises:** `InputError` for a state that does not fit, or a prior that the solver cannot use.
        """
        term = self.term(placed) if term is None else term
        if state is not None:
            self._check(state, Problem(term, self.prior, self.strength), image)
            near = self.solver.image(state)
        elif near is not None:
            image = near
        if self.robust is None:
            outcome = self._solved(term, placed, image, state, near)
        else:
            outcome = self._reweighted(term, placed, image, state, near, self.robust)
        return Found(outcome, _blurred(term, jnp.asarray(outcome.image)))

    def term(
        self, placed: PlacedSamples, robust: Float[Array, " n"] | None = None, *, sums: DataTerm | None = None
    ) -> DataTerm:
        """The quadratic that a solve begins with, without corrections; `robust`: factors on the weights; `sums`: M, c
        and e with these, where they are known."""
        term = accumulate(placed, robust=robust, optics=self.optics) if sums is None else sums
        return self.solver.prepared(Problem(term, self.prior, self.strength)).data

    def _solved(
        self,
        term: DataTerm,
        placed: PlacedSamples,
        image: Float[Array, "H W"],
        state: Any,
        near: Float[Array, "H W"] | None,
        *,
        robust: Float[Array, " n"] | None = None,
        tolerances: float = 1.0,
    ) -> Outcome:
        """Solves, with corrections for exposures; `robust`: factors on the weights, which are in `term` already."""
        tolerance = tolerances * self.solver.tolerance
        problem, exposures = Problem(term, self.prior, self.strength), None
        by_tiles = not self.keep_images and divides(self.solver, problem)
        if placed.finest > 1:
            exposures = _Exposures(problem, placed, robust, tiles=by_tiles, skip=self.skip)
            problem = problem if near is None else exposures.touching(near)
        given: dict[str, Any] = {"similar": state, "correction": exposures, "progress": self.progress}
        if by_tiles:
            return run_active(self.solver, problem, image, **given, tolerance=tolerance, skip=self.skip)
        return run(self.solver, problem, image, **given, keep_images=self.keep_images, tolerance=tolerance)

    def _reweighted(
        self,
        term: DataTerm,
        placed: PlacedSamples,
        image: Float[Array, "H W"],
        state: Any,
        near: Float[Array, "H W"] | None,
        loss: Loss,
    ) -> Outcome:
        """Solves by rounds, each with weights from the picture of the one before."""
        stages: list[Stage] = []
        settled, factors = False, None
        for following in reversed(range(ROUNDS + (near is None))):
            last = settled or not following
            if near is not None:
                factors = robust_factors(loss, placed, _blurred(term, near))
                term = self.term(placed, factors)
            outcome = self._solved(term, placed, image, state, near, robust=factors, tolerances=1.0 if last else _LOOSE)
            stages += [replace(stage, number=len(stages) + n) for n, stage in enumerate(outcome.stages, 1)]
            if last or not outcome.result.good:
                break
            before, state, near = near, outcome.state, jnp.asarray(outcome.image)
            settled = before is not None and float(_away(near, before)) <= _SETTLED * self.solver.tolerance
        return outcome._replace(stages=tuple(stages))

    def _check(self, state: Any, problem: Problem, image: Float[Array, "H W"]) -> None:
        own = eqx.filter_eval_shape(self.solver.init, problem, image)
        kept = self.solver.kept
        if not isinstance(state, self.solver.state_type) or _layout(kept(state)) != _layout(kept(own)):
            raise InputError(
                f"state is not one that {type(self.solver).__name__} with {type(self.prior).__name__} can go on from "
                f"to a picture of {image.shape}; hand in Solution.state of a solution by the same solver and prior, of "
                f"the same size."
            )


class _Exposures:
    """Corrections of c for the motion during exposures: wherever a picture is not near, by the tolerance, to where the
    quadratic of the `problem` touches the true data term, another quadratic is made to. Of `tiles` each is asked, and
    if work is to be skipped, it is done in those that are far alone."""

    def __init__(
        self, problem: Problem, placed: PlacedSamples, robust: Float[Array, " n"] | None, *, tiles: bool, skip: bool
    ):
        self._problem, self._placed, self._robust, self._tiles, self._skip = problem, placed, robust, tiles, skip
        self._corrected = problem
        self._touched: Float[Array, "H W"] | None = None
        self._last: Float[Array, "H W"] | None = None

    def __call__(self, image: Float[Array, "H W"], tolerance: float) -> Problem | None:
        far = None
        if self._touched is not None and float(_away(image, self._touched)) <= _NEAR * tolerance:
            if not self._tiles:
                return None
            away = np.asarray(_away_in_tiles(image, self._touched, TILE * self._placed.scale))
            if away.max() <= _NEAR_IN_TILE * tolerance:
                return None
            # With what would be next.
            far = away > _NEAR_IN_TILE / 2 * tolerance
        ahead = image if self._last is None else image + _AHEAD * (image - self._last)
        self._last = image
        # Pieces are told apart by rows: where tiles in most of these are far, hardly any would be left out.
        if far is None or not self._skip or far.any(1).mean() > _FEW_ROWS:
            return self.touching(ahead)
        return self._touching_in(far, ahead)

    def touching(self, image: Float[Array, "H W"]) -> Problem:
        """The problem with the quadratic that touches the true data term at `image`."""
        if self._last is None:
            self._last = image
        return self._following(image, with_exposure(self._problem.data, self._placed, image, robust=self._robust))

    def _touching_in(self, tiles: Bool[np.ndarray, "rows columns"], image: Float[Array, "H W"]) -> Problem:
        """The same at `image` in these tiles, and elsewhere where it did."""
        assert self._touched is not None
        side = TILE * self._placed.scale
        image = _only_in(tiles, image, self._touched, side)
        # What is read from there: the blur reaches s − 1 rows on, and a place is read from two rows.
        first, last = self._rows
        row = np.arange(len(tiles))[tiles.any(1), None] * side
        seen = ((first < row + side) & (last > row - self._placed.scale - 1)).any(0)
        since = self._corrected.data, self._touched, seen
        data = with_exposure(self._problem.data, self._placed, image, robust=self._robust, since=since)
        return self._following(image, data)

    def _following(self, image: Float[Array, "H W"], data: DataTerm) -> Problem:
        self._touched = image
        self._corrected = eqx.tree_at(lambda problem: problem.data, self._problem, data)
        return self._corrected

    @functools.cached_property
    def _rows(self) -> Int[np.ndarray, "2 pieces"]:
        return np.asarray(self._placed.rows())


@jax.jit
def _away(image: Float[Array, "H W"], other: Float[Array, "H W"]) -> Float[Array, ""]:
    """‖image − other‖ / ‖image‖."""
    return relative(jnp.linalg.norm(image - other), image)


@eqx.filter_jit
def _away_in_tiles(image: Float[Array, "H W"], other: Float[Array, "H W"], side: int) -> Float[Array, "rows columns"]:
    """The same of each tile."""
    return by_tile(image - other, image, side)


@eqx.filter_jit
def _only_in(
    tiles: Bool[Array | np.ndarray, "rows columns"], image: Float[Array, "H W"], other: Float[Array, "H W"], side: int
) -> Float[Array, "H W"]:
    """`image` in these tiles, and `other` elsewhere."""
    height, width = image.shape
    there = jnp.repeat(jnp.repeat(jnp.asarray(tiles), side, axis=0), side, axis=1)[:height, :width]
    return jnp.where(there, image, other)


def _layout(state: Any) -> tuple[Any, list[Any]]:
    leaves, structure = jax.tree.flatten(eqx.filter(state, lambda leaf: hasattr(leaf, "shape")))
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


@eqx.filter_jit
def _blurred(term: DataTerm, image: Float[Array, "H W"]) -> Float[Array, "rows columns"]:
    return term.blurred(image)
