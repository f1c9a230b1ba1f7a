"""Spike blocks and the pixel-adaptive encoder: which frames, which filters, and Eq. 7 as it is written."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learned.networks.encoder import PASE, spike_blocks
from scsr_opt.errors import InputError


def counted(frames: int) -> jax.Array:
    """Frames that hold their own number."""
    return jnp.broadcast_to(jnp.arange(frames, dtype=jnp.int32)[:, None, None], (frames, 2, 3))


def shown(frames: int, key_frame, blocks: int, length: int, spacing: int) -> list[list[int]]:
    return np.asarray(spike_blocks(counted(frames), key_frame, blocks, length, spacing))[:, :, 0, 0].tolist()


def test_blocks_lie_around_the_key_frame():
    assert shown(20, 10, 3, 5, 3) == [[5, 6, 7, 8, 9], [8, 9, 10, 11, 12], [11, 12, 13, 14, 15]]
    assert shown(20, 10, 1, 1, 1) == [[10]]
    blocks = spike_blocks(jnp.zeros((41, 4, 5), jnp.uint8), 20, 5, 13, 7)
    assert blocks.shape == (5, 13, 4, 5) and blocks.dtype == jnp.uint8
    assert shown(41, 20, 5, 13, 7)[0][0] == 0 and shown(41, 20, 5, 13, 7)[-1][-1] == 40


def test_at_the_ends_blocks_move_inwards():
    assert shown(9, 0, 3, 3, 2) == [[0, 1, 2], [0, 1, 2], [1, 2, 3]]
    assert shown(9, 8, 3, 3, 2) == [[5, 6, 7], [6, 7, 8], [6, 7, 8]]
    assert shown(3, 1, 3, 3, 2) == [[0, 1, 2]] * 3


def test_a_traced_key_frame_gives_the_same():
    traced = jax.jit(lambda key: spike_blocks(counted(20), key, 3, 5, 3))(jnp.asarray(10, jnp.int32))
    np.testing.assert_array_equal(traced, spike_blocks(counted(20), 10, 3, 5, 3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((4, 2, 3, 5, 1), "has 4 frames and a spike block 5"),
        ((9, 9, 3, 5, 1), "0 to 8"),
        ((9, -1, 3, 5, 1), "0 to 8"),
        ((9, 4, 2, 5, 1), "odd"),
        ((9, 4, 3, 0, 1), "at least 1 frame"),
        ((9, 4, 3, 5, 0), "at least 1 frame"),
    ],
)
def test_blocks_that_cannot_be(arguments, message):
    frames, *others = arguments
    with pytest.raises(InputError, match=message):
        spike_blocks(counted(frames), *others)


@pytest.fixture(scope="module")
def encoder() -> PASE:
    encoder = eqx.filter_jit(PASE)(4, (1, 3, 5, 3), 3, key=jax.random.key(0))
    # Far from the start, where all filters are nearly means.
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda x: x + jnp.asarray(0.3 * rng.standard_normal(x.shape), x.dtype), encoder)


def test_each_pixel_is_filtered_by_its_own_kernel(encoder: PASE):
    """Eq. 7 as it is written: patch times kernel, pixel by pixel."""
    block = np.random.default_rng(0).integers(0, 2, (4, 5, 7)).astype(np.float32)
    found, kernels = eqx.filter_jit(lambda e, b: (e(b), e.kernels(b)))(encoder, jnp.asarray(block))
    assert found.shape == (4, 5, 7) and [k.shape[1] for k in kernels] == [1, 3, 5, 3]
    for branch, kernel in enumerate(np.asarray(k, np.float64) for k in kernels):
        size = kernel.shape[1]
        padded = np.pad(block, ((0, 0), (size // 2,) * 2, (size // 2,) * 2), mode="edge")
        for y, x in np.ndindex(5, 7):
            expected = np.sum(kernel[..., y, x] * padded[:, y : y + size, x : x + size])
            # At most 100 products near 1, each rounded to 6e-8.
            assert float(found[branch, y, x]) == pytest.approx(expected, abs=1e-4)


def test_kernels_adapt_to_the_pixel(encoder: PASE):
    block = jnp.asarray(np.random.default_rng(0).integers(0, 2, (4, 9, 9)), jnp.float32)
    assert all(float(jnp.std(kernel, axis=(3, 4)).min()) > 0 for kernel in eqx.filter_jit(encoder.kernels)(block))


def test_at_the_start_the_encoder_measures_intensity():
    """A still, even scene at intensity 0.5: every filter is a mean, give or take its random part."""
    encoder = eqx.filter_jit(PASE)(12, (1, 3), 16, key=jax.random.key(0))
    spikes = np.zeros((12, 6, 6), np.float32)
    spikes[::4] = 1
    np.testing.assert_allclose(eqx.filter_jit(encoder)(jnp.asarray(spikes / 0.5)), 0.5, atol=0.25)


@pytest.mark.parametrize("branches", [(), (2,), (3, 0)])
def test_filter_sizes_that_cannot_be(branches):
    with pytest.raises(InputError, match="odd"):
        PASE(4, branches, 3, key=jax.random.key(0))
