"""Stacks of pictures, reduced over their first axis."""

from collections.abc import Callable

import jax
from jaxtyping import Array, Shaped


def folded(join: Callable[[Array, Array], Array], stack: Shaped[Array, "n *shape"]) -> Shaped[Array, "*shape"]:
    """One picture after the other joined to what has come of those before: `jnp.add`, `jnp.minimum`, `jnp.maximum`.

    For large pictures. XLA for CPUs reduces such an axis pixel by pixel, through all of memory: 20 to 40 times as long
    (docs/measurements.md).
    """
    return jax.lax.fori_loop(1, len(stack), lambda k, so_far: join(so_far, stack[k]), stack[0])
