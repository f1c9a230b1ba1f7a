"""Spikes to latent intensity: short-term blocks around the key frame and the pixel-adaptive spike encoder (PASE)."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from learned.networks.layers import ResidualBlocks, convolution, leaky
from scsr_opt.errors import InputError


def spike_blocks(
    spikes: Shaped[Array, "T h w"], key_frame: Int[Array, ""] | int, blocks: int, length: int, spacing: int
) -> Shaped[Array, "n L h w"]:
    """Short-term spike blocks B_1 … B_n around the key frame (paper, "Overall pipeline").

    Block i has `length` frames, and its middle frame is (i − k)·spacing frames after the key frame, k = n // 2 the
    block of the key frame itself (counted from 0). With spacing < length they overlap.

    A block that would reach over an end of the recording is moved inwards until it just fits: every frame is one that
    was recorded, none is invented. Near an end several blocks may therefore show the same frames, and the key frame may
    lie away from the middle of its block.

    **Arguments:**
    - `spikes`: frames of any dtype, time first.
    - `key_frame`: 0 to T − 1; it may be traced, and is then not checked but brought into that range.
    - `blocks`: n, odd, so that as many blocks lie before the key frame as after it.
    - `length`: L, frames in a block, at most T.
    - `spacing`: frames from one block to the next, ≥ 1.

    **Raises:** `InputError` for a recording that is shorter than a block, a key frame outside it, an even number of
    blocks, or a length or spacing below 1.
    """
    frames = spikes.shape[0]
    check_blocks(blocks, length, spacing)
    if frames < length:
        raise InputError(
            f"The recording has {frames} frames and a spike block {length}; it must have at least as many as a block: "
            "take a longer part of the recording or a network with shorter blocks."
        )
    if isinstance(key_frame, int) and not 0 <= key_frame < frames:
        raise InputError(f"The key frame is {key_frame}; in a recording of {frames} frames it is 0 to {frames - 1}.")
    starts = _starts(frames, key_frame, blocks, length, spacing)
    return jax.vmap(lambda start: jax.lax.dynamic_slice_in_dim(spikes, start, length))(starts)


def block_times(
    frames: int, key_frame: Int[Array, ""] | int, blocks: int, length: int, spacing: int
) -> Float[Array, " n"]:
    """Middles of the blocks that `spike_blocks` takes of a recording of `frames`, in frames after the key frame."""
    middles = _starts(frames, key_frame, blocks, length, spacing).astype(jnp.float32) + (length - 1) / 2
    return middles - jnp.asarray(key_frame, jnp.float32)


def _starts(frames: int, key_frame: Int[Array, ""] | int, blocks: int, length: int, spacing: int) -> Int[Array, " n"]:
    """The first frame of each block."""
    away = spacing * (jnp.arange(blocks, dtype=jnp.int32) - blocks // 2)
    starts = jnp.asarray(key_frame, jnp.int32) - length // 2 + away
    return jnp.clip(starts, 0, frames - length)


def check_blocks(blocks: int, length: int, spacing: int) -> None:
    """**Raises:** `InputError` unless the blocks are an odd number, and length and spacing at least 1."""
    if blocks < 1 or blocks % 2 == 0:
        raise InputError(f"The number of spike blocks is {blocks}; it must be odd, 1, 3, 5, …, one in the middle.")
    if length < 1 or spacing < 1:
        raise InputError(f"Spike blocks have length {length} and spacing {spacing}; both must be at least 1 frame.")


class PASE(eqx.Module):
    """The pixel-adaptive spike encoder E of Eq. 3 and 7: a linear filter of its own for each pixel of a block.

    A network looks at the block and predicts, for each branch j and pixel (x, y), a filter 𝒦_j(x, y) of K_j×K_j×L
    values; the latent intensity is the filter's sum over the spikes P_j(x, y) around the pixel,

        Y^j(x, y) = Σ 𝒦_j(x, y) ⊗ P_j(x, y).

    Where all stands still the filter can be long and wide, where something moves fast, short and narrow. The branches
    are stacked as channels, C of them.

    The kernel predictor is a convolution, four residual blocks and a convolution, as the paper says. Left open there,
    chosen here: all branches share one predictor up to its last layer, which is 1×1; the features φ have `channels`
    channels; around the picture the spikes of its edge are repeated. At the start every filter is near the mean over
    its patch, so that Y begins as the local firing rate.

    A last layer of 1×1 makes the filter at each pixel a mixture of as many fixed ones as there are features,
    𝒦(x, y) = Σ_c φ_c(x, y) W_c + b, and the sum may be exchanged with Eq. 7's:

        Y = Σ_c φ_c · (W_c ∗ S) + b ∗ S.

    These are ordinary convolutions of the block S. The K²·L values a pixel are never laid out, which is 6 to 10 times
    as fast (30 blocks of 40×40, K = 3: 4 ms for 34 ms, with gradient 26 for 143).

    **Arguments:**
    - `length`: L, frames in a block.
    - `branches`: the filter sizes K_j, odd; the same size may appear more than once.
    - `channels`, `blocks`: of the kernel predictor.

    **Raises:** `InputError` for no branch or an even filter size.
    """

    first: eqx.nn.Conv2d
    trunk: ResidualBlocks
    banks: tuple[Float[Array, "filters L K K"], ...]
    """For each branch the filters W_c and, last, b."""

    def __init__(self, length: int, branches: tuple[int, ...], channels: int, blocks: int = 4, *, key: PRNGKeyArray):
        check_branches(branches)
        first, trunk, *banks = jax.random.split(key, 2 + len(branches))
        self.first = convolution(length, channels, key=first)
        self.trunk = ResidualBlocks(channels, blocks, key=trunk)
        self.banks = tuple(
            _near_mean(channels, (length, size, size), key=k) for size, k in zip(branches, banks, strict=True)
        )

    def __call__(self, block: Float[Array, "L h w"]) -> Float[Array, "C h w"]:
        """**Arguments:** `block`: spikes divided by `white_rate`, so that their mean over time is intensity."""
        features = self._features(block)
        return jnp.stack([(features * _filtered(block, bank)).sum(0) for bank in self.banks])

    def kernels(self, block: Float[Array, "L h w"]) -> tuple[Float[Array, "L K K h w"], ...]:
        """The filters 𝒦_j of Eq. 7 at every pixel, one array a branch: to look at what the encoder does."""
        features = self._features(block)
        return tuple(jnp.einsum("chw,clij->lijhw", features, bank) for bank in self.banks)

    def _features(self, block: Float[Array, "L h w"]) -> Float[Array, "filters h w"]:
        """φ, and a channel of ones for b."""
        features = leaky(self.trunk(leaky(self.first(block))))
        return jnp.concatenate([features, jnp.ones_like(features[:1])])


def check_branches(branches: tuple[int, ...]) -> None:
    """**Raises:** `InputError` unless there is a branch and each filter size is odd."""
    if not branches or any(size < 1 or size % 2 == 0 for size in branches):
        raise InputError(f"The filter sizes of PASE are {branches}; there must be at least one, each odd: 1, 3, 5, ….")


def _near_mean(channels: int, shape: tuple[int, int, int], *, key: PRNGKeyArray) -> Float[Array, "filters L K K"]:
    """b the mean over the patch, W_c about as large and random."""
    spread = 1 / (math.sqrt(channels) * math.prod(shape))
    random = jax.random.uniform(key, (channels, *shape), minval=-spread, maxval=spread)
    return jnp.concatenate([random, jnp.full((1, *shape), 1 / math.prod(shape), random.dtype)])


def _filtered(block: Float[Array, "L h w"], bank: Float[Array, "filters L K K"]) -> Float[Array, "filters h w"]:
    """The block's sums with each filter around each pixel, the edge repeated outwards."""
    reach = bank.shape[-1] // 2
    padded = jnp.pad(block, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    return jax.lax.conv_general_dilated(padded[None], bank, (1, 1), "VALID")[0]
