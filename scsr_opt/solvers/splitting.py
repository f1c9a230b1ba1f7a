"""Priors as splitting methods use them: Ψ(X) = φ(K X) with a dual variable p.

An `Analysis` prior brings its own K. Any other is taken with K = identity and φ = Ψ, whose proximal step is the prior's
own. The dual step is that of all methods (Moreau's identity): with a field w = v + (λ/σ)p,

    p ← argmin over q of ½‖q − (σ/λ)w‖² + (σ/λ)φ*(q),       z = w − (λ/σ)p = argmin of ½‖z − w‖² + (λ/σ)φ(z).

For v = K(2X' − X) it is the dual step of Condat, Vũ, Chambolle and Pock with step σ; for v = K X the step for the split
variable z in ADMM with penalty ρ = σ. The dual variable of λΨ is λp: p remains a good start when λ or σ changes.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt.priors.analysis import Analysis
from scsr_opt.priors.prior import Prior
from scsr_opt.solvers.stopping import Evidence, misfit, relative


class Dual(NamedTuple):
    """`field` p; `memory`, what the prior's proximal step remembers (None where K is its own); `split`, the z that
    belongs to p (None likewise)."""

    field: Any
    memory: Any
    split: Any


class Splitting(eqx.Module):
    """K, its adjoint, and the dual step of a prior."""

    @property
    @abc.abstractmethod
    def norm_squared(self) -> float:
        """An upper bound on ‖K‖²."""

    @abc.abstractmethod
    def analysis(self, image: Float[Array, "H W"]) -> Any:
        """K X."""

    @abc.abstractmethod
    def adjoint(self, field: Any) -> Float[Array, "H W"]:
        """K* of a field."""

    @abc.abstractmethod
    def initial(self, image: Float[Array, "H W"]) -> Dual:
        """p = 0."""

    @abc.abstractmethod
    def ascend(self, dual: Dual, field: Any, strength: Float[Array, ""], step: Float[Array, ""]) -> Dual:
        """The dual step of the module's docstring, `field` being v and `step` σ."""

    @abc.abstractmethod
    def evidence(
        self,
        image: Float[Array, "H W"],
        field: Any,
        data: Float[Array, ""],
        slope: Float[Array, "H W"],
        dual: Dual,
        strength: Float[Array, ""],
        step_size: Float[Array, ""],
    ) -> tuple[Float[Array, ""], Evidence]:
        """λΨ(X), and how near to optimal X is, `field` being K X, `data` f(X), `slope` ∇f(X) + λK*p, `step_size` β ≤
        1/L."""


class AnalysisSplitting(Splitting):
    """Splitting by the prior's own K."""

    prior: Analysis

    @property
    def norm_squared(self) -> float:
        return self.prior.norm_squared

    def analysis(self, image):
        return self.prior.analysis(image)

    def adjoint(self, field):
        return self.prior.adjoint(field)

    def initial(self, image):
        return Dual(self.prior.initial_state(image), None, None)

    def ascend(self, dual, field, strength, step):
        scale = step / _divisible(strength)
        moved = jax.tree.map(lambda p, v: p + scale * v, dual.field, field)
        return Dual(self.prior.conjugate_prox(moved, scale), None, None)

    def evidence(self, image, field, data, slope, dual, strength, step_size):
        penalty, off = misfit(self.prior, field, dual.field)
        penalty, off = strength * penalty, strength * off
        square = step_size**2 * jnp.sum(slope**2) + 2 * step_size * jnp.maximum(off, 0)
        return penalty, Evidence(image, data + penalty, slope, off, relative(jnp.sqrt(square), image))


class ProximalSplitting(Splitting):
    """Splitting by K = identity and the prior's proximal step."""

    prior: Prior

    @property
    def norm_squared(self) -> float:
        return 1.0

    def analysis(self, image):
        return image

    def adjoint(self, field):
        return field

    def initial(self, image):
        return Dual(jnp.zeros_like(image), self.prior.initial_state(image), image)

    def ascend(self, dual, field, strength, step):
        whole = field + strength / step * dual.field
        split, memory = self.prior.prox(whole, strength / step, dual.memory)
        return Dual(step / _divisible(strength) * (whole - split), memory, split)

    def evidence(self, image, field, data, slope, dual, strength, step_size):
        # z = prox(z + βλp), and G(X) = prox(X − β∇f(X)): the two are no further apart than what they are steps from.
        penalty = strength * self.prior.value(image)
        change = 2 * jnp.linalg.norm(image - dual.split) + step_size * jnp.linalg.norm(slope)
        return penalty, Evidence(image, data + penalty, slope, None, relative(change, image))


def splitting_of(prior: Prior) -> Splitting:
    """`AnalysisSplitting` where the prior is an `Analysis`, otherwise `ProximalSplitting`."""
    return AnalysisSplitting(prior) if isinstance(prior, Analysis) else ProximalSplitting(prior)


def _divisible(strength: Float[Array, ""]) -> Float[Array, ""]:
    """A stand-in for a strength of 0: whatever dual variable comes of it is multiplied by 0 wherever it is used."""
    return jnp.where(strength < jnp.finfo(strength.dtype).tiny ** 0.5, 1, strength)
