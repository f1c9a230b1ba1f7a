"""Linear operators: what the data term of Eq. 4 is made of.

An operator is a value (a frozen Equinox module) with a forward map, its exact adjoint, and the shapes of both sides. It
carries no dtype of its own: results have the dtype of the picture, so one operator serves float32 and
float64. Shapes are known beforehand because a dot-test, a norm or a start value can then be made without asking the
caller for an example.

Subclasses write `_forward` and `_adjoint`; `__call__` and `adjoint` belong to this class and refuse what does not fit,
because a picture of a wrong shape would otherwise often broadcast its way to a plausible wrong answer.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from scsr_opt._arrays import as_array
from scsr_opt._kernels.programs import compiled, ready
from scsr_opt.errors import InputError


class LinearOperator(eqx.Module):
    """A linear map A from arrays of `input_shape` to arrays of `output_shape`.

    `A(x)` is the forward map, `A.adjoint(y)` is A* with ⟨A x, y⟩ = ⟨x, A* y⟩ to rounding (hold it to that with
    `scsr_opt.operators.dot_test`), `A.normal(x)` is A* A x and `A @ B` is the operator that applies B first. All of
    them can be jitted, batched with `jax.vmap` and differentiated.

    **Errors:** an array of another shape, or one that is not floating point, raises `InputError`.
    """

    @property
    @abc.abstractmethod
    def input_shape(self) -> tuple[int, ...]:
        """Shape of x in A x."""

    @property
    @abc.abstractmethod
    def output_shape(self) -> tuple[int, ...]:
        """Shape of A x."""

    @abc.abstractmethod
    def _forward(self, x: Float[Array, "..."]) -> Float[Array, "..."]: ...

    @abc.abstractmethod
    def _adjoint(self, y: Float[Array, "..."]) -> Float[Array, "..."]: ...

    def __call__(self, x: ArrayLike) -> Float[Array, "..."]:
        """A x, in the dtype of x."""
        return _forward(self, _checked(x, self.input_shape, type(self).__name__))

    def adjoint(self, y: ArrayLike) -> Float[Array, "..."]:
        """A* y, in the dtype of y."""
        return _adjoint(self, _checked(y, self.output_shape, f"{type(self).__name__}.adjoint"))

    def normal(self, x: ArrayLike) -> Float[Array, "..."]:
        """A* A x, in the dtype of x."""
        return self.adjoint(self(x))

    def __matmul__(self, inner: "LinearOperator") -> "Composition":
        if not isinstance(inner, LinearOperator):
            return NotImplemented
        return Composition(self, inner)


class Composition(LinearOperator):
    """`outer @ inner`: x ↦ outer(inner(x)), with adjoint y ↦ inner*(outer*(y)).

    **Errors:** `InputError` if what `inner` returns has not the shape that `outer` takes.
    """

    outer: LinearOperator
    inner: LinearOperator

    def __check_init__(self):
        if self.inner.output_shape != self.outer.input_shape:
            raise InputError(
                f"{type(self.outer).__name__} takes shape {self.outer.input_shape} but {type(self.inner).__name__} "
                f"returns {self.inner.output_shape}; A @ B applies B first, so build both for the same picture size."
            )

    @property
    def input_shape(self) -> tuple[int, ...]:
        return self.inner.input_shape

    @property
    def output_shape(self) -> tuple[int, ...]:
        return self.outer.output_shape

    def _forward(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.outer(self.inner(x))

    def _adjoint(self, y: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.inner.adjoint(self.outer.adjoint(y))


@compiled
def _forward(operator: LinearOperator, x: Float[Array, "..."]) -> Float[Array, "..."]:
    return operator._forward(x)


@compiled
def _adjoint(operator: LinearOperator, y: Float[Array, "..."]) -> Float[Array, "..."]:
    return operator._adjoint(y)


def picture_shape(shape: tuple[int, int], name: str) -> tuple[int, int]:
    """`shape` as two plain positive integers, or an `InputError` that names the operator which was given it."""
    sizes = tuple(shape)
    if len(sizes) != 2 or any(size != int(size) or size < 1 for size in sizes):
        raise InputError(f"{name} was given the picture shape {shape}; it needs two positive integers (rows, columns).")
    return int(sizes[0]), int(sizes[1])


def _checked(x: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    ready()
    x = x if isinstance(x, jax.Array) else jnp.asarray(as_array(x, f"What {name} was given"))
    if x.shape != shape:
        raise InputError(f"{name} was given an array of shape {x.shape}; it takes {shape}.")
    if not jnp.issubdtype(x.dtype, jnp.floating):
        raise InputError(f"{name} was given {x.dtype} values; convert them to float32 or float64 first.")
    return x
