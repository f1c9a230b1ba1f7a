"""Is the adjoint an adjoint, and how large is the operator? Public, because whoever writes an operator needs both."""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, PRNGKeyArray

from scsr_opt._kernels.programs import ready
from scsr_opt.errors import InputError
from scsr_opt.operators.operator import LinearOperator


class DotTest(NamedTuple):
    """Result of `dot_test`.

    **Fields:**
    - `forward`, `backward`: ⟨A x, y⟩ and ⟨x, A* y⟩.
    - `error`: their difference, relative to the size that such an inner product typically has.
    - `tolerance`: the `rtol` that was used.
    - `passed`: whether `error` is within it.
    """

    forward: float
    backward: float
    error: float
    tolerance: float
    passed: bool


def dot_test(
    operator: LinearOperator,
    *,
    key: PRNGKeyArray | None = None,
    rtol: float | None = None,
    dtype: DTypeLike = jnp.float32,
) -> DotTest:
    """Compares ⟨A x, y⟩ with ⟨x, A* y⟩ for random normal x and y (Claerbout, 1992, "Earth Soundings Analysis").

    The error is relative to ‖A x‖‖y‖/√m and ‖x‖‖A* y‖/√n (m, n the numbers of values in y and x), the size that these
    products have for random x and y. It is therefore of the order of the rounding unit for a true adjoint and of the
    order of 1 for an unrelated one, at every picture size, and an inner product that happens to be near zero does no
    harm. One wrong value among n gives about 1/√n: test at small sizes.

    **Arguments:**
    - `operator`: A.
    - `key`: for the random numbers; `jax.random.key(0)` if not given.
    - `rtol`: the largest error to accept; 100 rounding units of `dtype` if not given.
    - `dtype`: of x and y. float64 needs `jax.enable_x64`.

    **Returns:** `DotTest`; it does not raise when the test fails.
    """
    ready()
    key_x, key_y = jax.random.split(jax.random.key(0) if key is None else key)
    x = jax.random.normal(key_x, operator.input_shape, dtype)
    y = jax.random.normal(key_y, operator.output_shape, dtype)
    # The products are summed in float64 outside JAX: their rounding is not the operator's.
    ax, ay, x, y = (np.asarray(v, np.float64).ravel() for v in (*_both(operator, x, y), x, y))
    forward, backward = float(ax @ y), float(x @ ay)
    scale = max(_norm(ax) * _norm(y) / math.sqrt(y.size), _norm(x) * _norm(ay) / math.sqrt(x.size))
    difference = abs(forward - backward)
    error = difference / scale if scale > 0 else difference
    tolerance = 100 * float(jnp.finfo(dtype).eps) if rtol is None else rtol
    return DotTest(forward, backward, error, tolerance, error <= tolerance)


@eqx.filter_jit
def _both(operator: LinearOperator, x: Array, y: Array) -> tuple[Array, Array]:
    return operator(x), operator.adjoint(y)


def _norm(v: np.ndarray) -> float:
    return float(np.linalg.norm(v))


class SpectralNorm(NamedTuple):
    """Result of `spectral_norm`.

    **Fields:**
    - `value`: estimate of ‖A‖, never above it (but for rounding).
    - `upper`: ‖A‖ is below this with probability 99.9 % over the random start; never below `value`.
    - `change`: relative change of `value` in the last iteration. Where singular values lie close together it becomes
      small long before the error does; that is what `upper` is for.
    - `iterations`: how many were done.
    """

    value: Float[Array, ""]
    upper: Float[Array, ""]
    change: Float[Array, ""]
    iterations: Int[Array, ""]


def spectral_norm(
    operator: LinearOperator | Callable[[Array], Array],
    shape: tuple[int, ...] | None = None,
    *,
    iterations: int = 100,
    rtol: float = 1e-4,
    dtype: DTypeLike = jnp.float32,
    key: PRNGKeyArray | None = None,
) -> SpectralNorm:
    """The largest singular value of A, by power iteration x ← A*A x / ‖A*A x‖ from a random start.

    With x of length 1, √‖A*A x‖ grows towards ‖A‖; after k iterations its relative error falls like (σ₂/σ₁)^(2k) where
    there is a gap, and is at most about ln(n)/(2k) on average where there is none. The upper bound holds in either
    case: after k applications of A*A to a uniformly distributed start, P(‖A‖² > ‖A*A x‖ / (1−ε)) ≤ 0.824 √n (1−ε)^(k−½)
    (Kuczyński & Woźniakowski, 1992, Theorem 4.1), solved for ε. For operators without negative entries, `norm_bound` is
    certain, cheaper and mostly tighter.

    **Arguments:**
    - `operator`: A; either an operator or any linear function, whose adjoint is then taken by `jax.linear_transpose`.
    - `shape`: of x; needed for a function only.
    - `iterations`, `rtol`: it stops after `iterations`, or when `value` changes by less than `rtol` relative.
    - `dtype`: of the computation.
    - `key`: for the start; `jax.random.key(0)` if not given.

    **Returns:** `SpectralNorm`, of scalar arrays, so it can be used within `jax.jit`.

    **Errors:** `InputError` without a shape for a function, or for fewer than one iteration.
    """
    if iterations < 1:
        raise InputError(f"spectral_norm was given {iterations} iterations; it needs at least 1.")
    ready()
    shape = _shape(operator, shape, "spectral_norm")
    start = jax.random.normal(jax.random.key(0) if key is None else key, shape, dtype)
    # As arrays, so that other values of them compile nothing again.
    return _power_iteration(operator, start, jnp.asarray(iterations, jnp.int32), jnp.asarray(rtol, dtype))


@eqx.filter_jit
def _power_iteration(operator, start: Array, iterations: Int[Array, ""], rtol: Float[Array, ""]) -> SpectralNorm:
    normal = _normal(operator, start)
    dtype = start.dtype
    tiny = jnp.finfo(dtype).tiny

    def unit(x: Array) -> tuple[Array, Array]:
        length = jnp.sqrt(jnp.sum(x**2))
        return x / jnp.maximum(length, tiny), length

    def go_on(state: tuple[Array, Array, Array, Array]) -> Array:
        _, _, change, done = state
        # Written so that a change that is not a number ends the loop.
        return (done < iterations) & ((done < 2) | (change > rtol))

    def step(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        x, before, _, done = state
        x, square = unit(normal(x))
        value = jnp.sqrt(square)
        return x, value, jnp.abs(value - before) / jnp.maximum(value, tiny), done + 1

    first, _ = unit(start)
    begin = (first, jnp.zeros((), dtype), jnp.full((), jnp.inf, dtype), jnp.zeros((), jnp.int32))
    _, value, change, done = jax.lax.while_loop(go_on, step, begin)
    failure = 1e-3  # chance that the bound does not hold
    margin = max(1.0, 0.824 * math.sqrt(start.size) / failure)
    upper = value * jnp.exp(math.log(margin) / (2 * done.astype(dtype) - 1))
    return SpectralNorm(value, upper, change, done)


def norm_bound(
    operator: LinearOperator | Callable[[Array], Array],
    shape: tuple[int, ...] | None = None,
    *,
    iterations: int = 1,
    symmetric: bool = False,
    dtype: DTypeLike = jnp.float32,
) -> Float[Array, ""]:
    """A certain upper bound on ‖A‖ for an operator without negative entries (warps, blurs, means, their products).

    For every positive x, ‖A‖² = ρ(A*A) ≤ max_i (A*A x)_i / x_i (Collatz, 1942). It starts at x = 1, where this is the
    largest row sum of A*A, and iterates x ← A*A x, which never makes it worse. For an `Observation`, one
    application is exact for a translation, within 2 % for smooth motion and within 30 % for motion that is random at
    every pixel; five are within 1 %, 1 % and 3 %.

    **Arguments:** as for `spectral_norm`; `iterations` is the number of applications of A*A; `symmetric`: A = A*, so
    that A is applied in the place of A*A, and ‖A‖ ≤ max_i (A x)_i / x_i. That, and that no entry is negative, is not
    checked.
    """
    if iterations < 1:
        raise InputError(f"norm_bound was given {iterations} iterations; it needs at least 1.")
    ready()
    start = jnp.ones(_shape(operator, shape, "norm_bound"), dtype)
    bound = _ratio_bound(operator, start, jnp.asarray(iterations, jnp.int32), symmetric)
    return bound if symmetric else jnp.sqrt(bound)


@eqx.filter_jit
def _ratio_bound(operator, start: Array, iterations: Int[Array, ""], symmetric: bool) -> Float[Array, ""]:
    """An upper bound on ρ(A) of an operator A without negative entries, or on ρ(A*A)."""
    applied = operator if symmetric else _normal(operator, start)
    tiny = jnp.finfo(start.dtype).tiny

    def step(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        x, _ = state
        image = applied(x)
        # Where the image is 0 its row is 0 wherever x is not, and bounds nothing.
        ratio = jnp.max(jnp.where(image > 0, image / x, 0))
        return image / jnp.maximum(jnp.max(image), tiny), ratio

    _, ratio = jax.lax.fori_loop(
        jnp.zeros((), jnp.int32), iterations, step, (start, jnp.full((), jnp.inf, start.dtype))
    )
    return ratio


def _normal(operator, like: Array) -> Callable[[Array], Array]:
    if isinstance(operator, LinearOperator):
        return operator.normal
    transposed = jax.linear_transpose(operator, like)
    return lambda x: transposed(operator(x))[0]


def _shape(operator, shape: tuple[int, ...] | None, name: str) -> tuple[int, ...]:
    if isinstance(operator, LinearOperator):
        if shape is not None and tuple(shape) != operator.input_shape:
            raise InputError(f"{name} was given the shape {shape} for an operator that takes {operator.input_shape}.")
        return operator.input_shape
    if shape is None:
        raise InputError(f"{name} was given a function without a shape; say for arrays of which shape it is meant.")
    return tuple(shape)
