"""What every solver and every unrolled network returns: `Solution`, with one `Stage` per iteration."""

import copy
import enum
import functools
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, SupportsFloat

import numpy as np
from jaxtyping import Float, Int

from scsr_opt.motion.trajectory import Motion
from scsr_opt.skip import Plan


class Result(enum.Enum):
    """How a solve ended; the value is the sentence to show."""

    converged = "The picture meets the tolerance."
    iterations_exhausted = (
        "The iterations were used up before the tolerance was met; the picture is usable, more iterations would refine "
        "it."
    )
    non_finite = "A value that is not finite appeared; the last finite picture is returned and should not be trusted."
    no_samples = (
        "The recording holds no usable sample (no pixel fired, all are marked bad, or what they saw has left the "
        "picture), so the picture carries no information."
    )

    @property
    def sentence(self) -> str:
        return self.value

    @property
    def good(self) -> bool:
        """Whether the picture may be used."""
        return self in (Result.converged, Result.iterations_exhausted)


@dataclass(frozen=True)
class Stage:
    """One iteration t of Eq. 5, or one stage of an unrolled network.

    **Fields:**
    - `number`: t, counted from 1.
    - `objective`, `data`, `prior`: Eq. 4 divided by two at X^(t), its data part and λΨ; `objective = data + prior`.
    - `residual`: relative optimality, ‖X^(t) − A‖ / ‖X^(t)‖, A the point that the iteration started from, so that
      X^(t) = prox(A − β∇f(A)); 0 at the minimiser. As such a step brings no two points further apart, one more from
      X^(t) changes it by no more than this. Where each pixel has its own β, differences count times the shortest β over
      it: the same slope as much everywhere. Methods that split the problem record an upper bound on ‖X^(t) − G(X^(t))‖
      / ‖X^(t)‖, G such a step (`scsr_opt.solvers.stopping`).
    - `step_size`: β, the shortest where each pixel has its own.
    - `seconds`: since the solve began, at the end of the chunk that this stage belongs to; NaN where not measured.
    - `gap`: duality gap over the objective, how far the objective is above its minimum at most, relative; NaN where it
      is not measured.
    - `gradient_step`, `image`: R^(t) and X^(t), kept only when asked for (they are large).
    """

    number: int
    objective: float
    data: float
    prior: float
    residual: float
    step_size: float
    seconds: float = float("nan")
    gradient_step: Float[np.ndarray, "H W"] | None = None
    image: Float[np.ndarray, "H W"] | None = None
    gap: float = float("nan")

    @classmethod
    def of(cls, number: int, record: Iterable[SupportsFloat], seconds: float, **pictures: Any) -> "Stage":
        """Of the numbers of a `scsr_opt.solvers.Record`."""
        data, prior, residual, gap, step_size = map(float, record)
        gap = float("nan") if gap < 0 else gap  # `scsr_opt.solvers.stopping.UNMEASURED`
        return cls(number, data + prior, data, prior, residual, step_size, seconds, **pictures, gap=gap)


@dataclass(frozen=True)
class Active:
    """What an active set did (`scsr_opt.solvers.run_active`), in the last solve where there were several.

    **Fields:** `whole`: iterations of the whole picture; `alone` (rows, columns): of each tile alone, until it was
    finished (it is iterated on as long as those side by side with it are not); `tile`: its side, pixels of the picture;
    `worst`: the most that one more iteration changes a tile, root mean square as a share of the picture's, NaN where
    the solve ended before that was asked; `limit`: what that may be.
    """

    whole: int
    alone: Int[np.ndarray, "rows columns"]
    tile: int
    worst: float
    limit: float

    @property
    def numbers(self) -> dict[str, Any]:
        """For a report: how many tiles, how many were gone on with, and for how long at most; `worst` and `limit`."""
        return {
            "tiles": self.alone.size,
            "gone_on_with": int(np.count_nonzero(self.alone)),
            "most_iterations": self.whole + int(self.alone.max()),
            "worst": self.worst if np.isfinite(self.worst) else None,
            "limit": self.limit,
        }

    def lines(self) -> list[str]:
        """What was left alone and how far that was safe, for people."""
        gone_on, of = np.count_nonzero(self.alone), self.alone.size
        text = [f"Iterations: {self.whole} of the whole picture"]
        if gone_on:
            longest = int(self.alone.max())
            text[0] += f"; {gone_on} of its {of} tiles were gone on with, up to {longest} more, the others left alone"
        if np.isfinite(self.worst):
            text.append(
                f"One more would change no tile by more than {100 * self.worst:.1g} % of the picture's level "
                f"(asked: {100 * self.limit:.1g} %)"
            )
        return [f"{line}." for line in text]


@dataclass
class Solution:
    """A reconstruction. Its arrays are the caller's own: `solution.image *= 255` is fine.

    **Fields:**
    - `image`: (H, W) float32, intensity, 1 = white, linear.
    - `stages`: one record per iteration.
    - `result`: how it ended.
    - `stats`: plain numbers worth reporting (iterations, strength, samples, seconds by part, …), ready for JSON.
    - `motion`: the motion that was used; None where there was none to use.
    - `state`: what is needed to go on from here (warm start).
    - `plan`: what each part of the scene asked for (`scsr_opt.skip.Plan`); None where nothing was skipped.
    - `gain`: (h, w), of each sensor pixel, as handed in or found (`scsr_opt.reconstruct`); None where it is 1.
    - `active`: how long each tile was iterated for in the last solve; None where tiles were not asked.
    """

    image: Float[np.ndarray, "H W"]
    stages: tuple[Stage, ...]
    result: Result
    stats: dict[str, Any] = field(default_factory=dict)
    motion: Motion | None = None
    state: Any = None
    plan: Plan | None = None
    gain: Float[np.ndarray, "h w"] | None = None
    active: Active | None = None

    def handed_out(self) -> "Solution":
        """The solution with arrays and numbers of its own that may be written to: those that it was made with are views
        of JAX's, or are needed for the next picture. The stages, whose pictures nobody else has, and the state, whose
        arrays nobody can write to, are the same."""
        return copy.deepcopy(self, {id(part): part for part in (self.stages, self.state)})

    @functools.cached_property  # and not a property, which could not be multiplied in place
    def velocity(self) -> Float[np.ndarray, "2 h w"] | None:
        """Of the motion, float32, sensor pixels per frame ([0] rows, [1] columns)."""
        return None if self.motion is None else self.motion.velocity

    @functools.cached_property
    def confidence(self) -> Float[np.ndarray, "h w"] | None:
        """In [0, 1], how far that velocity can be trusted."""
        return None if self.motion is None else self.motion.confidence
