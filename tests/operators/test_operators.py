"""One registry of operators, one test per property; then what each operator does in particular."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
from jax.typing import DTypeLike

from scsr_opt.errors import InputError
from scsr_opt.operators.blur import Blur
from scsr_opt.operators.checks import dot_test, norm_bound, spectral_norm
from scsr_opt.operators.downsample import Downsample
from scsr_opt.operators.observation import Observation
from scsr_opt.operators.operator import LinearOperator
from scsr_opt.operators.warp import Warp

SHAPE = (6, 9)
ASYMMETRIC_PSF = np.array([[0.0, 1.0, 0.0], [2.0, 3.0, 0.0], [0.0, 0.5, 4.0]])


def displacement(shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Irregular motion of a pixel or two, with some of it out of the picture and some unknown."""
    d = np.random.default_rng(7).normal(scale=1.3, size=(2, *shape))
    d[0, 0, 2] = np.nan
    d[1, shape[0] // 2, 5] = np.inf
    d[0, -1, 2] = 1e30
    return d


def motions() -> np.ndarray:
    """Three frames of motion by about half a pixel, which leave most blocks of three pixels valid."""
    d = np.random.default_rng(7).uniform(0, 0.5, size=(3, 2, *SHAPE)) * np.array([1, -1, 1])[:, None, None, None]
    d[:, :, [0, -1]] = d[:, :, :, [0, -1]] = 0
    d[1, 0, 1, 2] = np.nan
    return d


OPERATORS: dict[str, Callable[[], LinearOperator]] = {
    "warp": lambda: Warp(displacement()),
    "warp by whole pixels": lambda: Warp(np.stack([np.full(SHAPE, 2.0), np.full(SHAPE, -1.0)])),
    "blur gaussian": lambda: Blur.gaussian(SHAPE, (0.7, 1.2)),
    "blur by any psf, wider than the picture": lambda: Blur((2, 3), np.random.default_rng(1).random((7, 9))),
    "downsample": lambda: Downsample(SHAPE, 3),
    "composition": lambda: Downsample(SHAPE, 3) @ Blur(SHAPE, ASYMMETRIC_PSF) @ Warp(displacement()),
    "observation": lambda: Observation(motions(), Downsample(SHAPE, 3) @ Blur.gaussian(SHAPE, 0.4)),
}


@pytest.fixture(params=OPERATORS)
def make(request: pytest.FixtureRequest) -> Callable[[], LinearOperator]:
    return OPERATORS[request.param]


def random(shape: tuple[int, ...], seed: int = 0, dtype: DTypeLike = np.float32) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape).astype(dtype))


@eqx.filter_jit
def apply(operator: LinearOperator, x: jax.Array) -> jax.Array:
    return operator(x)


@eqx.filter_jit
def apply_adjoint(operator: LinearOperator, y: jax.Array) -> jax.Array:
    return operator.adjoint(y)


@eqx.filter_jit
def warped(warp: Warp, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    return warp(x), warp.valid


@eqx.filter_jit
def matrices(operator: LinearOperator) -> tuple[jax.Array, jax.Array]:
    """The operator and its adjoint as dense float64 matrices, a column for each value that goes in."""

    def dense(function: Callable, shape: tuple[int, ...]) -> jax.Array:
        size = math.prod(shape)
        columns = jax.vmap(function)(jnp.eye(size, dtype=jnp.float64).reshape(size, *shape))
        return columns.reshape(size, -1).T

    return dense(operator, operator.input_shape), dense(operator.adjoint, operator.output_shape)


@eqx.filter_jit
def derivatives(operator: LinearOperator, x: jax.Array, y: jax.Array):
    """A x, A* y, then the same as derivatives: the reverse mode of A*, the forward mode of A, the reverse mode of A."""
    forward, pull_back = jax.vjp(operator, x)
    backward, pull_forward = jax.vjp(operator.adjoint, y)
    _, pushed = jax.jvp(operator, (jnp.zeros_like(x),), (x,))
    return forward, backward, pull_forward(x)[0], pushed, pull_back(y)[0]


def holds_against_differences(loss: Callable, at: jax.Array, direction: jax.Array, h: float = 1e-6) -> None:
    """The derivative of `loss` along `direction` is what a central difference says."""
    both = jax.jit(jax.value_and_grad(loss))
    expected = (both(at + h * direction)[0] - both(at - h * direction)[0]) / (2 * h)
    np.testing.assert_allclose(np.vdot(both(at)[1], direction), expected, rtol=1e-7)


# Properties that every operator has


def test_adjoint_passes_the_dot_test_in_both_precisions(make):
    for seed in range(3):
        single = dot_test(make(), key=jax.random.key(seed))
        assert single.passed, single
        assert single.tolerance < 2e-5
    with jax.enable_x64(True):
        double = dot_test(make(), dtype=jnp.float64)
        assert double.passed, double
        assert double.tolerance < 3e-14


def test_adjoint_is_the_transposed_matrix(make):
    with jax.enable_x64(True):
        forward, backward = matrices(make())
        np.testing.assert_allclose(backward, forward.T, rtol=0, atol=1e-15)
        assert np.abs(forward).sum() > 1


def test_is_linear_and_its_derivatives_are_itself_and_its_adjoint(make):
    operator = make()
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(3, *operator.input_shape)), rng.normal(size=(3, *operator.output_shape))
    x[2], y[2] = 2 * x[0] - 3 * x[1], 2 * y[0] - 3 * y[1]
    found = [
        derivatives(operator, jnp.asarray(u, jnp.float32), jnp.asarray(v, jnp.float32))
        for u, v in zip(x, y, strict=True)
    ]
    for first, second, combined in zip(*found, strict=True):
        np.testing.assert_allclose(combined, 2 * np.asarray(first) - 3 * np.asarray(second), rtol=0, atol=1e-5)
    for forward, backward, *derived in found:
        for derivative, value in zip(derived, (forward, forward, backward), strict=True):
            np.testing.assert_allclose(derivative, value, rtol=0, atol=2e-6)


def test_result_has_the_dtype_of_the_argument(make):
    with jax.enable_x64(True):
        operator = make()  # its own arrays are float64 now
        for dtype in (jnp.float32, jnp.float64):
            x, y = jnp.ones(operator.input_shape, dtype), jnp.ones(operator.output_shape, dtype)
            assert jax.eval_shape(operator, x) == jax.ShapeDtypeStruct(operator.output_shape, dtype)
            assert jax.eval_shape(operator.adjoint, y) == jax.ShapeDtypeStruct(operator.input_shape, dtype)


def test_norms_against_the_singular_values(make):
    with jax.enable_x64(True):
        operator = make()
        exact = np.linalg.norm(np.asarray(matrices(operator)[0]), 2)
        found = spectral_norm(operator, iterations=2000, rtol=1e-12, dtype=jnp.float64)
        assert exact * (1 - 1e-4) < found.value <= exact * (1 + 1e-12)
        early = spectral_norm(operator, iterations=3, dtype=jnp.float64, key=jax.random.key(3))
        assert early.iterations == 3
        assert early.value <= exact * (1 + 1e-12) and exact < early.upper
        bounds = [float(norm_bound(operator, iterations=k, dtype=jnp.float64)) for k in (1, 2, 50)]
        assert all(bound >= exact * (1 - 1e-12) for bound in bounds)
        assert bounds == sorted(bounds, reverse=True)
        assert bounds[-1] < 1.05 * exact


def test_refuses_what_does_not_fit(make):
    operator = make()
    with pytest.raises(InputError, match="it takes"):
        operator(np.zeros((*operator.input_shape, 1)))
    with pytest.raises(InputError, match="adjoint was given"):
        operator.adjoint(np.zeros((1, *operator.output_shape)))
    with pytest.raises(InputError, match="int32 values"):
        operator(np.zeros(operator.input_shape, np.int32))


# Composition


def test_composition_refuses_what_does_not_fit_and_groups_either_way():
    with pytest.raises(InputError, match="applies B first"):
        _ = Blur.gaussian((6, 9), 1.0) @ Downsample((6, 9), 3)
    with pytest.raises(TypeError):
        _ = Downsample((6, 9), 3) @ 2.0  # pyright: ignore[reportOperatorIssue]
    d, h, t = Downsample(SHAPE, 3), Blur.gaussian(SHAPE, 1.0), Warp(displacement())
    x = random(SHAPE)
    np.testing.assert_allclose(apply((d @ h) @ t, x), apply(d @ (h @ t), x), rtol=0, atol=1e-6)
    assert (d @ h @ t).input_shape == SHAPE and (d @ h @ t).output_shape == (2, 3)


# Warp


def uniform(down: float, right: float, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    return np.stack([np.full(shape, down), np.full(shape, right)]).astype(np.float32)


def test_warp_by_whole_pixels_is_a_shifted_picture_with_an_invalid_border():
    x = np.asarray(random(SHAPE))
    warp = Warp(uniform(2, -3))
    expected, valid = np.zeros_like(x), np.zeros(SHAPE, bool)
    expected[:-2, 3:], valid[:-2, 3:] = x[2:, :-3], True
    shifted, shown = warped(warp, jnp.asarray(x))
    np.testing.assert_array_equal(shifted, expected)
    np.testing.assert_array_equal(shown, valid)


def test_warp_by_nothing_changes_nothing_up_to_the_border():
    x = random(SHAPE)
    same, valid = warped(Warp(uniform(0, 0)), x)
    np.testing.assert_array_equal(same, x)
    assert np.all(valid)
    assert warped(Warp(uniform(0, 0, (1, 1))), jnp.full((1, 1), 5.0)) == (5, True)


def test_warp_by_half_a_pixel_is_the_mean():
    x = np.asarray(random(SHAPE))
    halfway = np.asarray(warped(Warp(uniform(0.5, 0)), jnp.asarray(x))[0])
    np.testing.assert_allclose(halfway[:-1], (x[1:] + x[:-1]) / 2, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(halfway[-1], 0)
    both = np.asarray(warped(Warp(uniform(-0.5, 0.5)), jnp.asarray(x))[0])
    mean = (x[1:, 1:] + x[:-1, 1:] + x[1:, :-1] + x[:-1, :-1]) / 4
    np.testing.assert_allclose(both[1:, :-1], mean, rtol=0, atol=1e-6)


def test_warp_against_scipy():
    x = np.asarray(random((20, 31)), np.float64)
    d = displacement((20, 31))
    at = np.indices(x.shape) + np.where(np.isfinite(d), d, 1e6)
    expected = scipy.ndimage.map_coordinates(x, at, order=1, mode="constant", cval=np.nan)
    with jax.enable_x64(True):
        shown, valid = warped(Warp(d), jnp.asarray(x))
        np.testing.assert_array_equal(valid, np.isfinite(expected))
        np.testing.assert_allclose(shown, np.nan_to_num(expected), rtol=0, atol=1e-12)


def test_unknown_and_endless_motion_is_invalid_and_has_no_derivative():
    d = uniform(0.25, 0.25)
    for where, value in {(0, 0): np.nan, (0, 1): np.inf, (0, 2): -np.inf, (0, 3): 3e38}.items():
        d[(1, *where)] = value
    warp = Warp(d)
    expected = np.zeros(SHAPE, bool)
    expected[:-1, :-1] = True
    expected[0, :4] = False
    x = random(SHAPE)
    shown, valid = warped(warp, x)
    np.testing.assert_array_equal(valid, expected)
    assert np.all(np.asarray(shown)[0, :4] == 0)
    slope = jax.jit(jax.grad(lambda d: jnp.sum(Warp(d)(x) ** 2)))(jnp.asarray(d))
    assert np.all(np.isfinite(slope))
    assert np.all(np.asarray(slope)[:, 0, :4] == 0)


def test_warp_is_differentiable_in_the_displacement():
    with jax.enable_x64(True):
        x = random(SHAPE, dtype=np.float64)
        d = jnp.asarray(np.random.default_rng(3).uniform(0.1, 0.9, size=(2, *SHAPE)) - 0.5)
        direction = random((2, *SHAPE), 4, np.float64)

        holds_against_differences(lambda d: jnp.sum(jnp.sin(Warp(d)(x))), d, direction)


def test_warp_keeps_its_precision_far_from_the_origin():
    ramp = np.broadcast_to(np.arange(4000, dtype=np.float32), (2, 4000))
    last = jnp.asarray(ramp == 3999, jnp.float32)
    at_the_end = np.asarray(apply(Warp(uniform(0, 0.3, (2, 4000))), last))
    # 3998 + 0.3 in float32 is wrong by up to 1.2e-4.
    np.testing.assert_allclose(at_the_end[:, 3998], 0.3, rtol=2e-7)


@pytest.mark.parametrize("wrong", [np.zeros((6, 9)), np.zeros((3, 6, 9)), np.zeros((2, 6, 0))])
def test_warp_refuses_other_shapes(wrong):
    with pytest.raises(InputError, match=r"needs \(2, H, W\)"):
        Warp(wrong)


def test_warp_refuses_integers():
    with pytest.raises(InputError, match="floating point"):
        Warp(np.zeros((2, 6, 9), np.int32))


# Blur


def test_blur_of_a_point_is_the_psf():
    x = np.zeros(SHAPE, np.float32)
    x[3, 4] = 1
    blurred = np.asarray(apply(Blur(SHAPE, ASYMMETRIC_PSF), jnp.asarray(x)))
    np.testing.assert_allclose(blurred[2:5, 3:6], ASYMMETRIC_PSF / ASYMMETRIC_PSF.sum(), rtol=1e-6)
    assert np.count_nonzero(blurred) == np.count_nonzero(ASYMMETRIC_PSF)


@pytest.mark.parametrize("shape", [(8, 11), (2, 3), (1, 1)])
def test_blur_keeps_constants_and_agrees_with_scipy(shape):
    psf = np.random.default_rng(2).random((5, 7))
    with jax.enable_x64(True):
        x, constant = random(shape, dtype=np.float64), jnp.full(shape, 0.7)
        for blur in (Blur(shape, psf), Blur.gaussian(shape, (1.5, 0.8), truncate=3)):
            np.testing.assert_allclose(apply(blur, constant), 0.7, rtol=1e-14)
        expected = scipy.ndimage.convolve(np.asarray(x), psf / psf.sum(), mode="reflect")
        np.testing.assert_allclose(apply(Blur(shape, psf), x), expected, rtol=0, atol=1e-14)
        gaussian = scipy.ndimage.gaussian_filter(np.asarray(x), (1.5, 0.8), mode="reflect", truncate=3)
        np.testing.assert_allclose(apply(Blur.gaussian(shape, (1.5, 0.8), truncate=3), x), gaussian, rtol=0, atol=1e-14)


def test_symmetric_blur_is_its_own_adjoint_and_loses_no_light():
    blur, x = Blur.gaussian(SHAPE, 1.1), random(SHAPE)
    blurred = np.asarray(apply(blur, x))
    np.testing.assert_allclose(apply_adjoint(blur, x), blurred, rtol=0, atol=1e-6)
    np.testing.assert_allclose(blurred.sum(), np.asarray(x).sum(), rtol=1e-5)


def test_gaussian_of_width_zero_changes_nothing():
    x = random(SHAPE)
    unchanged = Blur.gaussian(SHAPE, 0)
    np.testing.assert_array_equal(unchanged(x), x)
    np.testing.assert_array_equal(unchanged.adjoint(x), x)


def test_blur_is_differentiable_in_the_psf():
    with jax.enable_x64(True):
        blur = Blur(SHAPE, ASYMMETRIC_PSF)
        x, direction = random(SHAPE, dtype=np.float64), random((3, 3), 1, np.float64)

        def loss(kernel):
            return jnp.sum(eqx.tree_at(lambda b: b.kernels[0], blur, kernel)(x) ** 3)

        holds_against_differences(loss, blur.kernels[0], direction)


@pytest.mark.parametrize(
    ("psf", "message"),
    [
        (np.ones((2, 3)), "two odd sides"),
        (np.ones(3), "two odd sides"),
        (np.zeros((3, 3)), "sums to 0"),
        (np.full((3, 3), np.nan), "finite values"),
        (-np.ones((3, 3)), "positive sum"),
        (np.array([[-0.1, 1.2, -0.1]]), "light is never negative"),
    ],
)
def test_blur_refuses_what_is_no_psf(psf, message):
    with pytest.raises(InputError, match=message):
        Blur(SHAPE, psf)


def test_gaussian_refuses_what_is_no_width():
    with pytest.raises(InputError, match="sigma -1"):
        Blur.gaussian(SHAPE, -1.0)
    with pytest.raises(InputError, match="sigma nan"):
        Blur.gaussian(SHAPE, (1.0, float("nan")))
    for wide in (10.5, 1e9, float("inf")):
        with pytest.raises(InputError, match="for this picture from 0 to 10"):
            Blur.gaussian((6, 9), (1.0, wide))
    with pytest.raises(InputError, match=r"truncate 1e\+30; .* at most 10"):
        Blur.gaussian(SHAPE, 1.0, truncate=1e30)
    with pytest.raises(InputError, match="truncate 0"):
        Blur.gaussian(SHAPE, 1.0, truncate=0)
    with pytest.raises(InputError, match="picture shape"):
        Blur.gaussian((0, 4), 1.0)


# Downsample


def test_downsample_is_the_mean_of_each_block():
    x = np.asarray(random(SHAPE))
    down = Downsample(SHAPE, 3)
    y = np.asarray(random((2, 3), 1))
    expected = [[x[3 * i : 3 * i + 3, 3 * j : 3 * j + 3].mean() for j in range(3)] for i in range(2)]
    np.testing.assert_allclose(apply(down, jnp.asarray(x)), expected, rtol=0, atol=1e-6)
    enlarged = np.kron(y, np.ones((3, 3), np.float32))
    np.testing.assert_allclose(apply(down, jnp.asarray(enlarged)), y, rtol=1e-6)
    np.testing.assert_allclose(9 * np.asarray(apply_adjoint(down, jnp.asarray(y))), enlarged, rtol=1e-6)
    np.testing.assert_array_equal(Downsample(SHAPE, 1)(x), x)


def test_downsample_refuses_what_does_not_divide():
    with pytest.raises(InputError, match="multiples of 4"):
        Downsample(SHAPE, 4)
    with pytest.raises(InputError, match="at least 1"):
        Downsample(SHAPE, 0)


# Observation


def test_observation_is_the_loop_of_its_parts():
    sensor = Downsample(SHAPE, 3) @ Blur.gaussian(SHAPE, 0.4)
    d = motions().astype(np.float32)
    observation = Observation(d, sensor)
    x, y = random(SHAPE), random((3, 2, 3), 1)
    frames, back, valid = [], 0, []
    for motion, samples in zip(d, y, strict=True):
        warp = Warp(motion)
        shown, inside = warped(warp, x)
        valid.append(np.asarray(apply(sensor, jnp.asarray(inside, jnp.float32))) > 0.999 - 1e-6)
        frames.append(np.where(valid[-1], apply(sensor, shown), 0))
        kept = jnp.asarray(np.where(valid[-1], samples, np.float32(0)))
        back = back + np.asarray(apply_adjoint(warp, apply_adjoint(sensor, kept)))
    np.testing.assert_array_equal(observation.valid, valid)
    assert 5 < np.sum(valid) < 18
    np.testing.assert_allclose(apply(observation, x), frames, rtol=0, atol=1e-6)
    np.testing.assert_allclose(apply_adjoint(observation, y), back, rtol=0, atol=1e-6)


def test_observation_of_a_constant_is_that_constant_where_valid():
    shape = (16, 16)
    sensor = Downsample(shape, 4) @ Blur.gaussian(shape, 0.5)
    shift = np.stack([uniform(i, -2.5 * i, shape) for i in range(3)])
    observation = Observation(shift, sensor)
    np.testing.assert_allclose(apply(observation, jnp.ones(shape)), np.asarray(observation.valid), rtol=0, atol=2e-3)
    # The second frame misses a row at the bottom and three columns at the left; the third two rows and five columns, so
    # the blur also reaches from the second block of columns into what is missing.
    expected = np.ones((3, 4, 4), bool)
    expected[1:, 3] = expected[1, :, 0] = expected[2, :, :2] = False
    np.testing.assert_array_equal(observation.valid, expected)
    np.testing.assert_array_equal(Observation(shift, sensor, coverage=0.1).valid[1], np.ones((4, 4), bool))


def test_memory_of_an_observation_does_not_grow_with_the_frames():
    def needed(frames: int) -> int:
        shape = (64, 64)
        sensor = Downsample(shape, 4) @ Blur.gaussian(shape, 1.0)
        x = jnp.ones(shape)

        def loss(displacement, x):
            return jnp.sum(Observation(displacement, sensor)(x) ** 2)

        compiled = jax.jit(jax.grad(loss, argnums=1)).lower(jnp.zeros((frames, 2, *shape)), x).compile()
        memory = compiled.memory_analysis()
        assert memory is not None
        return memory.temp_size_in_bytes

    # What remains per frame is the low-resolution samples, not (64, 64) pictures, indices and weights.
    assert (needed(40) - needed(10)) / 30 < 64 * 64 * 4


def test_observation_refuses_what_does_not_fit():
    sensor = Downsample(SHAPE, 3)
    with pytest.raises(InputError, match=r"\(N, 2, H, W\)"):
        Observation(np.zeros((2, *SHAPE)), sensor)
    with pytest.raises(InputError, match="must be the same"):
        Observation(np.zeros((3, 2, 9, 6)), sensor)
    with pytest.raises(InputError, match=r"\(N, 2, H, W\)"):
        Observation(np.zeros((3, 1, *SHAPE)), sensor)
    with pytest.raises(InputError, match="floating point"):
        Observation(np.zeros((3, 2, *SHAPE), np.int32), sensor)
    with pytest.raises(InputError, match="coverage 0"):
        Observation(np.zeros((3, 2, *SHAPE)), sensor, coverage=0.0)
