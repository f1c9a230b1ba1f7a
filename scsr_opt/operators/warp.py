"""Motion T_{k→i} of Eq. 2 as an explicit bilinear warp of the high-resolution picture."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from scsr_opt._arrays import held
from scsr_opt.errors import InputError
from scsr_opt.operators.operator import LinearOperator


class Warp(LinearOperator):
    """Reads the picture at displaced positions: output(p) = input(p + displacement(p)), bilinear.

    A position is outside when it is not within the pixel centres 0 … H−1 and 0 … W−1: there is nothing to interpolate
    between. Such a position, and one whose displacement is not finite (the way to mark occlusion), is *invalid*: the
    output there is 0 and `valid` is False. Nothing is invented, so a data term must give those values no weight.

    The adjoint adds every value back to the four pixels it was read from, with the weights it was read with. The warp
    can be differentiated in the displacement too (piecewise; at whole pixels the derivative towards larger positions;
    zero where invalid).

    **Arguments:**
    - `displacement`: (2, H, W) in high-resolution pixels, [0] along rows (down), [1] along columns (right).

    **Errors:** `InputError` if the displacement has another shape or is not floating point.
    """

    displacement: Float[Array, "2 H W"]

    def __init__(self, displacement: ArrayLike):
        displacement = held(displacement, "Warp's displacement")
        if displacement.ndim != 3 or displacement.shape[0] != 2 or 0 in displacement.shape:
            raise InputError(
                f"Warp was given a displacement of shape {displacement.shape}; it needs (2, H, W), rows first, "
                "then columns."
            )
        if not jnp.issubdtype(displacement.dtype, jnp.floating):
            raise InputError(
                f"Warp was given a displacement of {displacement.dtype} values; it needs floating point, in pixels."
            )
        self.displacement = displacement

    @property
    def input_shape(self) -> tuple[int, int]:
        _, rows, columns = self.displacement.shape
        return rows, columns

    @property
    def output_shape(self) -> tuple[int, int]:
        return self.input_shape

    @property
    def valid(self) -> Bool[Array, "H W"]:
        """True where the output shows the picture."""
        (_, _, inside_rows), (_, _, inside_columns) = self._axis(0), self._axis(1)
        return inside_rows & inside_columns

    def _axis(self, axis: int) -> tuple[Int[Array, "H W"], Float[Array, "H W"], Bool[Array, "H W"]]:
        """Along one axis: the pixel at or before the position, the fraction beyond it, and whether that is inside."""
        size = self.input_shape[axis]
        finite = jnp.all(jnp.isfinite(self.displacement), axis=0)
        # Past size + 1 a position is outside whatever it is; the clip keeps the conversion to integers defined.
        along = jnp.clip(jnp.where(finite, self.displacement[axis], 0), -size - 1, size + 1)
        # Splitting the displacement, not the position, keeps the fraction as exact far from the origin as near it.
        whole = jnp.floor(jax.lax.stop_gradient(along))
        fraction = along - whole
        first = jax.lax.broadcasted_iota(jnp.int32, self.input_shape, axis) + whole.astype(jnp.int32)
        inside = (first >= 0) & ((first < size - 1) | ((first == size - 1) & (fraction == 0)))
        return jnp.clip(first, 0, size - 1), fraction, finite & inside

    def _taps(self, dtype: jnp.dtype) -> list[tuple[Int[Array, "H W"], Float[Array, "H W"]]]:
        """The four pixels (flat index) and weights that make up each output pixel."""
        rows, columns = self.input_shape
        row, down, inside_rows = self._axis(0)
        column, right, inside_columns = self._axis(1)
        down, right = down.astype(dtype), right.astype(dtype)
        shown = (inside_rows & inside_columns).astype(dtype)
        below, beside = jnp.minimum(row + 1, rows - 1), jnp.minimum(column + 1, columns - 1)
        return [
            (row * columns + column, shown * (1 - down) * (1 - right)),
            (row * columns + beside, shown * (1 - down) * right),
            (below * columns + column, shown * down * (1 - right)),
            (below * columns + beside, shown * down * right),
        ]

    def _forward(self, x: Float[Array, "H W"]) -> Float[Array, "H W"]:
        flat = x.reshape(-1)
        return sum(
            (weight * flat.at[index].get(mode="promise_in_bounds") for index, weight in self._taps(x.dtype)),
            start=jnp.zeros_like(x),
        )

    def _adjoint(self, y: Float[Array, "H W"]) -> Float[Array, "H W"]:
        # One scatter a tap: 2.4 ms at 512×512 on two cores, where one scatter of all four stacked takes 9 ms.
        flat = jnp.zeros(y.size, y.dtype)
        for index, weight in self._taps(y.dtype):
            flat = flat.at[index].add(weight * y, mode="promise_in_bounds")
        return flat.reshape(y.shape)
