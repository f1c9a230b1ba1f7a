"""The blur B of the sampled form: the sensor pixel's aperture, sliding over the high-resolution grid, after the
optics."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt.operators.operator import LinearOperator, picture_shape


class Aperture(LinearOperator):
    """Sliding mean: U(i, j) = mean of X over rows i … i+s−1 and columns j … j+s−1.

    At multiples of s this is `Downsample` exactly; read in between, it is what a pixel sees that lies there. The last
    s−1 rows and columns, where the aperture would leave the picture, are 0 and must not be read.

    **Arguments:** `shape` (H, W) and the integer `scale` s.
    """

    shape: tuple[int, int] = eqx.field(static=True)
    scale: int = eqx.field(static=True)

    def __init__(self, shape: tuple[int, int], scale: int):
        self.shape = picture_shape(shape, "Aperture")
        self.scale = int(scale)

    @property
    def input_shape(self) -> tuple[int, int]:
        return self.shape

    @property
    def output_shape(self) -> tuple[int, int]:
        return self.shape

    def _forward(self, x: Float[Array, "H W"]) -> Float[Array, "H W"]:
        s, (height, width) = self.scale, self.shape
        if s == 1:
            return x
        rows, columns = height - s + 1, width - s + 1
        down = sum((jax.lax.slice_in_dim(x, k, k + rows, axis=0) for k in range(1, s)), x[:rows])
        both = sum((jax.lax.slice_in_dim(down, k, k + columns, axis=1) for k in range(1, s)), down[:, :columns])
        return jnp.pad(both / s**2, ((0, s - 1), (0, s - 1)))

    def _adjoint(self, y: Float[Array, "H W"]) -> Float[Array, "H W"]:
        s, (height, width) = self.scale, self.shape
        if s == 1:
            return y
        inside = jnp.pad(y[: height - s + 1, : width - s + 1] / s**2, s - 1)
        down = sum((jax.lax.slice_in_dim(inside, k, k + height, axis=0) for k in range(1, s)), inside[:height])
        return sum((jax.lax.slice_in_dim(down, k, k + width, axis=1) for k in range(1, s)), down[:, :width])
