"""`divisible`: a strength that may be divided by."""

import jax.numpy as jnp
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float


def divisible(
    strength: Float[ArrayLike, "*pixels"], dtype: DTypeLike
) -> tuple[Bool[Array, "*pixels"], Float[Array, "*pixels"]]:
    """Whether the strength is so small (below 1e-19 in float32) that it counts as 0, and one to calculate with.

    That is 1 where it counts as 0: 1/strength or its derivative would be infinite, and not a number behind a `where`. A
    strength that is itself not a number is let through, to be noticed in the result.
    """
    given = jnp.asarray(strength, dtype)
    off = given < jnp.finfo(dtype).tiny ** 0.5
    return off, jnp.where(off, 1, given)
