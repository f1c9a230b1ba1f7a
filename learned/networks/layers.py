"""The small parts that all networks are built from: convolutions, residual blocks, and folding pixels into channels.

Every layer works on one picture of features, (channels, rows, columns), without a batch axis; a caller with several
maps over it (`jax.vmap`), which makes one convolution of them all.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from scsr_opt.errors import InputError

LEAST_SIDE = 8
"""Fewest sensor pixels a side that a SpikeSR-Net takes; smaller pictures are continued. Its convolutions see zeros
beyond a border, which training has on one side at a time: `spikesr-small` made 1×1 sensors 17 % too dark, 2×2 1 %."""


def check_sizes(config: Any, **least: int) -> None:
    """**Raises:** `InputError` if a field of the configuration is below the number that is given for its name."""
    for name, number in least.items():
        if getattr(config, name) < number:
            raise InputError(f"{name} is {getattr(config, name)}; it must be at least {number}.")


def at_least_float32(dtype: DTypeLike) -> DTypeLike:
    """The dtype of pictures and positions in a network of this dtype: half precision is enough for features only."""
    return dtype if jnp.finfo(dtype).bits >= 32 else jnp.float32


def leaky(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Leaky ReLU, max(x, 0.1 x), the activation everywhere but in the gates: no unit can fall silent for good."""
    return jnp.where(x >= 0, x, 0.1 * x)


def continued(x: Shaped[Array, "*n h w"], unit: int = 1) -> tuple[Shaped[Array, "*n k l"], tuple[slice, slice]]:
    """Small pictures with their mirror images around them, `LEAST_SIDE` units a side at least, and the rows and columns
    of the result that they are themselves.

    **Arguments:** `unit`: pixels of `x` to one that counts, such as the scale where `x` is of the high resolution.
    """
    more = [max(LEAST_SIDE * unit - length, 0) for length in x.shape[-2:]]
    before = [missing // 2 // unit * unit for missing in more]
    rows, columns = (slice(begin, begin + length) for begin, length in zip(before, x.shape[-2:], strict=True))
    border = [(0, 0)] * (x.ndim - 2) + [(begin, whole - begin) for begin, whole in zip(before, more, strict=True)]
    return (jnp.pad(x, border, mode="symmetric") if any(more) else x), (rows, columns)


def convolution(
    inputs: int, outputs: int, *, size: int = 3, stride: int = 1, shrink: float | int = 1.0, key: PRNGKeyArray
) -> eqx.nn.Conv2d:
    """A convolution with zeros outside; with stride 1 and an odd size the picture keeps its size.

    **Arguments:**
    - `shrink`: factor on the first weights and biases. A layer that adds a correction to something good starts small,
      0.1, and not at 0, which would keep the gradient from all that is before it.
    """
    layer = eqx.nn.Conv2d(inputs, outputs, size, stride=stride, padding=(size - 1) // 2, key=key)
    return eqx.tree_at(lambda c: (c.weight, c.bias), layer, replace_fn=lambda x: shrink * x)


def scale_down(inputs: int, outputs: int, scale: int, *, key: PRNGKeyArray) -> eqx.nn.Conv2d:
    """D_s of Eq. 9: a convolution with the stride s, (inputs, s·h, s·w) -> (outputs, h, w).

    Its kernel is s + 2 wide, so that each output sees its s×s block and one pixel around it. The paper gives the stride
    only.
    """
    return eqx.nn.Conv2d(inputs, outputs, scale + 2, stride=scale, padding=1, key=key)


def scale_up(inputs: int, outputs: int, scale: int, *, key: PRNGKeyArray) -> eqx.nn.ConvTranspose2d:
    """D_s⁻¹ of Eq. 8 and 10: a transposed convolution with the stride s, (inputs, h, w) -> (outputs, s·h, s·w)."""
    return eqx.nn.ConvTranspose2d(inputs, outputs, scale + 2, stride=scale, padding=1, key=key)


class ResidualBlocks(eqx.Module):
    """`count` times x + conv(leaky(conv(x))), 3×3 (He, Zhang, Ren, Sun, 2016), without normalisation.

    Normalisation is left out as in networks that restore pictures (Lim et al., 2017): intensity is what is measured.
    """

    first: tuple[eqx.nn.Conv2d, ...]
    second: tuple[eqx.nn.Conv2d, ...]

    def __init__(self, channels: int, count: int, *, key: PRNGKeyArray):
        keys = jax.random.split(key, 2 * count)
        layers = [convolution(channels, channels, key=k) for k in keys]
        self.first, self.second = tuple(layers[::2]), tuple(layers[1::2])

    def __call__(self, x: Float[Array, "c h w"]) -> Float[Array, "c h w"]:
        for first, second in zip(self.first, self.second, strict=True):
            x = x + second(leaky(first(x)))
        return x


def fold(x: Float[Array, "c H W"], factor: int) -> Float[Array, "d h w"]:
    """Each block of factor×factor pixels becomes channels of one pixel: (c, f·h, f·w) -> (c·f², h, w).

    Channel c·f² + i·f + j of the result holds the pixels i rows and j columns into their block. Nothing is lost;
    `unfold` goes back.
    """
    channels, rows, columns = x.shape
    blocks = x.reshape(channels, rows // factor, factor, columns // factor, factor)
    return blocks.transpose(0, 2, 4, 1, 3).reshape(channels * factor**2, rows // factor, columns // factor)


def unfold(x: Float[Array, "d h w"], factor: int) -> Float[Array, "c H W"]:
    """The inverse of `fold` (the pixel shuffle of Shi et al., 2016): (c·f², h, w) -> (c, f·h, f·w)."""
    channels, rows, columns = x.shape
    blocks = x.reshape(channels // factor**2, factor, factor, rows, columns)
    return blocks.transpose(0, 3, 1, 4, 2).reshape(channels // factor**2, rows * factor, columns * factor)
