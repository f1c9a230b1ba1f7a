"""Stacks of pictures, reduced over their first axis."""

from collections.abc import Callable

import jax
from jaxtyping import Array, Shaped


def folded(join: Callable[[Array, Array], Array], stack: Shaped[Array, "n *shape"]) -> Shaped[Array, "*shape"]:
    """The pictures of a stack reduced one after the other by `join`: `jnp.add`, `jnp.minimum` or `jnp.maximum`.

    Meant for large pictures: XLA for CPUs reduces a first axis pixel by pixel, through all of memory, which takes 20 to
    40 times as long (docs/decisions/0010).
    """
    return jax.lax.fori_loop(1, len(stack), lambda k, so_far: join(so_far, stack[k]), stack[0])
