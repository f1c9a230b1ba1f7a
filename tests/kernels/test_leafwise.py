"""Each leaf by a kernel of its own: what is calculated stays the same."""

import jax
import jax.numpy as jnp
import numpy as np

from scsr_opt._kernels.leafwise import leaf_by_leaf


def _to_unit_ball(down: jax.Array, right: jax.Array) -> tuple[jax.Array, jax.Array]:
    length = jnp.maximum(jnp.sqrt(down**2 + right**2), 1)
    return down / length, right / length


def test_leaf_by_leaf_gives_what_the_plain_form_gives():
    down, right = jax.random.normal(jax.random.key(0), (2, 33, 47), jnp.float32)
    plain = jax.jit(_to_unit_ball)(down, right)
    found = jax.jit(lambda *given: leaf_by_leaf(_to_unit_ball, *given))(down, right)
    for ours, theirs in zip(found, plain, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=3e-7)  # rounding: kernels may differ in how they fuse


def test_leaf_by_leaf_calculates_each_leaf_apart():
    """In the compiled program the root, which both leaves share, is there once for each."""
    given = jnp.ones((2, 8, 8), jnp.float32)

    def roots(function) -> int:
        return str(jax.make_jaxpr(function)(*given)).count(" sqrt ")

    assert roots(_to_unit_ball) == 1
    assert roots(lambda *given: leaf_by_leaf(_to_unit_ball, *given)) == 2
