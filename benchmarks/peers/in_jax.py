"""R B of the problems in JAX, as a user of a JAX library would write it: a strided convolution where the frames are
shifted as a whole, gathers where every pixel moves on its own."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.peers.problems import SCALE, Case


def forward(case: Case) -> Callable[[Float[Array, "H W"]], Float[Array, " J"]]:
    """X ↦ R B X, in float32; its transpose is JAX's."""
    if len(case.kernels):
        kernels = jnp.asarray(case.kernels[:, None, ::-1, ::-1], jnp.float32)

        def convolve(x: Float[Array, "H W"]) -> Float[Array, " J"]:
            frames = jax.lax.conv_general_dilated(x[None, None], kernels, (SCALE, SCALE), ((2, 1), (2, 1)))
            return frames.reshape(-1)

        return convolve

    taps = case.reading.indices.reshape(-1, 4).T
    weights = case.reading.data.reshape(-1, 4).T
    pairs = [(jnp.asarray(i, jnp.int32), jnp.asarray(w, jnp.float32)) for i, w in zip(taps, weights, strict=True)]

    def gather(x: Float[Array, "H W"]) -> Float[Array, " J"]:
        around = jnp.pad(x, 2)
        down = around[:-2] + around[1:-1] + around[2:]
        blurred = ((down[:, :-2] + down[:, 1:-1] + down[:, 2:]) / 9).reshape(-1)
        return sum((w * blurred.at[i].get(mode="promise_in_bounds") for i, w in pairs), jnp.zeros(len(taps[0])))

    return gather


def check(case: Case, applied: Float[Array, "..."], x: Float[np.ndarray, "H W"]) -> None:
    """Stops everything if `applied` is not R B x to float32's accuracy."""
    np.testing.assert_allclose(np.asarray(applied).ravel(), case.matrix @ x.ravel(), atol=3e-5)
