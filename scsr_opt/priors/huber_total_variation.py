"""Total variation with the Huber function for its kink: smooth, and without steps on slow slopes."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt._validation import iteration_count, positive
from scsr_opt.priors.analysis import Analysis
from scsr_opt.priors.total_variation import Dual, gradient, gradient_adjoint, gradient_bounds, lengths, to_unit_ball


class HuberTotalVariation(Analysis[Dual]):
    """Ψ(X) = Σ_p h(|∇X(p)|), h(r) = r²/(2δ) for r ≤ δ and r − δ/2 above (Huber, 1964; for pictures Werlberger et al.,
    2009, "Anisotropic Huber-L1 optical flow").

    |∇X| is the Euclidean length of the differences as in `TotalVariation`, δ the knee. Slopes below the knee are
    smoothed as by a quadratic, so that they stay slopes where total variation makes stairs; edges above it are kept as
    total variation keeps them. For pictures with shading, and for solvers that need a gradient: Ψ is differentiable
    with ∇Ψ = ∇*(∇X / max(|∇X|, δ)), whose Lipschitz constant is 8/δ. TV − δ/2·pixels ≤ Ψ ≤ TV.

    The conjugate is φ*(p) = δ/2·|p|² within the unit ball. The proximal step is inexact, by dual steps (`Analysis`).

    **Arguments:**
    - `knee`: δ > 0, in intensity per pixel; 0.02 is below what is seen as an edge.
    - `iterations`: dual steps in each proximal step, ≥ 1.

    **Errors:** `InputError` for a knee that is not positive and finite, or fewer than one iteration.
    """

    smooth: ClassVar[bool] = True
    coupled: ClassVar[bool] = True

    knee: float = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    def __init__(self, knee: float | int = 0.02, iterations: int = 4):
        self.knee = positive("HuberTotalVariation", "the knee", knee)
        self.iterations = iteration_count("HuberTotalVariation", iterations, "iterations")

    @property
    def norm_squared(self) -> float:
        return 8.0

    @property
    def separable(self) -> bool:
        """True."""
        return True

    @property
    def lipschitz(self) -> float:
        """8/δ."""
        return self.norm_squared / self.knee

    def gradient(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """∇*(∇X / max(|∇X|, δ))."""
        field = gradient(image)
        length = jnp.sqrt(jnp.maximum(field.down**2 + field.right**2, self.knee**2))
        # Behind a barrier, so that XLA for CPUs keeps nothing but the lengths in memory, and computes the differences
        # anew where they are divided: a third of the time. Times reciprocals it would be longer (docs/decisions/0010).
        image, length = jax.lax.optimization_barrier((image, length))
        field = gradient(image)
        return gradient_adjoint(Dual(field.down / length, field.right / length))

    def bounds(self, strength: Float[Array, "*pixels"]) -> Float[Array, "*pixels"]:
        """`gradient_bounds`."""
        return gradient_bounds(strength)

    def analysis(self, image: Float[Array, "H W"]) -> Dual:
        """∇ image."""
        return gradient(image)

    def adjoint(self, field: Dual) -> Float[Array, "H W"]:
        """∇* field."""
        return gradient_adjoint(field)

    def penalties(self, field: Dual) -> Float[Array, "H W"]:
        """h(|field(p)|) at each p."""
        squares = field.down**2 + field.right**2
        return jnp.where(squares > self.knee**2, lengths(squares) - self.knee / 2, squares / (2 * self.knee))

    def conjugates(self, dual: Dual) -> Float[Array, "H W"]:
        """δ/2·|dual(p)|² at each p."""
        return self.knee / 2 * (dual.down**2 + dual.right**2)

    def conjugate_prox(self, field: Dual, step: Float[Array, "*pixels"]) -> Dual:
        """The field shortened by 1 + step·δ, then the nearest one within the unit ball at each pixel."""
        shorter = 1 / (1 + step * self.knee)
        return to_unit_ball(Dual(shorter * field.down, shorter * field.right))
