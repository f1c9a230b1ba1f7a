"""The outer loop of a reconstruction, where the true data term is not the quadratic that the solvers take.

Each round puts a quadratic on or above the true data term that touches it near the picture so far, and solves
(majorise–minimise). Two things ask for that: exposures during which the picture moves (`with_exposure`; with momentum),
and a robust loss (`robust_factors`). Where there is neither, one round is all.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt.errors import InputError
from scsr_opt.operators.operator import LinearOperator
from scsr_opt.operators.robust import Loss, robust_factors
from scsr_opt.operators.sampling import DataTerm, PlacedSamples, accumulate, with_exposure
from scsr_opt.priors.prior import Prior
from scsr_opt.progress import Progress
from scsr_opt.solvers.iterate import Outcome, Solver, run
from scsr_opt.solvers.problem import Problem, with_bound
from scsr_opt.solvers.solution import Stage

# Rounds after the first solve, at most. By day three do, in dim light, where exposures are long, up to ten.
CORRECTIONS = 10
# What is corrected next need not be solved to the end; one that changed the picture by less than so many tolerances is
# followed by the last one.
_LOOSE, _SETTLED = 5.0, 10.0


class Found(NamedTuple):
    """What the rounds end with: the last solve's outcome, with the stages of all, and B X of its picture."""

    outcome: Outcome
    blurred: Float[Array, "rows columns"]


@dataclass(frozen=True)
class Rounds:
    """minimise over X of ½ Σ_j ω_j ρ(r_j·B X − Y_j) + λ Ψ(X), r_j along the exposure, by rounds of `solver`.

    **Fields:** `solver`; `prior` Ψ; `strength` λ; `optics`, the lens in B; `robust` ρ, the square if None; `progress`,
    `keep_images` as of `run`.
    """

    solver: Solver
    prior: Prior
    strength: Float[Array, ""]
    optics: LinearOperator | None
    robust: Loss | None
    progress: Progress | None
    keep_images: bool

    def __call__(
        self,
        placed: PlacedSamples,
        image: Float[Array, "H W"],
        state: Any = None,
        *,
        near: Float[Array, "H W"] | None = None,
    ) -> Found:
        """Solves from the picture `image`, or from one that is known to be `near` the solution, or goes on from the
        `state` of a solve of something similar.

        **Raises:** `InputError` for a state that does not fit, or a prior that the solver cannot use.
        """
        plain = term = with_bound(accumulate(placed, optics=self.optics))
        rounds = 1 + (CORRECTIONS if placed.finest > 1 or self.robust is not None else 0)
        if state is not None:
            self._check(state, Problem(term, self.prior, self.strength), image)
            near = self.solver.image(state)
        elif near is not None:
            image = near
        if near is not None:
            term, rounds = self._corrected(plain, placed, near), max(rounds - 1, 1)
        stages: list[Stage] = []
        before, momentum, settled = near, 1.0, False
        for following in reversed(range(rounds)):
            last = settled or not following
            outcome = run(
                self.solver,
                Problem(term, self.prior, self.strength),
                image,
                similar=state,
                progress=self.progress,
                keep_images=self.keep_images,
                tolerance=self.solver.tolerance * (1 if last else _LOOSE),
            )
            stages += [replace(stage, number=len(stages) + n) for n, stage in enumerate(outcome.stages, 1)]
            if last or not outcome.result.good:
                break
            state, found = outcome.state, jnp.asarray(outcome.image)
            touch = found
            if before is not None:
                step = found - before
                settled = bool(jnp.linalg.norm(step) <= _SETTLED * self.solver.tolerance * jnp.linalg.norm(found))
                if self.robust is None:
                    # The rounds are proximal-gradient steps in the metric of M, and go faster with FISTA's momentum.
                    following_momentum = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
                    touch = found + (momentum - 1) / following_momentum * step
                    momentum = following_momentum
            before = found
            term = self._corrected(plain, placed, touch)
        return Found(outcome._replace(stages=tuple(stages)), _blurred(plain, jnp.asarray(outcome.image)))

    def _corrected(self, plain: DataTerm, placed: PlacedSamples, image: Float[Array, "H W"]) -> DataTerm:
        """The quadratic that lies on or above the true data term and touches it at `image`."""
        if self.robust is None:
            return plain if placed.finest == 1 else with_exposure(plain, placed, image)
        factors = robust_factors(self.robust, placed, plain.blurred(image))
        plain = with_bound(accumulate(placed, robust=factors, optics=self.optics))
        return plain if placed.finest == 1 else with_exposure(plain, placed, image, robust=factors)

    def _check(self, state: Any, problem: Problem, image: Float[Array, "H W"]) -> None:
        own = eqx.filter_eval_shape(self.solver.init, problem, image)
        if _layout(state) != _layout(own):
            raise InputError(
                f"state is not one that {type(self.solver).__name__} with {type(self.prior).__name__} can go on from "
                f"to a picture of {image.shape}; hand in Solution.state of a solution by the same solver and prior, of "
                f"the same size."
            )


def _layout(state: Any) -> tuple[Any, list[Any]]:
    leaves, structure = jax.tree.flatten(eqx.filter(state, lambda leaf: hasattr(leaf, "shape")))
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


@eqx.filter_jit
def _blurred(term: DataTerm, image: Float[Array, "H W"]) -> Float[Array, "rows columns"]:
    return term.blurred(image)
