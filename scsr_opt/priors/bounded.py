"""A prior and the range that intensities can have."""

import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from scsr_opt._kernels.programs import compiled
from scsr_opt._validation import iteration_count
from scsr_opt.errors import InputError, shown
from scsr_opt.priors.analysis import Analysis
from scsr_opt.priors.prior import Prior


class BoundedState(NamedTuple):
    """`prior`: the state of the prior itself. `excess`: what the bounds hold back, the dual variable of the bounds."""

    prior: Any
    excess: Float[Array, "H W"]


class Bounded(Prior[BoundedState]):
    """Ψ(X) where lower ≤ X(p) ≤ upper at every pixel p, and +∞ elsewhere: box constraint or non-negativity with any
    prior.

    Intensity is not negative, and where white is known it does not exceed it: worth having where the data hold little
    (dark regions, few spikes), or where what uses the picture needs a range.

    The result of `prox` is always within the bounds, and so is the picture that a solver ends with. How exact `prox` is
    otherwise:
    - For an `Analysis` prior the bounds take part in each of its dual steps, X = clip(f − λK*p) (Beck and Teboulle,
      2009, "Fast gradient-based algorithms for constrained total variation image denoising and deblurring"): as exact
      as without bounds, at the same cost.
    - For any other prior Dykstra's algorithm alternates its proximal step with clipping, `rounds` times (Bauschke and
      Combettes, 2008, "A Dykstra-like algorithm for two monotone operators"). It starts from the state of the last
      call, which is allowed as it ascends on the dual problem block by block. One round costs one proximal step.

    `value` is Ψ without the +∞ outside, so that it is finite for any picture; the two agree for what `prox` returns.

    **Arguments:**
    - `prior`: Ψ.
    - `lower`, `upper`: in the picture's unit; `upper` None for no upper bound.
    - `rounds`: of Dykstra's algorithm in each proximal step, ≥ 1; an `Analysis` prior needs none.

    **Errors:** `InputError` for bounds that are not numbers or leave nothing between them, fewer than one round, or a
    prior that is bounded already.
    """

    prior: Prior
    lower: float = eqx.field(static=True)
    upper: float = eqx.field(static=True)
    rounds: int = eqx.field(static=True)

    def __init__(self, prior: Prior, lower: float | int = 0.0, upper: float | int | None = None, *, rounds: int = 2):
        if isinstance(prior, Bounded):
            raise InputError(
                "Bounded was given a prior that is Bounded itself; bound the prior within it once, by both."
            )
        try:
            least, most = float(lower), math.inf if upper is None else float(upper)
        except (TypeError, ValueError, OverflowError):
            least = most = math.nan
        with np.errstate(over="ignore"):
            between = np.float32(least) < np.float32(most)  # what pictures are made of
        if not between:
            raise InputError(
                f"Bounded was given lower={shown(lower)} and upper={shown(upper)}; the lower bound has to be a number "
                f"below the upper one, so much that they differ in single precision."
            )
        self.prior = prior
        self.lower, self.upper = least, most
        self.rounds = iteration_count("Bounded", rounds, "rounds")

    @property
    def relative_strength(self) -> float | None:
        """The relative strength of the bounded prior."""
        return self.prior.relative_strength

    @property
    def separable(self) -> bool:
        """Whether the bounded prior is separable: the nearest picture within the bounds is found pixel by pixel."""
        return self.prior.separable

    def clip(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """The nearest picture within the bounds."""
        return jnp.clip(image, self.lower, self.upper)

    def value(self, image: Float[Array, "H W"]) -> Float[Array, ""]:
        """Ψ(image) of the prior itself, within the bounds or not."""
        return self.prior.value(image)

    @property
    def has_prox(self) -> bool:
        return self.prior.has_prox

    def check(self, shape: tuple[int, int]) -> None:
        self.prior.check(shape)

    def with_inner_iterations(self, iterations: int) -> "Bounded":
        return dataclasses.replace(self, prior=self.prior.with_inner_iterations(iterations))

    def initial_state(self, image: Float[Array, "H W"]) -> BoundedState:
        """The prior's own, and nothing held back."""
        return BoundedState(self.prior.initial_state(image), jnp.zeros_like(image))

    @compiled
    def prox(
        self, image: Float[Array, "H W"], strength: Float[ArrayLike, "*pixels"], state: BoundedState
    ) -> tuple[Float[Array, "H W"], BoundedState]:
        """argmin over X within the bounds of ½‖X − image‖² + strength·Ψ(X), and the state for the next call.

        **Arguments:** as of the prior's own `prox`, with the `state` from here.
        """
        if isinstance(self.prior, Analysis):
            result, inner = self.prior.prox_within(image, strength, state.prior, self.clip)
            return result, BoundedState(inner, state.excess)

        def alternate(carry: tuple[Array, BoundedState], _: None) -> tuple[tuple[Array, BoundedState], None]:
            state = carry[1]
            free, inner = self.prior.prox(image - state.excess, strength, state.prior)
            moved = free + state.excess
            result = self.clip(moved)
            return (result, BoundedState(inner, moved - result)), None

        (result, state), _ = jax.lax.scan(alternate, (image, state), None, length=self.rounds)
        return result, state
