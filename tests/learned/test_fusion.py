"""ConvGRU as Eq. 12 is written, and that both directions end at the key frame."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from learned.networks.fusion import BidirectionalFusion, ConvGRU


def convolved(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """A 3×3 convolution as deep learning has it, zeros outside."""
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    _, rows, columns = x.shape
    shifted = np.stack([padded[:, i : i + rows, j : j + columns] for i, j in np.ndindex(3, 3)])
    return np.einsum("oct,tchw->ohw", weight.reshape(*weight.shape[:2], 9), shifted)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def by_equation(gru: ConvGRU, features: np.ndarray) -> np.ndarray:
    """Eq. 12 with each convolution over the concatenation [H, G]."""
    given, gates, new = (np.asarray(c.weight) for c in (gru.from_input, gru.gates_from_state, gru.new_from_state))
    update_bias, reset_bias, new_bias = np.split(np.asarray(gru.from_input.bias), 3)
    update, reset, fresh = (
        np.concatenate(pair, axis=1) for pair in zip([*np.split(gates, 2), new], np.split(given, 3), strict=True)
    )
    state = np.zeros((len(new), *features.shape[2:]))
    for moment in features:
        both = np.concatenate([state, moment])
        taken = sigmoid(convolved(both, update) + update_bias)
        kept = sigmoid(convolved(both, reset) + reset_bias)
        q = np.tanh(convolved(np.concatenate([kept * state, moment]), fresh) + new_bias)
        state = (1 - taken) * state + taken * q
    return state


def test_it_is_equation_12():
    gru = eqx.filter_jit(ConvGRU)(2, 3, key=jax.random.key(0))
    features = np.random.default_rng(0).standard_normal((4, 2, 5, 6)).astype(np.float32)
    # Values below 1 from sums of 45 products in float32.
    np.testing.assert_allclose(eqx.filter_jit(gru)(jnp.asarray(features)), by_equation(gru, features), atol=1e-5)


def test_both_directions_end_at_the_key_frame():
    fusion = eqx.filter_jit(BidirectionalFusion)(2, 3, key=jax.random.key(0))
    features = jnp.asarray(np.random.default_rng(0).standard_normal((5, 2, 4, 6)), jnp.float32)
    found = eqx.filter_jit(fusion)(features, 2)
    forward = by_equation(fusion.forward, np.asarray(features[:3]))
    backward = by_equation(fusion.backward, np.asarray(features[:1:-1]))
    np.testing.assert_allclose(found, np.concatenate([forward, backward]), atol=1e-5)
