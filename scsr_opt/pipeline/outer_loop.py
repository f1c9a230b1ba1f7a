"""Majorise-minimise: solves of a quadratic, where the true data term is not the quadratic that the solvers take.

A quadratic that lies on or above the true data term, and touches it at the picture so far, is solved for instead. Two
things ask for that:

- Exposures during which the picture moves (`with_exposure`). They change c and e alone, so that the quadratic is
  renewed during a solve, and the solver keeps its momentum.
- A robust loss (`robust_factors`). It changes M too, so that each renewal is followed by a solve of its own.
"""

import functools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scsr_opt._kernels.device import on_device
from scsr_opt.errors import InputError
from scsr_opt.operators.data_term import DataTerm, blurred
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.losses import Loss, robust_factors
from scsr_opt.operators.operator import LinearOperator
from scsr_opt.operators.sampling import PlacedSamples, accumulate
from scsr_opt.pipeline.settings import OuterLoopSettings
from scsr_opt.priors.prior import Prior
from scsr_opt.progress import Progress
from scsr_opt.solvers.loop import Outcome, run
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.record import Stage
from scsr_opt.solvers.settings import TileSettings
from scsr_opt.solvers.solver import Solver
from scsr_opt.solvers.tiles import by_tile, is_tileable, run_tiles


class Majorized(NamedTuple):
    """Outcome of the last solve, with the stages of all of them, and B X of its picture."""

    outcome: Outcome
    blurred: Float[Array, "rows columns"]


@dataclass(frozen=True)
class MajorizeMinimize:
    """minimise over X of ½ Σ_j ω_j ρ(r_j·B X − Y_j) + λ Ψ(X), r_j along the exposure, by `solver`.

    **Fields:** `solver`; `prior` Ψ; `strength` λ; `optics`, the lens in B; `robust` ρ, the square if None;
    `keep_images`, `progress` as of `run`; `finished_tiles`: whether tiles that are finished are not iterated further
    (`run_tiles`), where that is possible and no picture of each iteration is wanted; `settings`, `tile_settings`: when
    exposures are corrected and samples reweighted, and when tiles are iterated.
    """

    solver: Solver
    prior: Prior
    strength: Float[Array, ""]
    optics: LinearOperator | None
    robust: Loss | None
    keep_images: bool = False
    finished_tiles: bool = False
    settings: OuterLoopSettings = OuterLoopSettings()
    tile_settings: TileSettings = TileSettings()
    progress: Progress | None = None

    def __call__(
        self,
        placed: PlacedSamples,
        image: Float[Array, "H W"],
        state: Any = None,
        *,
        near: Float[Array, "H W"] | None = None,
        term: DataTerm | None = None,
    ) -> Majorized:
        """Solves from the picture `image`, from one that is known to be `near` the solution, or from the `state` of a
        similar problem. `term`: M, c and e of the samples (`MajorizeMinimize.term`), where they are summed already.

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
        return Majorized(outcome, blurred(term, on_device(outcome.image)))

    def term(
        self, placed: PlacedSamples, robust: Float[Array, " n"] | None = None, *, sums: DataTerm | None = None
    ) -> DataTerm:
        """M, c and e of the samples, without corrections for exposures, with the bounds that the solver needs.

        `robust`: (n,), factors on the weights. `sums`: M, c and e, where they are summed already.
        """
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
        """Solves with corrections for exposures; `robust`: factors on the weights, which `term` contains already."""
        tolerance = tolerances * self.solver.tolerance
        problem, exposures = Problem(term, self.prior, self.strength), None
        by_tiles = not self.keep_images and is_tileable(self.solver, problem, self.tile_settings)
        if placed.finest > 1:
            side = self.tile_settings.side_px if by_tiles else None
            exposures = ExposureCorrection(
                problem, placed, robust, tile_px=side, finished_tiles=self.finished_tiles, settings=self.settings
            )
            problem = problem if near is None else exposures.touching(near)
        common: dict[str, Any] = {"similar": state, "correction": exposures, "progress": self.progress}
        if by_tiles:
            common |= {"finished_tiles": self.finished_tiles, "settings": self.tile_settings}
            return run_tiles(self.solver, problem, image, **common, tolerance=tolerance)
        return run(self.solver, problem, image, **common, keep_images=self.keep_images, tolerance=tolerance)

    def _reweighted(
        self,
        term: DataTerm,
        placed: PlacedSamples,
        image: Float[Array, "H W"],
        state: Any,
        near: Float[Array, "H W"] | None,
        loss: Loss,
    ) -> Outcome:
        """Solves round by round, each with weights from the picture of the round before."""
        stages: list[Stage] = []
        settled, factors = False, None
        for remaining in reversed(range(self.settings.reweighting_rounds + (near is None))):
            last = settled or remaining == 0
            if near is not None:
                factors = robust_factors(loss, placed, blurred(term, near))
                term = self.term(placed, factors)
            tolerances = 1.0 if last else self.settings.reweighting_tolerances
            outcome = self._solved(term, placed, image, state, near, robust=factors, tolerances=tolerances)
            stages += [replace(stage, number=len(stages) + n) for n, stage in enumerate(outcome.stages, 1)]
            if last or not outcome.status.usable:
                break
            before, state, near = near, outcome.state, on_device(outcome.image)
            limit = self.settings.reweighting_settled_tolerances * self.solver.tolerance
            settled = before is not None and _relative(outcome.image - np.asarray(before), outcome.image) <= limit
        return outcome._replace(stages=tuple(stages))

    def _check(self, state: Any, problem: Problem, image: Float[Array, "H W"]) -> None:
        own = eqx.filter_eval_shape(self.solver.init, problem, image)
        kept = self.solver.kept
        if not isinstance(state, self.solver.state_type) or _layout(kept(state)) != _layout(kept(own)):
            raise InputError(
                f"state does not fit: {type(self.solver).__name__} with {type(self.prior).__name__} cannot start a "
                f"picture of {image.shape} from it; give Solution.state of a solution by the same solver and prior, of "
                f"the same size."
            )


class ExposureCorrection:
    """Corrections of c and e for the motion during exposures, called with the picture during a solve: where it is far
    from where the quadratic of `problem` touches the true data term, a quadratic that touches there takes its place.

    `tile_px`: side, sensor pixels, of the tiles in which the distance is measured, too; None for the whole picture
    alone. `finished_tiles`: whether tiles that are near keep their correction (`Shortcuts`).
    """

    def __init__(
        self,
        problem: Problem,
        placed: PlacedSamples,
        robust: Float[Array, " n"] | None,
        *,
        tile_px: int | None,
        finished_tiles: bool,
        settings: OuterLoopSettings = OuterLoopSettings(),
    ):
        self._problem, self._placed, self._robust = problem, placed, robust
        self._tile, self._finished_tiles, self._settings = (tile_px or 0) * placed.scale, finished_tiles, settings
        self._corrected = problem
        self._touched: Float[Array, "H W"] | None = None
        self._last: Float[Array, "H W"] | None = None

    def __call__(self, image: Float[Array, "H W"], tolerance: float) -> Problem | None:
        far, now = None, np.asarray(image)
        change = None if self._touched is None else now - np.asarray(self._touched)
        if change is not None and _relative(change, now) <= self._settings.correction_tolerances * tolerance:
            if not self._tile:
                return None
            distance = by_tile(change, now, self._tile)
            if distance.max() <= self._settings.tile_correction_tolerances * tolerance:
                return None
            # Tiles half as far off would be next.
            far = distance > self._settings.tile_correction_tolerances / 2 * tolerance
        ahead = image
        if self._last is not None:
            further = now - np.asarray(self._last)
            further *= np.float32(self._settings.correction_extrapolation)
            ahead = on_device(further + now)
        self._last = image
        # Pieces of samples are chosen by rows: where most rows have a tile that is far off, hardly any is left out.
        if far is None or not self._finished_tiles or far.any(1).mean() > self._settings.few_rows_share:
            return self.touching(ahead)
        return self._touching_in(far, ahead)

    def touching(self, image: Float[Array, "H W"]) -> Problem:
        """The problem with the quadratic that touches the true data term at `image`."""
        if self._last is None:
            self._last = image
        return self._following(image, with_exposure(self._problem.data, self._placed, image, robust=self._robust))

    def _touching_in(self, tiles: Bool[np.ndarray, "rows columns"], image: Float[Array, "H W"]) -> Problem:
        """The problem with the quadratic that touches at `image` in these tiles, and elsewhere where it did before."""
        assert self._touched is not None
        side = self._tile
        image = _only_in(tiles, image, self._touched, side)
        # Rows that samples of these tiles are read from: the blur reaches s − 1 rows on, a position reads two rows.
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


def _relative(change: Float[np.ndarray, "H W"], image: Float[np.ndarray, "H W"]) -> float:
    """‖change‖ / ‖image‖."""
    return float(np.linalg.norm(change) / max(np.linalg.norm(image), np.finfo(image.dtype).tiny ** 0.5))


def _only_in(
    tiles: Bool[np.ndarray, "rows columns"], image: Float[Array, "H W"], other: Float[Array, "H W"], side: int
) -> Float[Array, "H W"]:
    """`image` in these tiles, and `other` elsewhere."""
    height, width = image.shape
    there = tiles.repeat(side, axis=0).repeat(side, axis=1)[:height, :width]
    return on_device(np.where(there, np.asarray(image), np.asarray(other)))


def _layout(state: Any) -> tuple[Any, list[Any]]:
    leaves, structure = jax.tree.flatten(eqx.filter(state, lambda leaf: hasattr(leaf, "shape")))
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]
