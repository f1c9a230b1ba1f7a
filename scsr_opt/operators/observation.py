"""The whole observation model of Eq. 2, all frames at once, in the paper's order D H T.

This is the reference form. It costs a dense warp per frame and iteration; `scsr_opt.operators.sampling` does the same
in a cost that does not grow with the number of frames, where motion is locally a translation.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from scsr_opt._arrays import held
from scsr_opt.errors import InputError
from scsr_opt.operators.operator import LinearOperator
from scsr_opt.operators.warp import Warp


class Observation(LinearOperator):
    """X ↦ (V_i D_s H T_{k→i} X) for i = 1 … N: what the sensor sees in each of N frames (paper, Eq. 2, no noise).

    V_i keeps the valid samples and sets the others to 0. A sample is valid if at least `coverage` of its light comes
    from positions where the warp is valid; below that it would be too dark, because the warp returns 0 for what it does
    not know. Give invalid samples no weight, or set them to 0 in the data too.

    Frames are worked through one after another, so that memory holds one warped picture whatever N is, also in
    reverse-mode derivatives.

    **Arguments:**
    - `displacement`: (N, 2, H, W) in high-resolution pixels, per frame as in `Warp`; not finite marks what is not seen.
    - `sensor`: D_s H, or whatever else follows the warp, (H, W) → (h, w), for example
      `Downsample(shape, 4) @ Blur.gaussian(shape, 1.2)`; the same for every frame. Its weights are taken to be
      non-negative.
    - `coverage`: in (0, 1].

    **Fields:** `valid`, (N, h, w). It belongs to `displacement` and `sensor`: for others, make a new `Observation`.

    **Errors:** `InputError` if a shape does not fit.
    """

    displacement: Float[Array, "N 2 H W"]
    sensor: LinearOperator
    valid: Bool[Array, "N h w"]

    def __init__(self, displacement: ArrayLike, sensor: LinearOperator, *, coverage: float = 0.999):
        displacement = held(displacement, "Observation's displacement")
        if displacement.ndim != 4 or displacement.shape[0] < 1 or displacement.shape[1] != 2:
            raise InputError(
                f"Observation was given displacements of shape {displacement.shape}; it needs (N, 2, H, W), N ≥ 1."
            )
        if not jnp.issubdtype(displacement.dtype, jnp.floating):
            raise InputError(
                f"Observation was given {displacement.dtype} displacements; it needs floating point, in pixels."
            )
        if displacement.shape[2:] != sensor.input_shape:
            raise InputError(
                f"Observation was given displacements of {displacement.shape[2:]} pixels and a sensor that takes "
                f"pictures of {sensor.input_shape}; they must be the same."
            )
        if not 0 < coverage <= 1:
            raise InputError(
                f"Observation was given coverage {coverage}; it is a share of a sample's light, in (0, 1]."
            )
        self.displacement = displacement
        self.sensor = sensor
        self.valid = _valid(displacement, sensor, coverage)

    @property
    def input_shape(self) -> tuple[int, ...]:
        return self.sensor.input_shape

    @property
    def output_shape(self) -> tuple[int, ...]:
        return self.displacement.shape[0], *self.sensor.output_shape

    def _forward(self, x: Float[Array, "H W"]) -> Float[Array, "N h w"]:
        # Without the checkpoint a derivative would keep indices and weights of every frame.
        @jax.checkpoint
        def frame(of: tuple[Array, Array]) -> Float[Array, "h w"]:
            displacement, valid = of
            return jnp.where(valid, self.sensor(Warp(displacement)(x)), 0)

        return jax.lax.map(frame, (self.displacement, self.valid))

    def _adjoint(self, y: Float[Array, "N h w"]) -> Float[Array, "H W"]:
        @jax.checkpoint
        def add_frame(total: Float[Array, "H W"], of: tuple[Array, Array, Array]):
            displacement, valid, samples = of
            return total + Warp(displacement).adjoint(self.sensor.adjoint(jnp.where(valid, samples, 0))), None

        total, _ = jax.lax.scan(add_frame, jnp.zeros(self.input_shape, y.dtype), (self.displacement, self.valid, y))
        return total


@partial(jax.jit, static_argnames="coverage")
def _valid(displacement: Float[Array, "N 2 H W"], sensor: LinearOperator, coverage: float) -> Bool[Array, "N h w"]:
    displacement = jax.lax.stop_gradient(displacement)

    def frame(of: Float[Array, "2 H W"]) -> Bool[Array, "h w"]:
        seen = sensor(Warp(of).valid.astype(displacement.dtype))
        # A constant picture comes through the sensor only to rounding, also where everything is valid.
        return seen >= coverage - 16 * jnp.finfo(displacement.dtype).eps

    return jax.lax.map(frame, displacement)
