"""Nonlinear conjugate gradients and L-BFGS of optimistix, behind the same face as the other solvers, for priors that
have a gradient."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from scsr_opt.errors import InputError
from scsr_opt.operators.sampling import DataTerm
from scsr_opt.solvers.iterate import Record, Solver
from scsr_opt.solvers.problem import Problem, lipschitz_bound
from scsr_opt.solvers.stopping import FixedPoint, Stopping, relative


class SmoothState(NamedTuple):
    """Changes every iteration: `image`, `slope` ∇F there, and `inner`, the arrays of optimistix's own state. Fixed when
    the run begins: `step_size` 1/L, the measure of its residual."""

    image: Float[Array, "H W"]
    slope: Float[Array, "H W"]
    inner: Any
    step_size: Float[Array, ""]


class _Smooth(Solver[SmoothState]):
    state_type: ClassVar[type] = SmoothState

    iterations: int = 200
    tolerance: float | int = 1e-4
    # Always so: where λ∇Ψ is known, β‖∇F‖ bounds ‖X − G(X)‖, and nothing is gained by a gap.
    stopping: Stopping = eqx.field(default=FixedPoint(), init=False)

    @abc.abstractmethod
    def _method(self) -> Any:
        """The minimiser of optimistix."""

    def init(self, problem: Problem, image: Float[Array, "H W"]) -> SmoothState:
        if not problem.prior.smooth:
            raise InputError(
                f"{type(self).__name__} was given {type(problem.prior).__name__}, which has kinks; it needs a smooth "
                "prior such as HuberTotalVariation. For this one take FISTA, ADMM or CondatVu."
            )
        inner, _ = eqx.partition(self._begin(problem, image), eqx.is_array)
        return SmoothState(image, jnp.zeros_like(image), inner, 1 / lipschitz_bound(problem.data))

    def step(self, problem: Problem, state: SmoothState) -> tuple[SmoothState, Record]:
        # The state holds functions, too, always the same: those of a state that is thrown away.
        _, functions = eqx.partition(self._begin(problem, state.image), eqx.is_array)
        inner = eqx.combine(state.inner, functions)
        image, inner, _ = self._method().step(_objective, state.image, problem, {}, inner, frozenset())
        data, penalty = inner.aux
        slope = inner.f_info.grad
        residual = relative(state.step_size * jnp.linalg.norm(slope), image)
        inner, _ = eqx.partition(inner, eqx.is_array)
        record = Record(data, penalty, residual, jnp.full_like(residual, jnp.nan), state.step_size)
        return SmoothState(image, slope, inner, state.step_size), record

    def image(self, state: SmoothState) -> Float[Array, "H W"]:
        return state.image

    def gradient_step(self, problem: Problem, state: SmoothState) -> Float[Array, "H W"]:
        # X + βλ∇Ψ(X), with λ∇Ψ = ∇F − ∇f.
        return state.image + state.step_size * (state.slope - problem.data.gradient(state.image))

    def _begin(self, problem: Problem, image: Float[Array, "H W"]) -> Any:
        value, parts = jax.eval_shape(_objective, image, problem)
        return self._method().init(_objective, image, problem, {}, value, parts, frozenset())


def _objective(image: Float[Array, "H W"], problem: Problem) -> tuple[Array, tuple[Array, Array]]:
    """F, and its two parts."""
    data, penalty = _data(problem.data, image), problem.strength * problem.prior.value(image)
    return data + penalty, (data, penalty)


@jax.custom_jvp
def _data(data: DataTerm, image: Float[Array, "H W"]) -> Float[Array, ""]:
    return data.value(image)


@_data.defjvp
def _(primals, tangents):
    # The gradient comes with the value; by differentiation M and B would be applied once more.
    data, image = primals
    value, gradient = data.value_and_gradient(image)
    return value, jnp.sum(gradient * tangents[1])


class NonlinearCG(_Smooth):
    """Nonlinear conjugate gradients for minimise f(X) + λΨ(X), Ψ smooth: `optimistix.NonlinearCG` (Polak and Ribière,
    1969), with its backtracking line search (Armijo).

    An iteration is one evaluation of F, the first one of F at the start; where the line search refuses it, the picture
    stays as it is. Stationary points of a convex F are its minimisers.

    **Fields:** `iterations`, `tolerance`: as of every `Solver`; `residual` is the bound β‖∇F‖ / ‖X‖, β = 1/L.

    **Errors:** `InputError`, when a run begins, for a prior that is not smooth (`Prior.smooth`).
    """

    def _method(self) -> Any:
        return optx.NonlinearCG(rtol=0.0, atol=0.0)


class LBFGS(_Smooth):
    """L-BFGS for minimise f(X) + λΨ(X), Ψ smooth: `optimistix.LBFGS` (Liu and Nocedal, 1989), with its backtracking
    line search (Armijo).

    **Fields:** as of `NonlinearCG`; `history`: pairs of steps and changes of the gradient that are kept, two pictures
    each.

    **Errors:** as of `NonlinearCG`.
    """

    history: int = 10

    def __check_init__(self):
        if self.history < 1:
            raise InputError(f"LBFGS was given a history of {self.history}; it needs at least 1.")

    def _method(self) -> Any:
        return optx.LBFGS(rtol=0.0, atol=0.0, history_length=self.history)
