"""Solvers of the linear systems inside splitting methods: N δ = g, N symmetric and positive."""

import abc
import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt._validation import checked_tolerance, iteration_count


class LinearSolve(eqx.Module):
    """A method for N δ = g, from δ = 0. **Fields:** `steps`: applications of N, at most."""

    steps: eqx.AbstractVar[int]

    def __check_init__(self):
        iteration_count(type(self).__name__, self.steps, "steps")

    @abc.abstractmethod
    def __call__(self, normal: Callable[[Array], Array], wanted: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """δ."""


class ConjugateGradients(LinearSolve):
    """A fixed number of steps of conjugate gradients (Hestenes and Stiefel, 1952), unrolled.

    As δ is the change of a picture from one outer iteration to the next, the start is warm and few steps do. There is
    no preconditioner (docs/decisions/0011).
    """

    steps: int = 3

    def __call__(self, normal: Callable[[Array], Array], wanted: Float[Array, "H W"]) -> Float[Array, "H W"]:
        tiny = jnp.finfo(wanted.dtype).tiny
        δ, left, direction = jnp.zeros_like(wanted), wanted, wanted
        square = jnp.sum(left**2)
        for _ in range(self.steps):
            image = normal(direction)
            # Nothing is left once the solution is found: 0/0 has to be 0.
            along = square / jnp.maximum(jnp.sum(direction * image), tiny)
            δ, left = δ + along * direction, left - along * image
            before, square = square, jnp.sum(left**2)
            direction = left + square / jnp.maximum(before, tiny) * direction
        return δ


class JaxoptConjugateGradients(LinearSolve):
    """`jaxopt.linear_solve.solve_cg`, for at most `steps` steps or until ‖N δ − g‖ ≤ `tolerance`·‖g‖."""

    steps: int = 10
    tolerance: float | int = 0.1

    def __check_init__(self):
        checked_tolerance(type(self).__name__, self.tolerance)

    def __call__(self, normal: Callable[[Array], Array], wanted: Float[Array, "H W"]) -> Float[Array, "H W"]:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
            from jaxopt.linear_solve import solve_cg
        # It divides by squares. Those of a nearly black picture would be lost, and 0/0 come of them.
        largest = jnp.max(jnp.abs(wanted))
        unit = jnp.where(largest > 0, largest, 1)
        return jax.lax.stop_gradient(unit * solve_cg(normal, wanted / unit, maxiter=self.steps, tol=self.tolerance))
