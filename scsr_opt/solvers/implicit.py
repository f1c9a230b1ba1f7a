"""Derivatives of the minimiser by the strength and the samples: of the minimiser itself, not of the iterations."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt._kernels.programs import ready
from scsr_opt._validation import iteration_count
from scsr_opt.errors import InputError
from scsr_opt.operators.exposure import ExposedStencil
from scsr_opt.priors.analysis import Analysis
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser
from scsr_opt.solvers.problem import Problem, lipschitz_bound
from scsr_opt.solvers.splitting import AnalysisSplitting, Dual

# Length of a step, in lengths of the plain one: both equations keep their solution, and converge (Condat, 2013).
_RELAXATION = 1.4

_Pair = tuple[Float[Array, "H W"], Any]


def implicit_minimiser(
    problem: Problem, image: Float[Array, "H W"], *, iterations: int = 1000, adjoint_iterations: int = 1000
) -> Float[Array, "H W"]:
    """The minimiser X*(θ) of f(X) + λΨ(X), differentiable in reverse mode by every number θ of the problem: λ, the
    accumulated samples c (`problem.data.target`), M, and the numbers of the lens and of a `RidgeRegulariser` (those of
    the other priors are settings that are compiled in). Not by the samples of an `ExposedStencil`, which the problem of
    `assemble` has where the scene moves: their derivative is 0.

    With p the dual variable, the pair v* = (X*, p*) is a fixed point v = T(v, θ) of a primal–dual step, all of whose
    parts are exact and known (a truncated proximal step is not); of a gradient step, without p, for a
    `RidgeRegulariser`. By the implicit function theorem (Christianson, 1994,
    "Reverse accumulation and attractive fixed points"; for proximal methods Bolte, Le, Pauwels, Silveti-Falls, 2021,
    "Nonsmooth implicit differentiation for machine learning and optimization") the gradient of a loss l(X*) is

        (∂T/∂θ)ᵀ w,    w = (∂T/∂v)ᵀ w + (∇l, 0),

    and the equation for w is solved by iterating it, like the forward one: from one w to the next, with memory for one
    step of either. Where Ψ has kinks, X* is differentiable but for a set of θ of measure zero; close to that set, and
    where p* is not unique, convergence is slow. Compare results of two numbers of iterations.

    **Arguments:**
    - `problem`: with an `Analysis` prior or a `RidgeRegulariser` (where that is only weakly convex, X* is a critical
      point); others have no known conjugate step, or remember more than a dual variable.
    - `image`: where to start; the picture of an `Outcome` saves iterations. X* does not depend on it, nor is it
      differentiated by it.
    - `iterations`, `adjoint_iterations`: of the forward and the backward equation.

    **Returns:** X*.

    **Errors:** `InputError` for another prior, or fewer than one iteration.
    """
    ready()
    if not isinstance(problem.prior, Analysis | RidgeRegulariser):
        raise InputError(
            f"implicit_minimiser was given {type(problem.prior).__name__}; it needs an Analysis prior such as "
            "TotalVariation, or a RidgeRegulariser."
        )
    for name, number in (("iterations", iterations), ("adjoint_iterations", adjoint_iterations)):
        iteration_count("implicit_minimiser", number, name)
    by = jax.tree.map(eqx.is_inexact_array, problem)
    if isinstance(problem.data.stencil, ExposedStencil):
        by = eqx.tree_at(lambda of: of.data.stencil.placed, by, jax.tree.map(lambda _: False, by.data.stencil.placed))
    numbers, rest = eqx.partition(problem, by)
    places, static = eqx.partition(rest, eqx.is_array)
    return _solution(numbers, places, static, iterations, adjoint_iterations, jax.lax.stop_gradient(image))


@eqx.filter_jit
def _solution(numbers: Any, places: Any, static: Any, iterations: int, adjoint_iterations: int, image: Array) -> Array:
    """`implicit_minimiser` of a problem in three parts: the `numbers` that it is differentiated by, other arrays
    (`places`), and what is compiled in (`static`)."""

    # `places` is an argument, too: the rules of derivatives are traced again, and must not enclose traced arrays.
    @jax.custom_vjp
    def solve(numbers: Any, places: Any, image: Array) -> Array:
        return fixed_point(numbers, places, image)[0]

    def fixed_point(numbers: Any, places: Any, image: Array) -> _Pair:
        problem: Problem = eqx.combine(numbers, places, static)
        prior = problem.prior
        first = (image, prior.initial_state(image) if isinstance(prior, Analysis) else ())
        return _repeated(lambda pair: _step(problem, pair), first, iterations)

    def forward(numbers: Any, places: Any, image: Array) -> tuple[Array, Any]:
        pair = fixed_point(numbers, places, image)
        return pair[0], (numbers, places, pair)

    def backward(kept: Any, wanted: Array) -> tuple[Any, None, Array]:
        numbers, places, pair = kept
        _, back = jax.vjp(lambda numbers, pair: _step(eqx.combine(numbers, places, static), pair), numbers, pair)
        zero = jax.tree.map(jnp.zeros_like, pair)

        def once(w: _Pair) -> _Pair:
            _, (image, dual) = back(w)
            return image + wanted, dual

        of_numbers, _ = back(_repeated(once, zero, adjoint_iterations))
        return of_numbers, None, jnp.zeros_like(wanted)

    solve.defvjp(forward, backward)
    return solve(numbers, places, image)


def _repeated(step: Callable[[_Pair], _Pair], pair: _Pair, times: int) -> _Pair:
    def relaxed(_: Array, pair: _Pair) -> _Pair:
        return jax.tree.map(lambda new, old: old + _RELAXATION * (new - old), step(pair), pair)

    return jax.lax.fori_loop(0, times, relaxed, pair)


def _step(problem: Problem, pair: _Pair) -> _Pair:
    """T: the step of `CondatVu`, with κ = 1, or a step along the gradient."""
    prior, λ = problem.prior, problem.strength
    # Its solutions do not depend on the step sizes, and the derivative of the bound would be wasted work.
    lipschitz = jax.lax.stop_gradient(lipschitz_bound(problem.data))
    image, dual = pair
    if isinstance(prior, RidgeRegulariser):
        steepest = lipschitz + jax.lax.stop_gradient(λ) * prior.curvature
        return image - (problem.data.gradient(image) + λ * prior.gradient(image)) / steepest, dual
    assert isinstance(prior, Analysis)
    splitting = AnalysisSplitting(prior)
    moved = image - (problem.data.gradient(image) + λ * splitting.adjoint(dual)) / (2 * lipschitz)
    field = splitting.analysis(2 * moved - image)
    return moved, splitting.ascend(Dual(dual, None, None), field, λ, lipschitz / splitting.norm_squared).field
