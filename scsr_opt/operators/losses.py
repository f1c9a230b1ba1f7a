"""Robust losses: samples that contradict the picture by far more than noise explains lose weight.

    minimise over X of   Σ_j ω_j ρ(r_j·B X − Y_j) + λ Ψ(X)

in the place of Eq. 4's square. Where motion or occlusion is wrong in places, or a pixel that lies goes
unnoticed, squares let a few samples drag the picture far away. (Flicker is no such case: all samples are then wrong by
a little, and both losses do what squares do.) Solved by iterative reweighting (Holland & Welsch, 1977,
"Robust regression using iteratively reweighted least-squares"): solve with squares and factors u_j on the weights, take
u_j = ρ'(e_j) / e_j of the new residuals e_j, repeat. Each such step lowers the objective, because the square with these
factors lies above ρ and touches it (ρ'(e)/e falls with |e|); for `Huber`, which is convex, that leads to the minimiser.

Thresholds are wider here than the usual 1.345 (Huber) and 2.985 (Welsch), which keep 95 % of the efficiency of squares
for independent normal noise. The errors of neighbouring spike intervals are neither: they are bounded (one frame, 2.45
standard deviations) and cancel from one interval to the next, as long as all are weighted alike. A threshold within
that bound breaks the cancellation and costs several dB (docs/data-term.md).
"""

import abc
from numbers import Real

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt.errors import InputError
from scsr_opt.operators.sampling import PlacedSamples


class Loss(eqx.Module):
    """A loss ρ of residuals e, ρ ≈ ½ e² for small ones.

    **Fields:** `threshold`: where the square ends, in standard deviations of the noise.
    """

    threshold: eqx.AbstractVar[float | int]

    def __check_init__(self):
        if not (isinstance(self.threshold, Real) and self.threshold > 0):
            raise InputError(
                f"{type(self).__name__} was given the threshold {self.threshold!r}; it is a number above 0, in "
                f"standard deviations of the noise."
            )

    @abc.abstractmethod
    def value(self, residual: Float[Array, "..."]) -> Float[Array, "..."]:
        """ρ(e), e in standard deviations."""

    @abc.abstractmethod
    def weights(self, residual: Float[Array, "..."]) -> Float[Array, "..."]:
        """ρ'(e) / e in [0, 1], e in standard deviations."""


class Huber(Loss):
    """ρ(e) = ½ e² up to the threshold c, c |e| − ½ c² beyond (Huber, 1964): the influence of a sample is bounded.

    Convex: one minimum, wherever it starts.
    """

    threshold: float | int = 3.0

    def value(self, residual: Float[Array, "..."]) -> Float[Array, "..."]:
        size, c = jnp.abs(residual), self.threshold
        return jnp.where(size <= c, 0.5 * residual**2, c * size - 0.5 * c**2)

    def weights(self, residual: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.threshold / jnp.maximum(jnp.abs(residual), self.threshold)


class Welsch(Loss):
    """ρ(e) = ½ c² (1 − exp(−(e/c)²)) (Dennis & Welsch, 1978): a sample with a large residual has no influence.

    Not convex: start from a good picture, such as that of squares or `Huber`.
    """

    threshold: float | int = 6.0

    def value(self, residual: Float[Array, "..."]) -> Float[Array, "..."]:
        return -0.5 * self.threshold**2 * jnp.expm1(-((residual / self.threshold) ** 2))

    def weights(self, residual: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.exp(-((residual / self.threshold) ** 2))


def residuals(placed: PlacedSamples, blurred: Float[Array, "H W"]) -> Float[Array, " n"]:
    """r_j·U − Y_j of every sample, intensity, U = B X (`DataTerm.blurred`); whatever it is worth for samples of weight
    0."""
    return placed.read(blurred) - placed.value


@eqx.filter_jit
def robust_factors(
    loss: Loss,
    placed: PlacedSamples,
    blurred: Float[Array, "H W"],
    *,
    deviation: Float[Array, " n"] | None = None,
) -> Float[Array, " n"]:
    """Factors u_j on the weights for the next solve: `accumulate(placed, robust=…)`, `with_exposure(…, robust=…)`.

    **Arguments:**
    - `loss`: ρ.
    - `placed`: the samples.
    - `blurred`: B X of the picture so far (`DataTerm.blurred`).
    - `deviation`: (n,), standard deviation of each sample's noise, intensity (`Noise.deviation` for intervals). If not
      given it is taken as σ/√ω, with the σ for which the median size of the residuals is that of normal noise.

    **Returns:** (n,) in [0, 1].
    """
    used = placed.weight > 0
    size = jnp.abs(residuals(placed, blurred))
    if deviation is None:
        size = size * jnp.sqrt(placed.weight)
        # Normal noise is within 0.6745 standard deviations half of the time.
        scale = jnp.nanmedian(jnp.where(used, size, jnp.nan)) / 0.6745
    else:
        scale = deviation
    # Where the residuals, or a sample's noise, are 0 throughout, there is no scale for what is far off.
    return jnp.where(used & (scale > 0), loss.weights(size / jnp.where(scale > 0, scale, 1)), 1)
