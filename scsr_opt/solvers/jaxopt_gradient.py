"""ISTA and FISTA as `jaxopt.ProximalGradient` does them, behind the same face as the native solvers.

They are here to compare with. `FISTA` is faster:
- jaxopt's proximal step is a function without memory. Total variation's dual variable starts anew in every iteration
  and needs many dual steps there, where the native solvers keep it and need few.
- jaxopt has no restart, so that its momentum overshoots late in the run.
- its update tells f at the point it started from; the record wants f at the picture, one more application of the data
  term in every iteration.

jaxopt's own `tol` is not used: its error is ‖ΔX‖ / β, neither relative nor free of the step. The loop of
`scsr_opt.solvers.loop` measures and stops these solvers as it does the others; a jaxopt update, called outside
`jax.jit`, would cost 0.4 s, and there it is compiled.

jaxopt is no longer maintained and says so when imported. It is imported when a solver is first used, and this one
warning is silenced there and nowhere else.
"""

import warnings
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt._kernels.programs import compiled
from scsr_opt._validation import iteration_count
from scsr_opt.solvers.problem import Problem, lipschitz_bound
from scsr_opt.solvers.solver import Record, Solver
from scsr_opt.solvers.stopping import UNMEASURED, FixedPoint, Stopping, relative


class JaxoptState(NamedTuple):
    """Changes every iteration: `image`, `gradient_step` R, and `inner`, jaxopt's own state, whose `aux` is the gradient
    that it used. Fixed when the run begins: `step_size`."""

    image: Float[Array, "H W"]
    gradient_step: Float[Array, "H W"]
    inner: Any
    step_size: Float[Array, ""]


class _Jaxopt(Solver[JaxoptState]):
    state_type: ClassVar[type] = JaxoptState
    _accelerated: eqx.AbstractClassVar[bool]

    iterations: int = 100
    tolerance: float | int = 3e-4
    inner_iterations: int = 100
    # Always so: a proximal step without memory leaves no dual variable to compute a gap from.
    stopping: Stopping = eqx.field(default=FixedPoint(), init=False)

    def __check_init__(self):
        iteration_count(type(self).__name__, self.inner_iterations, "inner_iterations")

    def init(self, problem: Problem, image: Float[Array, "H W"]) -> JaxoptState:
        step_size = 1 / lipschitz_bound(problem.data)
        inner = self._method(problem, step_size).init_state(image, problem.strength)
        # jaxopt makes t in JAX's default precision, which need not be the picture's.
        inner = inner._replace(t=jnp.asarray(inner.t, image.dtype))
        # Nor are all of its numbers of a definite type, without which what was compiled is not met again.
        inner = jax.tree.map(lambda value: jnp.asarray(value, jnp.asarray(value).dtype), inner)
        return JaxoptState(image, image, inner, step_size)

    def retargeted(self, problem: Problem, before: Problem, state: JaxoptState) -> JaxoptState:
        return state  # jaxopt takes every gradient anew

    @compiled
    def step(self, problem: Problem, state: JaxoptState) -> tuple[JaxoptState, Record]:
        β = state.step_size
        ahead = state.inner.velocity if self._accelerated else state.image
        image, inner = self._method(problem, β).update(state.image, state.inner, problem.strength)
        inner = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), inner, state.inner)
        residual = relative(jnp.linalg.norm(image - ahead), image)
        value, prior = problem.data.value(image), problem.strength * problem.prior.value(image)
        return JaxoptState(image, ahead - β * inner.aux, inner, β), Record(
            value, prior, residual, jnp.full_like(residual, UNMEASURED), β
        )

    def image(self, state: JaxoptState) -> Float[Array, "H W"]:
        return state.image

    def gradient_step(self, problem: Problem, state: JaxoptState) -> Float[Array, "H W"]:
        return state.gradient_step

    def _method(self, problem: Problem, step_size: Float[Array, ""]) -> Any:
        """The `jaxopt.ProximalGradient` of a problem. Made while tracing, so it costs nothing while running."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
            import jaxopt

        def fun(image: Float[Array, "H W"]) -> tuple[tuple[Array, Array], Array]:
            value, gradient = problem.data.value_and_gradient(image)
            return (value, gradient), gradient

        prior = problem.prior.with_inner_iterations(self.inner_iterations)

        def prox(image: Float[Array, "H W"], strength: Float[Array, ""], scale: Float[Array, ""]) -> Array:
            return prior.prox(image, scale * strength, prior.initial_state(image))[0]

        # A step size handed over as a number would have to be known while tracing; as a function it need not be.
        return jaxopt.ProximalGradient(
            fun,
            prox,
            value_and_grad=True,
            has_aux=True,
            stepsize=lambda _: step_size,
            acceleration=self._accelerated,
            implicit_diff=False,
        )


class JaxoptISTA(_Jaxopt):
    """`ISTA` by jaxopt: X ← prox(X − β∇f(X)), β one over a certain upper bound of ∇f's Lipschitz constant.

    The objective decreases in every iteration, as O(1/t), as far as the proximal step is exact.

    **Arguments:**
    - `iterations`: the most that are done.
    - `tolerance`: of the relative residual, as for every `Solver`.
    - `inner_iterations`: a prior whose own `iterations` are fewer is used with this many, as each of its proximal steps
      starts anew. On a small problem with total variation 100 end 0.01 % above the minimum, 50 0.05 %; a strength five
      times the usual needs more (0.7 % with 100, 0.1 % with 200).
    """

    _accelerated: ClassVar[bool] = False


class JaxoptFISTA(_Jaxopt):
    """`FISTA` by jaxopt, without restart: O(1/t²) (Beck and Teboulle, 2009).

    **Arguments:** as for `JaxoptISTA`.
    """

    _accelerated: ClassVar[bool] = True
