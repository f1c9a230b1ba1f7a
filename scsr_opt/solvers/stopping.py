"""Stopping rules: measures of a picture's optimality that are compared with the tolerance.

Let X be a picture, p a field with φ*(p) finite (a dual variable, for λΨ it is λp), and

    r = ∇f(X) + λ K*p,      g = λ (φ(K X) + φ*(p) − ⟨K X, p⟩) ≥ 0.

Both are zero exactly at a minimiser with its dual variable (Fenchel and Young). Every splitting method knows them. Two
bounds follow.

**Fixed point.** For the proximal problem behind G(X) = prox(X − β∇f(X)), X and p are feasible with a duality gap of
½β²‖r‖² + βg. As the problem is 1-strongly convex, ‖X − G(X)‖² ≤ β²‖r‖² + 2βg.

**Duality gap.** f is convex, so f(x) + λφ(K x) ≥ f(X) + ⟨∇f(X), x − X⟩ + λ⟨K x, p⟩ − λφ*(p) = F(X) − g + ⟨r, x − X⟩
for all x. Hence F(X) − min F ≤ g + max ⟨r, X − x⟩, the maximum taken over any set that holds a minimiser (the second
part is the gap of Frank and Wolfe, 1956, "An algorithm for quadratic programming"). Without such a set it is infinite
where BᵀMB is singular, and it mostly is: the dual point then would have to lie exactly in its range.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt._validation import finite
from scsr_opt.errors import InputError
from scsr_opt.priors.analysis import Analysis
from scsr_opt.priors.prior import Prior

# Stands for a duality gap that is not measured, which no gap can be: none is below 0. NaN would do as well, but under
# `JAX_DEBUG_NANS=1` no compiled program may return one; `Stage.of` makes NaN of it where no program sees it.
UNMEASURED = -1.0


class Evidence(NamedTuple):
    """Quantities that an iteration knows of its picture: `image` X, `objective` F(X), `slope` r, `misfit` g (None where
    the prior has no known conjugate) and `residual`, ‖X − G(X)‖ / ‖X‖ or a bound on it."""

    image: Float[Array, "H W"]
    objective: Float[Array, ""]
    slope: Float[Array, "H W"]
    misfit: Float[Array, ""] | None
    residual: Float[Array, ""]


class Stopping(eqx.Module):
    """A measure of optimality that a solver's tolerance is compared with."""

    @abc.abstractmethod
    def check(self, prior: Prior) -> None:
        """Raises `InputError` if it cannot be measured with this prior."""

    @abc.abstractmethod
    def gap(self, evidence: Evidence) -> Float[Array, ""]:
        """The relative duality gap for the record; `UNMEASURED` where it is not."""

    @abc.abstractmethod
    def measure(self, residual: Float[Array, ""], gap: Float[Array, ""]) -> Float[Array, ""]:
        """Which of the two is held against the tolerance."""


class FixedPoint(Stopping):
    """The relative residual ‖X − G(X)‖ / ‖X‖, G one proximal-gradient step. For every prior.

    It takes G as it is computed. Where λ is so large that the picture becomes flat, a thousand times what the recording
    asks for, the few dual steps of an `Analysis` prior's proximal step hardly move the picture though it is far from
    flat, and `FISTA` ends too early (0.3 % above the minimum at λ = 1, 13 % at 10, Huber-TV): take `DualityGap` there.
    """

    def check(self, prior: Prior) -> None:
        """Serves every prior."""

    def gap(self, evidence: Evidence) -> Float[Array, ""]:
        return jnp.full((), UNMEASURED, evidence.image.dtype)

    def measure(self, residual: Float[Array, ""], gap: Float[Array, ""]) -> Float[Array, ""]:
        return residual


class DualityGap(Stopping):
    """The duality gap over F(X): a bound on the relative distance of the objective from its minimum.

    It is certain if a minimiser lies between `lower` and `upper`, as intensities do; a wider range costs tightness. For
    `Analysis` priors. During a run it is 10 to 500 times the true gap; in float32 it has come down to 5e-5; to
    go below, work in float64.

    **Fields:** `lower`, `upper`: in the picture's unit, 1 = white.

    **Errors:** `InputError` for bounds that leave nothing between them or are not finite, and, when a run begins, for a
    prior whose conjugate is not known.
    """

    lower: float | int = 0.0
    upper: float | int = 1.0

    def __check_init__(self):
        if not finite(self.lower) < finite(self.upper):
            raise InputError(
                f"DualityGap was given lower={self.lower!r} and upper={self.upper!r}; it needs two finite intensities, "
                "the lower one below the upper one."
            )

    def check(self, prior: Prior) -> None:
        if not isinstance(prior, Analysis):
            raise InputError(
                f"DualityGap was asked of {type(prior).__name__}, whose conjugate is not known; take an Analysis prior "
                "such as TotalVariation, or stopping=FixedPoint()."
            )

    def gap(self, evidence: Evidence) -> Float[Array, ""]:
        assert evidence.misfit is not None  # `check` saw to it
        image, slope = evidence.image, evidence.slope
        away = jnp.sum(jnp.maximum(slope * (image - self.lower), slope * (image - self.upper)))
        tiny = jnp.finfo(image.dtype).tiny
        return jnp.maximum(evidence.misfit + away, 0) / jnp.maximum(evidence.objective, tiny)

    def measure(self, residual: Float[Array, ""], gap: Float[Array, ""]) -> Float[Array, ""]:
        return gap


def misfit(prior: Analysis, field: Any, dual: Any) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """φ(field), and φ(field) + φ*(dual) − ⟨field, dual⟩ summed term by term, so that little is lost to cancellation."""
    penalties = prior.penalties(field)
    products = sum(jax.tree.leaves(jax.tree.map(lambda z, p: z * p, field, dual)))
    return jnp.sum(penalties), jnp.sum(penalties + prior.conjugates(dual) - products)


def relative(change: Float[Array, ""], image: Float[Array, "H W"]) -> Float[Array, ""]:
    """change / ‖image‖, a number for a black picture, too: one that is less than the root of the smallest number, whose
    square is lost, counts as that root."""
    return change / jnp.maximum(jnp.linalg.norm(image), jnp.finfo(image.dtype).tiny ** 0.5)
