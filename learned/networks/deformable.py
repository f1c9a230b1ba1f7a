"""Motion T_{k→i} of a network: modulated deformable convolution with learned offsets (Eq. 8 and 11).

A deformable convolution reads each tap of its kernel at a place of its own, given pixel by pixel by an offset, and
weighs it by a mask: Dai et al., "Deformable convolutional networks", ICCV 2017 (offsets); Zhu, Hu, Lin, Dai,
"Deformable ConvNets v2", CVPR 2019 (masks).
"""

import functools
from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from learned.networks.layers import at_least_float32, convolution, leaky
from scsr_opt.errors import InputError


def deformable_convolution(
    features: Float[Array, "c h w"],
    offset: Float[Array, "offsets oh ow"],
    mask: Float[Array, "masks oh ow"] | None,
    weight: Float[Array, "d c kh kw"],
    bias: Float[Array, "d"] | None = None,
    *,
    stride: int = 1,
    padding: int = 0,
    dilation: int = 1,
) -> Float[Array, "d oh ow"]:
    """Modulated deformable convolution (DCNv2, Zhu et al. 2019, Eq. 1):

        output(p) = Σ_taps weight(tap) · mask(tap, p) · features(stride·p − padding + dilation·tap + offset(tap, p)),

    features between pixels by bilinear interpolation, with zeros outside. The input channels fall into G equal groups,
    each with offsets and masks of its own. Where an offset is not finite the tap reads nothing.

    All arrays are laid out as `torchvision.ops.deform_conv2d` has them, without the batch axis.

    **Arguments:**
    - `offset`: (2·G·kh·kw, oh, ow), in pixels; channel 2·(g·kh·kw + tap) is down, the next one right.
    - `mask`: (G·kh·kw, oh, ow), or None for 1 everywhere.
    - `weight`: (outputs, inputs, kh, kw); tap = row·kw + column.

    **Returns:** (d, oh, ow), oh = (h + 2·padding − dilation·(kh − 1) − 1) // stride + 1, ow alike. It can be
    differentiated in all five arrays; in the offset piecewise, at whole pixels towards larger positions.

    **Raises:** `InputError` if the shapes do not belong together.
    """
    channels, rows, columns = features.shape
    outputs, _, tall, wide = weight.shape
    taps = tall * wide
    shape = (_extent(rows, tall, stride, padding, dilation), _extent(columns, wide, stride, padding, dilation))
    groups = _checked_groups(channels, offset.shape, None if mask is None else mask.shape, taps, shape)

    # Far from the origin half precision would lose the fraction of a position.
    precise = at_least_float32(offset.dtype)
    place = offset.astype(precise).reshape(groups, taps, 2, *shape)
    down, right = jnp.divmod(jnp.arange(taps, dtype=jnp.int32), wide)
    grid_row = stride * jnp.arange(shape[0], dtype=jnp.int32)[None, :, None] + dilation * down[:, None, None] - padding
    grid_column = (
        stride * jnp.arange(shape[1], dtype=jnp.int32)[None, None, :] + dilation * right[:, None, None] - padding
    )
    row, below = _between(grid_row[None].astype(precise) + place[:, :, 0], rows)
    column, beside = _between(grid_column[None].astype(precise) + place[:, :, 1], columns)
    finite = jnp.all(jnp.isfinite(place), axis=2)
    shown = finite if mask is None else jnp.where(finite, mask.astype(precise).reshape(finite.shape), 0)
    shown = shown.astype(precise)

    padded = jnp.pad(features, ((0, 0), (1, 1), (1, 1))).transpose(1, 2, 0)
    across = columns + 2
    table = padded.reshape((rows + 2) * across, groups, channels // groups)
    index = (row * across + column).reshape(groups, -1)
    shares = [(1 - below) * (1 - beside), (1 - below) * beside, below * (1 - beside), below * beside]
    shares = jnp.stack([(shown * s).reshape(groups, -1) for s in shares], axis=2).astype(features.dtype)

    kernel = weight.reshape(outputs, groups, channels // groups, taps)
    output = jnp.zeros((outputs, shape[0] * shape[1]), features.dtype)
    for g in range(groups):
        # A function with a gradient of its own has lost its type.
        read = cast(Array, _read(across, table[:, g], index[g], shares[g])).reshape(taps, -1, channels // groups)
        output = output + jnp.einsum("tpc,oct->op", read, kernel[:, g])
    if bias is not None:
        output = output + bias[:, None]
    return output.reshape(outputs, *shape)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _read(
    across: int, table: Float[Array, "pixels c"], index: Int[Array, "places"], shares: Float[Array, "places 4"]
) -> Float[Array, "places c"]:
    """Weighted sums of four neighbouring rows of the table each: `index`, the one after it, and both `across` on.

    Batched by `jax.vmap`, on a CPU one picture comes after the other: its pixels then stay in the cache. For 30
    pictures of 40×40 with 16 channels that is 28 ms in place of 260, and 24 in place of 150 for the sums of the
    gradient. Elsewhere all are done at once.
    """

    def read(
        table: Float[Array, "pixels c"], index: Int[Array, "places"], shares: Float[Array, "places 4"]
    ) -> Float[Array, "places c"]:
        return sum(
            (shares[:, q, None] * _rows(table, index + away) for q, away in enumerate(_neighbours(across))),
            start=jnp.zeros((), table.dtype),
        )

    return _one_by_one_on_cpu(read, table, index, shares)


def _read_forward(across: int, table: Array, index: Array, shares: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    return _read(across, table, index, shares), (table, index, shares)


def _read_backward(
    across: int, kept: tuple[Array, Array, Array], change: Array
) -> tuple[Float[Array, "pixels c"], None, Float[Array, "places 4"]]:
    def spread(
        table: Float[Array, "pixels c"],
        index: Int[Array, "places"],
        shares: Float[Array, "places 4"],
        change: Float[Array, "places c"],
    ) -> tuple[Float[Array, "pixels c"], Float[Array, "places 4"]]:
        # Many places add to one pixel, more than half precision can sum; nor can an accelerator add it as fast.
        to_table, to_shares = jnp.zeros(table.shape, at_least_float32(table.dtype)), []
        for q, away in enumerate(_neighbours(across)):
            added = (shares[:, q, None] * change).astype(to_table.dtype)
            to_table = to_table.at[index + away].add(added, mode="promise_in_bounds")
            to_shares.append((_rows(table, index + away) * change).sum(1))
        return to_table.astype(table.dtype), jnp.stack(to_shares, axis=1)

    to_table, to_shares = _one_by_one_on_cpu(spread, *kept, change)
    return to_table, None, to_shares


_read.defvjp(_read_forward, _read_backward)


def _neighbours(across: int) -> tuple[int, int, int, int]:
    return 0, 1, across, across + 1


def _rows(table: Float[Array, "pixels c"], index: Int[Array, "places"]) -> Float[Array, "places c"]:
    return table.at[index].get(mode="promise_in_bounds")


def _one_by_one_on_cpu(work: Callable[..., Any], *arrays: Array) -> Any:
    """`work(*arrays)`; where `jax.vmap` batches it, one after the other on a CPU."""
    return jax.lax.platform_dependent(*arrays, cpu=jax.custom_batching.sequential_vmap(work), default=work)


def _extent(size: int, kernel: int, stride: int, padding: int, dilation: int) -> int:
    """Outputs along one axis."""
    return (size + 2 * padding - dilation * (kernel - 1) - 1) // stride + 1


def _between(position: Float[Array, "*s"], size: int) -> tuple[Int[Array, "*s"], Float[Array, "*s"]]:
    """Along one axis: the pixel at or before a position, counted from the one before the first, and the fraction
    beyond it.

    There is a pixel of zeros before the first and one after the last; what lies further out is read from them.
    """
    within = jnp.clip(jnp.where(jnp.isfinite(position), position, -1), -1, size)
    # The last pixel of zeros has none after it: it is reached as the whole fraction beyond the one before.
    before = jnp.minimum(jnp.floor(jax.lax.stop_gradient(within)), size - 1)
    return before.astype(jnp.int32) + 1, within - before


def _checked_groups(
    channels: int, offset: tuple[int, ...], mask: tuple[int, ...] | None, taps: int, shape: tuple[int, int]
) -> int:
    """G. **Raises:** `InputError` if offset, mask, features and output do not belong together."""
    groups = offset[0] // (2 * taps)
    if groups < 1 or offset != (2 * groups * taps, *shape) or channels % groups:
        raise InputError(
            f"The offset of a deformable convolution has shape {offset}; for {channels} channels, {taps} taps and an "
            f"output of {shape} it must be (2·G·{taps}, {shape[0]}, {shape[1]}), with G a divisor of {channels}."
        )
    if mask is not None and mask != (groups * taps, *shape):
        raise InputError(
            f"The mask of a deformable convolution has shape {mask}; with this offset it must be "
            f"{(groups * taps, *shape)}."
        )
    return groups


class OffsetPredictor(eqx.Module):
    """Offsets and masks from features: convolutions on ever coarser copies of them, added up again from coarse to fine.

    Each level halves the picture, so the reach grows to about 3·2^levels pixels each way: motion of many pixels can be
    seen with few layers (the idea of the pyramid of EDVR, Wang et al. 2019). The paper says only that offsets are
    learned.

    The last layer, 1×1, starts at zero: no offset, and masks of 2·sigmoid(0) = 1.
    """

    coarser: tuple[eqx.nn.Conv2d, ...]
    finer: tuple[eqx.nn.Conv2d, ...]
    last: eqx.nn.Conv2d

    def __init__(self, channels: int, groups: int, levels: int, *, key: PRNGKeyArray):
        last, *between = jax.random.split(key, 1 + 2 * levels)
        self.coarser = tuple(convolution(channels, channels, stride=2, key=k) for k in between[::2])
        self.finer = tuple(convolution(channels, channels, key=k) for k in between[1::2])
        # Down, right and mask of each tap of a 3×3 kernel.
        self.last = convolution(channels, 3 * groups * 9, size=1, shrink=0, key=last)

    def __call__(
        self, features: Float[Array, "c h w"]
    ) -> tuple[Float[Array, "offsets h w"], Float[Array, "masks h w"]]:
        found = [features]
        for layer in self.coarser:
            found.append(leaky(layer(found[-1])))
        seen = found.pop()
        for layer in self.finer:
            fine = found.pop()
            _, rows, columns = fine.shape
            seen = fine + leaky(layer(seen.repeat(2, axis=1).repeat(2, axis=2)[:, :rows, :columns]))
        values = self.last(seen)
        masks = values.shape[0] // 3
        return values[: 2 * masks], 2 * jax.nn.sigmoid(values[2 * masks :])


class Align(eqx.Module):
    """T of Eq. 8 and 11: brings features of one moment to another, (inputs, h, w) -> (channels, h, w).

    The concatenated features are mixed by a convolution; from the mixture come the offsets and masks, and it is what
    the 3×3 deformable convolution reads. At the start there is no offset: a plain convolution.

    **Arguments:**
    - `groups`: sets of offsets, each for its share of the channels; a divisor of `channels`.
    - `levels`: halvings of the picture on which motion is looked for.
    - `deform`: False leaves offsets and masks away for good (the paper's Table 2, without motion alignment).

    **Raises:** `InputError` if `groups` does not divide `channels`.
    """

    mix: eqx.nn.Conv2d
    predictor: OffsetPredictor | None
    kernel: eqx.nn.Conv2d

    def __init__(self, inputs: int, channels: int, groups: int, levels: int, deform: bool = True, *, key: PRNGKeyArray):
        if groups < 1 or channels % groups:
            raise InputError(f"Align was given {groups} groups for {channels} channels; they must divide the channels.")
        mix, predictor, kernel = jax.random.split(key, 3)
        self.mix = convolution(inputs, channels, key=mix)
        self.predictor = OffsetPredictor(channels, groups, levels, key=predictor) if deform else None
        self.kernel = convolution(channels, channels, key=kernel)

    def __call__(
        self, *features: Float[Array, "_ h w"], guide: Float[Array, "2 h w"] | None = None
    ) -> Float[Array, "c h w"]:
        """**Arguments:**
        - `features`: what is to be concatenated, `inputs` channels in all.
        - `guide`: where each pixel is to be read by what is known of the motion, down and right, in pixels away from
          it; the predicted offsets are then what is to be added. None: nothing is known.
        """
        mixed = leaky(self.mix(jnp.concatenate(features)))
        if self.predictor is None:
            return leaky(self.kernel(mixed))
        offset, mask = self.predictor(mixed)
        if guide is not None:  # many pixels away at times, of which half precision would keep no fraction
            offset = offset.astype(at_least_float32(offset.dtype))
            offset = offset + jnp.tile(guide.astype(offset.dtype), (offset.shape[0] // 2, 1, 1))
        bias = None if self.kernel.bias is None else self.kernel.bias.reshape(-1)
        return leaky(deformable_convolution(mixed, offset, mask, self.kernel.weight, bias, padding=1))
