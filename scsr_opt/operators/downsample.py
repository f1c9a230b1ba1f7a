"""The sensor's pixel aperture D_s of Eq. 2."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt.errors import InputError
from scsr_opt.operators.operator import LinearOperator, picture_shape


class Downsample(LinearOperator):
    """Mean over s×s blocks: what a sensor pixel that covers s×s picture pixels collects.

    The adjoint spreads each value evenly, 1/s² to every pixel of its block. ‖D_s‖ = 1/s, and D_s D_s* is 1/s² times the
    identity.

    **Arguments:**
    - `shape`: (H, W) of the high-resolution picture, multiples of `scale`.
    - `scale`: s, an integer ≥ 1.

    **Errors:** `InputError` for a scale below 1 or a picture that does not divide into blocks.
    """

    shape: tuple[int, int] = eqx.field(static=True)
    scale: int = eqx.field(static=True)

    def __init__(self, shape: tuple[int, int], scale: int):
        self.shape = picture_shape(shape, "Downsample")
        if scale != int(scale) or scale < 1:
            raise InputError(f"Downsample was given the scale {scale}; it is an integer of at least 1.")
        self.scale = int(scale)
        if any(size % self.scale for size in self.shape):
            raise InputError(
                f"Downsample by {scale} was given the picture shape {self.shape}; both sides must be multiples "
                f"of {scale}: crop or pad the picture."
            )

    @property
    def input_shape(self) -> tuple[int, int]:
        return self.shape

    @property
    def output_shape(self) -> tuple[int, int]:
        rows, columns = self.shape
        return rows // self.scale, columns // self.scale

    def _forward(self, x: Float[Array, "H W"]) -> Float[Array, "h w"]:
        rows, columns = self.output_shape
        # Rows first: the sum along the contiguous axis is the slow one, and is then s times shorter. Behind a barrier,
        # or XLA for CPUs computes it anew for each column; and by slices, as it sums short rows one by one
        # (docs/decisions/0010).
        by_rows = jax.lax.optimization_barrier(x.reshape(rows, self.scale, columns * self.scale).sum(axis=1))
        columns_apart = (by_rows[:, k :: self.scale] for k in range(self.scale))
        return sum(columns_apart, start=jnp.zeros((), x.dtype)) / self.scale**2

    def _adjoint(self, y: Float[Array, "h w"]) -> Float[Array, "H W"]:
        # Columns first: copies of a whole row are the fast ones.
        wide = jax.lax.optimization_barrier(jnp.repeat(y / self.scale**2, self.scale, axis=1))
        return jnp.repeat(wide, self.scale, axis=0)
