"""Total variation, the baseline prior."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt._validation import iteration_count
from scsr_opt.priors.analysis import Analysis


class Dual(NamedTuple):
    """A vector for each pixel, of length ≤ 1 (isotropic) or with components in [−1, 1] (anisotropic).

    At the solution of a proximal step it is the direction of the solution's gradient. It does not scale with the
    strength, so it remains a good start when the step size changes. The last row of `down` and the last column of
    `right` are zero.
    """

    down: Float[Array, "H W"]
    right: Float[Array, "H W"]


class TotalVariation(Analysis[Dual]):
    """Ψ(X) = Σ_p |∇X(p)|, ∇ the forward differences down and right, 0 past the last row and column (Neumann).

    |·| is the Euclidean norm (isotropic: no preferred direction, Rudin, Osher, Fatemi 1992) or the sum of absolute
    values (anisotropic: prefers horizontal and vertical edges). For pictures of surfaces with edges between them; it
    flattens fine texture and makes steps of slow slopes. The proximal step is inexact, by dual steps
    (`Analysis`); ‖∇‖² ≤ 8.

    The value and the step can be differentiated; where a difference is zero the derivative of |·| is taken as zero.

    **Arguments:**
    - `isotropic`: which norm.
    - `iterations`: dual steps in each proximal step, ≥ 1.

    **Errors:** `InputError` for fewer than one iteration.
    """

    coupled: ClassVar[bool] = True

    isotropic: bool = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    def __init__(self, isotropic: bool = True, iterations: int = 4):
        self.isotropic = bool(isotropic)
        self.iterations = iteration_count("TotalVariation", iterations, "iterations")

    @property
    def norm_squared(self) -> float:
        return 8.0

    @property
    def separable(self) -> bool:
        """True."""
        return True

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
        """|field(p)| at each p."""
        if not self.isotropic:
            return jnp.abs(field.down) + jnp.abs(field.right)
        return lengths(field.down**2 + field.right**2)

    def conjugates(self, dual: Dual) -> Float[Array, "H W"]:
        """0: φ is a norm."""
        return jnp.zeros_like(dual.down)

    def conjugate_prox(self, field: Dual, step: Float[Array, "*pixels"]) -> Dual:
        """The nearest field within the unit ball at each pixel."""
        if not self.isotropic:
            return Dual(jnp.clip(field.down, -1, 1), jnp.clip(field.right, -1, 1))
        return to_unit_ball(field)


def lengths(squares: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """√, with derivative 0 at 0."""
    # The root's derivative at 0 is infinite; the inner `where` keeps it out of the outer one's derivative.
    return jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1)), 0)


def to_unit_ball(field: Dual) -> Dual:
    """The nearest field whose vectors have length ≤ 1."""
    shrink = jax.lax.rsqrt(jnp.maximum(field.down**2 + field.right**2, 1))
    return Dual(field.down * shrink, field.right * shrink)


def gradient(image: Float[Array, "H W"]) -> Dual:
    """∇: forward differences, 0 past the last row and column."""
    # Fast where the picture is in memory, given, carried by a loop or divided: see `Analysis.prox_within`.
    down, right = image[1:] - image[:-1], image[:, 1:] - image[:, :-1]
    return Dual(jnp.pad(down, ((0, 1), (0, 0))), jnp.pad(right, ((0, 0), (0, 1))))


def gradient_adjoint(dual: Dual) -> Float[Array, "H W"]:
    """∇*p, minus the divergence, relying on the zeros in the last row of `down` and column of `right`."""
    above = jnp.pad(dual.down[:-1], ((1, 0), (0, 0)))
    before = jnp.pad(dual.right[:, :-1], ((0, 0), (1, 0)))
    return above - dual.down + (before - dual.right)


def gradient_bounds(strength: Float[Array, "*pixels"]) -> Float[Array, "*pixels"]:
    """b with ∇ diag(strength) ∇* ≤ diag(b), the same for both components: the larger sum of a row's absolute values, as
    four differences meet in a pixel."""
    if strength.ndim == 0:
        return 8 * strength
    below = jnp.pad(strength[1:], ((0, 1), (0, 0)))
    after = jnp.pad(strength[:, 1:], ((0, 0), (0, 1)))
    return 4 * (strength + jnp.maximum(below, after))
