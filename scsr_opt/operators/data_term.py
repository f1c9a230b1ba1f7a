"""The data term of accumulated samples (`scsr_opt.operators.sampling`): a quadratic in B X, by M, c and e."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.downsample import Downsample
from scsr_opt.operators.operator import LinearOperator

# The neighbours that a pixel is coupled with, besides itself; the opposite four follow by symmetry.
_NEIGHBOURS = ((0, 1), (1, -1), (1, 0), (1, 1))


class Stencil(eqx.Module):
    """A symmetric operator M on pictures that couples each pixel with its eight neighbours.

    **Fields:** `planes` (5, H, W): the diagonal, and the coupling of p with p + (0, 1), (1, −1), (1, 0), (1, 1).
    """

    planes: Float[Array, "5 H W"]

    def __call__(self, u: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """M u."""
        height, width = u.shape
        around = jnp.pad(u, 1)
        result = self.planes[0] * u
        for plane, (down, right) in zip(self.planes[1:], _NEIGHBOURS, strict=True):
            ahead = jax.lax.slice(around, (1 + down, 1 + right), (1 + down + height, 1 + right + width))
            behind = jnp.pad(plane, 1)
            behind = jax.lax.slice(behind, (1 - down, 1 - right), (1 - down + height, 1 - right + width))
            before = jax.lax.slice(around, (1 - down, 1 - right), (1 - down + height, 1 - right + width))
            result = result + plane * ahead + behind * before
        return result


class DataTerm(eqx.Module):
    """f(X) = ½⟨U, M U⟩ − ⟨c, U⟩ + ½ e with U = B X: Eq. 4's data part, divided by two.

    **Fields:**
    - `stencil`: M. `target`: c, of the shape of U. `energy`: e.
    - `aperture`, `optics`: B = aperture ∘ optics; `optics` None means a perfect lens. The aperture slides over the
      high-resolution grid, or, where nothing moves, stands on the sensor's: U is (h, w) then.
    - `bound`: an upper bound of ‖BᵀMB‖ where one is known (`scsr_opt.solvers.with_bound`), so that the next solve with
      the same M need not find it; None where not.
    """

    stencil: Stencil | Any
    target: Float[Array, "rows columns"]
    energy: Float[Array, ""]
    aperture: Aperture | Downsample
    optics: LinearOperator | None
    bound: Float[Array, ""] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of X."""
        return self.aperture.shape

    @property
    def block_diagonal(self) -> bool:
        """True where the light of a sensor pixel depends on its own block of the picture alone, as where nothing moves
        and the lens is perfect: M is diagonal then, and `prox` is known."""
        return isinstance(self.aperture, Downsample) and self.optics is None

    def blurred(self, image: Float[Array, "H W"]) -> Float[Array, "rows columns"]:
        """U = B X."""
        return self.aperture(image if self.optics is None else self.optics(image))

    def blurred_adjoint(self, u: Float[Array, "rows columns"]) -> Float[Array, "H W"]:
        """Bᵀ u."""
        back = self.aperture.adjoint(u)
        return back if self.optics is None else self.optics.adjoint(back)

    def value_and_gradient(self, image: Float[Array, "H W"]) -> tuple[Float[Array, ""], Float[Array, "H W"]]:
        """f and its gradient Bᵀ(M B X − c), from one application of M."""
        u = self.blurred(image)
        mu = self.stencil(u)
        value = jnp.sum(u * (0.5 * mu - self.target)) + 0.5 * self.energy
        return value, self.blurred_adjoint(mu - self.target)

    def value(self, image: Float[Array, "H W"]) -> Float[Array, ""]:
        """f(X)."""
        return self.value_and_gradient(image)[0]

    def gradient(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """∇f(X) = Bᵀ(M B X − c)."""
        return self.value_and_gradient(image)[1]

    def normal(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """Bᵀ M B X."""
        return self.blurred_adjoint(self.stencil(self.blurred(image)))

    def prox(
        self, image: Float[Array, "H W"], strength: Float[Array, ""]
    ) -> tuple[Float[Array, "H W"], Float[Array, ""]]:
        """argmin over X of ½‖X − image‖² + strength·f(X), for data that are `apart`, and f there.

        With D the mean over s×s blocks, D D* = 1/s². So U = D X solves (1 + τ m/s²) U = D image + τ c/s², m the
        diagonal of M and τ the strength, pixel by pixel, and X = image + τ D*(c − m U).
        """
        assert self.block_diagonal
        area, diagonal = self.aperture.scale**2, self.stencil.planes[0]
        u = (self.aperture(image) + strength * self.target / area) / (1 + strength * diagonal / area)
        value = jnp.sum(u * (0.5 * diagonal * u - self.target)) + 0.5 * self.energy
        return image + self.aperture.adjoint(strength * (self.target - diagonal * u)), value


@eqx.filter_jit
def blurred(term: DataTerm, image: Float[Array, "H W"]) -> Float[Array, "rows columns"]:
    """`DataTerm.blurred` as one program, for use outside `jit`."""
    return term.blurred(image)
