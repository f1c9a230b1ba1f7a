"""Records of solvers and unrolled networks: `Status`, how a solve ended, and one `Stage` for each iteration."""

import enum
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, SupportsFloat

import numpy as np
from jaxtyping import Float, Int


class Status(enum.Enum):
    """End of a solve; the value is the message to show."""

    converged = "The picture meets the tolerance."
    iterations_exhausted = (
        "The iterations were used up before the tolerance was met; the picture is usable, more iterations would refine "
        "it."
    )
    stages_done = "All stages of the network were run; a network has no tolerance to meet."
    non_finite = (
        "A value that is not finite appeared, in the measurements, the prior or its proximal step; the last finite "
        "picture is returned and should not be trusted."
    )
    no_samples = (
        "The recording holds no usable sample (no pixel fired, all are marked bad, or what they saw has left the "
        "picture), so the picture carries no information."
    )

    @property
    def message(self) -> str:
        """A sentence for people."""
        return self.value

    @property
    def clause(self) -> str:
        """The message as the end of another sentence: without its capital and its full stop."""
        return self.value[0].lower() + self.value[1:-1]

    @property
    def usable(self) -> bool:
        """True where the picture may be used."""
        return self not in (Status.non_finite, Status.no_samples)


@dataclass(frozen=True)
class Stage:
    """One iteration t of Eq. 5, or one stage of an unrolled network.

    **Fields:**
    - `number`: t, counted from 1.
    - `objective`, `data`, `prior`: Eq. 4 divided by two at X^(t), its data part and λΨ; `objective = data + prior`.
    - `residual`: ‖X^(t) − A‖ / ‖X^(t)‖, with A the point from which the iteration made its step X^(t) = prox(A −
      β∇f(A)); 0 at the minimiser. Such a step brings no two points further apart, so one more step from X^(t) changes
      the picture by no more than this. If each pixel has its own β, its difference is multiplied by the shortest β over
      its own, so that the same slope gives the same residual. Methods that split the problem record an upper bound on
      ‖X^(t) − G(X^(t))‖ / ‖X^(t)‖, with G such a step (`scsr_opt.solvers.stopping`).
    - `step_size`: β, the shortest where each pixel has its own.
    - `seconds`: since the solve began, at the end of the chunk that this stage belongs to; NaN where not measured.
    - `gap`: duality gap over the objective, a bound on the relative distance of the objective from its minimum; NaN
      where it is not measured.
    - `gradient_step`, `image`: R^(t) and X^(t); None unless `Options.keep_images`, as they are large.
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
        """The stage with the numbers of a `scsr_opt.solvers.Record`."""
        data, prior, residual, gap, step_size = map(float, record)
        gap = float("nan") if gap < 0 else gap  # `scsr_opt.solvers.stopping.UNMEASURED`
        return cls(number, data + prior, data, prior, residual, step_size, seconds, **pictures, gap=gap)


@dataclass(frozen=True)
class TileIterations:
    """Iterations that the tiles of a picture took, in the last solve where there were several (`run_tiles`).

    **Fields:**
    - `global_iterations`: iterations of the whole picture.
    - `tile_iterations`: (rows, columns), further iterations of each tile, its surroundings held. A tile is iterated
      for as long as the others of its batch.
    - `tile_side`: pixels of the picture.
    - `largest_change`: the most that one more iteration changes a tile, root mean square as a share of the picture's;
      NaN where the solve ended before that was measured.
    - `change_limit`: the limit of it.
    """

    global_iterations: int
    tile_iterations: Int[np.ndarray, "rows columns"]
    tile_side: int
    largest_change: float
    change_limit: float

    @property
    def numbers(self) -> dict[str, Any]:
        """Numbers for a report: tiles, tiles iterated further, the most iterations of any, `largest_change`, limit."""
        return {
            "tiles": self.tile_iterations.size,
            "tiles_iterated_further": int(np.count_nonzero(self.tile_iterations)),
            "most_iterations": self.global_iterations + int(self.tile_iterations.max()),
            "largest_change": self.largest_change if np.isfinite(self.largest_change) else None,
            "change_limit": self.change_limit,
        }

    def lines(self) -> list[str]:
        """Sentences for people: how many tiles were iterated further, and how near all are to their end."""
        further, of = np.count_nonzero(self.tile_iterations), self.tile_iterations.size
        text = [f"Iterations: {self.global_iterations} of the whole picture"]
        if further:
            most = int(self.tile_iterations.max())
            text[0] += (
                f", then up to {most} more on {further} of its {of} squares of {self.tile_side}x{self.tile_side} "
                f"pixels; the others had converged"
            )
        if np.isfinite(self.largest_change):
            text.append(
                f"One more iteration would change no square by more than {100 * self.largest_change:.1g} % of the "
                f"picture's root mean square (limit: {100 * self.change_limit:.1g} %)"
            )
        return [f"{line}." for line in text]
