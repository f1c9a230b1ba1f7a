"""Deformable convolution against its definition written as loops, values worked out by hand, and its gradients."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learned.networks.deformable import Align, deformable_convolution
from scsr_opt.errors import InputError


def by_definition(features, offset, mask, weight, bias, stride, padding, dilation):
    """DCNv2, Eq. 1, tap by tap; bilinear weights max(0, 1 − |distance|) over all pixels, so zeros outside."""
    channels, rows, columns = features.shape
    outputs, _, tall, wide = weight.shape
    _, high, broad = offset.shape
    groups = offset.shape[0] // (2 * tall * wide)
    result = np.zeros((outputs, high, broad))
    for y, x, i, j, c in np.ndindex(high, broad, tall, wide, channels):
        tap = (c // (channels // groups)) * tall * wide + i * wide + j
        row = stride * y - padding + dilation * i + offset[2 * tap, y, x]
        column = stride * x - padding + dilation * j + offset[2 * tap + 1, y, x]
        down = np.maximum(0, 1 - np.abs(np.arange(rows) - row))
        right = np.maximum(0, 1 - np.abs(np.arange(columns) - column))
        result[:, y, x] += weight[:, c, i, j] * mask[tap, y, x] * (down @ features[c] @ right)
    return result + bias[:, None, None]


def case(groups=2, stride=1, padding=1, dilation=1, kernel=(3, 3), spread=2.0):
    rng = np.random.default_rng(0)
    features = rng.standard_normal((4, 5, 6))
    tall, wide = kernel
    high = (5 + 2 * padding - dilation * (tall - 1) - 1) // stride + 1
    broad = (6 + 2 * padding - dilation * (wide - 1) - 1) // stride + 1
    offset = spread * rng.standard_normal((2 * groups * tall * wide, high, broad))
    mask = rng.uniform(0, 2, (groups * tall * wide, high, broad))
    return features, offset, mask, rng.standard_normal((3, 4, tall, wide)), rng.standard_normal(3)


SETTINGS = [
    {},
    {"groups": 1, "stride": 2},
    {"groups": 4, "padding": 2, "dilation": 2},
    {"kernel": (1, 3), "padding": 0},
    {"spread": 20.0},
]


@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_it_is_the_definition(setting):
    arrays = case(**setting)
    how = {name: setting.get(name, default) for name, default in (("stride", 1), ("padding", 1), ("dilation", 1))}
    with jax.enable_x64(True):
        found = jax.jit(lambda *a: deformable_convolution(*a, **how))(*map(jnp.asarray, arrays))
    # Sums of 36 products of numbers near 1 in float64.
    np.testing.assert_allclose(found, by_definition(*arrays, *how.values()), rtol=1e-12, atol=1e-12)


def test_without_offsets_it_is_a_convolution():
    features, offset, _, weight, bias = (jnp.asarray(a, jnp.float32) for a in case())
    plain = jax.lax.conv_general_dilated(features[None], weight, (1, 1), "SAME")[0] + bias[:, None, None]
    # 36 products of numbers near 1, each rounded to 6e-8.
    np.testing.assert_allclose(
        deformable_convolution(features, 0 * offset, None, weight, bias, padding=1), plain, atol=1e-5
    )


def one_tap(down: float, right: float, shown: float = 1.0) -> float:
    """Value that a 1×1 kernel of 1 reads of [[1, 2], [3, 4]] at (0, 0) plus the offset."""
    features = jnp.asarray([[[1.0, 2.0], [3.0, 4.0]]])
    offset = jnp.zeros((2, 2, 2)).at[:, 0, 0].set(jnp.asarray([down, right]))
    mask = jnp.full((1, 2, 2), shown)
    return float(deformable_convolution(features, offset, mask, jnp.ones((1, 1, 1, 1)))[0, 0, 0])


@pytest.mark.parametrize(
    ("down", "right", "expected"),
    [
        (0.0, 0.0, 1.0),
        (1.0, 0.0, 3.0),  # the first offset is down,
        (0.0, 1.0, 2.0),  # the second right
        (0.5, 0.5, 2.5),
        (0.25, 0.5, 0.75 * 1.5 + 0.25 * 3.5),
        (-0.5, 0.0, 0.5),  # half way into the zeros outside
        (1.5, 1.0, 2.0),
        (-1.0, 0.0, 0.0),
        (2.0, 0.0, 0.0),
        (1e9, 0.0, 0.0),
        (float("nan"), 0.0, 0.0),
        (0.0, float("inf"), 0.0),
    ],
)
def test_values_by_hand(down, right, expected):
    assert one_tap(down, right) == pytest.approx(expected, abs=1e-6)
    assert one_tap(down, right, shown=0.5) == pytest.approx(expected / 2, abs=1e-6)


@pytest.mark.parametrize("which", range(5), ids=["features", "offset", "mask", "weight", "bias"])
def test_gradients_are_those_of_finite_differences(which):
    with jax.enable_x64(True):
        arrays = [jnp.asarray(a) for a in case()]
        rng = np.random.default_rng(1)
        weigh = jnp.asarray(rng.standard_normal((3, 5, 6)))

        @jax.jit
        def value(x):
            given = [*arrays[:which], x, *arrays[which + 1 :]]
            return jnp.sum(weigh * deformable_convolution(*given, padding=1))

        slope = np.asarray(jax.grad(value)(arrays[which]))
        for _ in range(4):
            # Of random offsets none lies within the step of a whole number, where the derivative jumps.
            direction = rng.standard_normal(slope.shape)
            step = 1e-6
            there, back = (value(arrays[which] + sign * step * direction) for sign in (1, -1))
            # Central differences: rounding of sums near 100, 1e-14·100/1e-6, is the larger error.
            np.testing.assert_allclose((there - back) / (2 * step), np.sum(slope * direction), rtol=1e-5, atol=1e-5)


def test_batched_it_is_the_same():
    arrays = [jnp.asarray(a, jnp.float32) for a in case()]
    several = [jnp.stack([a, 0.9 * a]) for a in arrays[:3]]

    def value(*given):
        return jnp.sum(deformable_convolution(*given, *arrays[3:], padding=1) ** 2)

    slopes = jax.jit(jax.grad(value, (0, 1, 2)))
    together = jax.vmap(slopes)(*several)
    for number in range(2):
        alone = slopes(*(a[number] for a in several))
        for one, other in zip(together, alone, strict=True):
            # Sums of about a hundred products up to 100, each rounded to 6e-8 of itself.
            np.testing.assert_allclose(one[number], other, rtol=1e-3, atol=1e-3)


def test_shapes_that_do_not_belong_together():
    features, offset, mask, weight, bias = (jnp.asarray(a, jnp.float32) for a in case())
    with pytest.raises(InputError, match="must be"):
        deformable_convolution(features, offset[:-1], mask, weight, bias, padding=1)
    with pytest.raises(InputError, match="mask"):
        deformable_convolution(features, offset, mask[:-1], weight, bias, padding=1)
    with pytest.raises(InputError, match="output of"):
        deformable_convolution(features, offset, mask, weight, bias, padding=0)


def test_alignment_starts_as_a_plain_convolution():
    align = eqx.filter_jit(Align)(6, 4, groups=2, levels=2, key=jax.random.key(0))
    plain = eqx.tree_at(lambda a: a.predictor, align, None, is_leaf=lambda x: x is None)
    features = jax.random.normal(jax.random.key(1), (6, 7, 9))
    # The same sum of 36 products in another order.
    np.testing.assert_allclose(
        eqx.filter_jit(align)(features[:2], features[2:]), eqx.filter_jit(plain)(features), atol=1e-5
    )


def test_alignment_can_follow_motion():
    """With a constant offset of (1, −2) the result is that of the plain one, moved."""
    align = eqx.filter_jit(Align)(3, 4, groups=2, levels=1, key=jax.random.key(0))
    offsets = jnp.tile(jnp.asarray([1.0, -2.0]), 18)
    moved = eqx.tree_at(
        lambda a: a.predictor.last.bias, align, replace_fn=lambda b: jnp.zeros_like(b).at[:36, 0, 0].set(offsets)
    )
    features = jax.random.normal(jax.random.key(1), (3, 12, 12))
    found, plain = (eqx.filter_jit(a)(features) for a in (moved, align))
    np.testing.assert_allclose(found[:, 2:-3, 4:-2], plain[:, 3:-2, 2:-4], atol=1e-5)


def test_groups_divide_the_channels():
    with pytest.raises(InputError, match="divide"):
        Align(3, 4, groups=3, levels=1, key=jax.random.key(0))


def test_a_guide_says_where_to_read():
    """With no offset of its own it is a convolution of what lies two down and one left of each pixel."""
    align = Align(3, 4, 2, 1, key=jax.random.key(0))
    features = jax.random.normal(jax.random.key(1), (3, 9, 10))
    guide = jnp.broadcast_to(jnp.array([2.0, -1.0])[:, None, None], (2, 9, 10))
    found, plain = align(features, guide=guide), align(features)
    np.testing.assert_allclose(found[:, 1:5, 3:8], plain[:, 3:7, 2:7], atol=1e-5)
    assert bool(jnp.any(jnp.abs(found - plain) > 1e-3))


def test_half_precision_sums_what_many_places_read():
    """400 places read one pixel: its gradient is 400, where sums in bfloat16 would not get beyond 256."""
    row, column = jnp.meshgrid(jnp.arange(20), jnp.arange(20), indexing="ij")
    offset = jnp.stack([5 - row, 7 - column]).astype(jnp.float32)
    weight = jnp.ones((1, 1, 1, 1), jnp.bfloat16)

    def total(features: jax.Array) -> jax.Array:
        return jnp.sum(deformable_convolution(features, offset, None, weight).astype(jnp.float32))

    gradient = jax.grad(total)(jnp.ones((1, 20, 20), jnp.bfloat16))
    assert gradient.dtype == jnp.bfloat16
    assert float(gradient[0, 5, 7]) == 400 and float(jnp.abs(gradient).sum()) == 400
