"""The gradient module: its folding, its resolutions, and that it starts from the picture it is given."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learned.networks.gradient import GradientModule
from learned.networks.layers import fold, scale_down, scale_up, unfold


def tiny(scale: int, working_scale: int) -> GradientModule:
    sizes = {"degradation": 1, "refinement": 1, "groups": 1, "levels": 1}
    return GradientModule(2, 4, scale=scale, working_scale=working_scale, deform=True, key=jax.random.key(0), **sizes)


def test_folding_takes_blocks_apart_and_puts_them_together():
    x = jnp.arange(2 * 4 * 6, dtype=jnp.float32).reshape(2, 4, 6)
    folded = fold(x, 2)
    assert folded.shape == (8, 2, 3)
    for c, i, j in np.ndindex(2, 2, 2):
        np.testing.assert_array_equal(folded[4 * c + 2 * i + j], x[c, i::2, j::2])
    np.testing.assert_array_equal(unfold(folded, 2), x)


@pytest.mark.parametrize("scale", [1, 2, 3, 4])
def test_scaling_down_and_up_are_opposite_in_size(scale: int):
    key = jax.random.key(0)
    small, large = jnp.zeros((2, 5, 7)), jnp.zeros((3, 5 * scale, 7 * scale))
    assert eqx.filter_eval_shape(scale_up(2, 3, scale, key=key), small).shape == large.shape
    assert eqx.filter_eval_shape(scale_down(3, 2, scale, key=key), large).shape == small.shape


@pytest.mark.parametrize(("scale", "working_scale"), [(1, 1), (2, 1), (4, 2), (3, 3)])
def test_it_works_at_any_resolution_between(scale: int, working_scale: int):
    def step(image: jax.Array, latent: jax.Array) -> jax.Array:
        return tiny(scale, working_scale)(image, latent)

    shape = (5 * scale, 7 * scale)
    assert eqx.filter_eval_shape(step, jnp.zeros(shape), jnp.zeros((3, 2, 5, 7))).shape == shape


def test_the_step_is_what_the_output_convolution_says():
    """Eq. 13: with that convolution at zero R is X; with it at a constant, X less the constant."""
    module = eqx.filter_jit(tiny)(2, 1)
    rng = np.random.default_rng(0)
    image, latent = (jnp.asarray(rng.random(shape), jnp.float32) for shape in ((6, 8), (3, 2, 3, 4)))
    still = eqx.tree_at(
        lambda m: (m.output.weight, m.output.bias),
        module,
        replace_fn=jnp.zeros_like,
    )
    constant = eqx.tree_at(lambda m: m.output.bias, still, jnp.full((4, 1, 1), 0.25))
    run = eqx.filter_jit(lambda m, i, y: m(i, y))
    np.testing.assert_array_equal(run(still, image, latent), image)
    np.testing.assert_allclose(run(constant, image, latent), image - 0.25, atol=1e-6)
    # And as it comes it looks at every moment.
    moved = run(module, image, latent)
    for moment in range(3):
        assert float(jnp.abs(run(module, image, latent.at[moment].add(1)) - moved).max()) > 1e-6
