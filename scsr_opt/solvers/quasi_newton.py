"""Nonlinear conjugate gradients and L-BFGS of optimistix, as `Solver`s, for priors that
have a gradient.

Their line search compares values of F, and can tell two pictures apart as long as these differ by more than rounding.
Written out, f is a small difference of sums of squared intensities: in float32 the search was lost at residuals of 4e-5
to 6e-4, and hardly ever met a tolerance of 1e-4. With X = X₀ + D, X₀ the picture that the run began with,

    f(X) = ½⟨B D, M B D⟩ − ⟨c − M B X₀, B D⟩ + f(X₀),

whose parts are as small as f itself. That is again a data term, of D. Then what rounding is left is allowed for
(`_Search`), and L-BFGS comes down to 1e-6.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from scsr_opt._kernels.programs import compiled
from scsr_opt._validation import iteration_count
from scsr_opt.errors import InputError
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.priors.prior import Prior
from scsr_opt.solvers.problem import Problem, lipschitz_bound
from scsr_opt.solvers.solver import Record, Solver
from scsr_opt.solvers.stopping import UNMEASURED, FixedPoint, Stopping, relative


class SmoothState(NamedTuple):
    """Changes every iteration: `image`, `slope` ∇F there, and `inner`, the arrays of optimistix's own state. Fixed when
    the run begins: `origin` X₀, `target` c − M B X₀, `energy` 2f(X₀), and `step_size` 1/L, the measure of its residual.
    """

    image: Float[Array, "H W"]
    slope: Float[Array, "H W"]
    inner: Any
    origin: Float[Array, "H W"]
    target: Float[Array, "H W"]
    energy: Float[Array, ""]
    step_size: Float[Array, ""]

    def objective(self, problem: Problem) -> "_Objective":
        """F, written out from the origin."""
        data = eqx.tree_at(lambda d: (d.target, d.energy), problem.data, (self.target, self.energy))
        return _Objective(data, self.origin, problem.prior, problem.strength, self.step_size)


class _Objective(eqx.Module):
    """F(X) = f(X) + λΨ(X), `data` being f as a function of X − `origin`, and `step_size` β."""

    data: DataTerm
    origin: Float[Array, "H W"]
    prior: Prior
    strength: Float[Array, ""]
    step_size: Float[Array, ""]


class _Search(optx.BacktrackingArmijo):
    """Armijo's rule, but for rounding: where F no longer tells two pictures apart, a method follows its gradient,
    which has more digits.

    **Fields:** `growth`: where a step is tried first, in lengths of the last that was accepted; None for the method's
    own step. `slack`: by how much F may rise and still count as lower, in ε|F|: it is a sum of many numbers.
    """

    growth: float | None = None
    slack: int = 5

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        slack = self.slack * jnp.finfo(y.dtype).eps * jnp.abs(f_info.as_min())
        lower = eqx.tree_at(lambda info: info.f, f_eval_info, f_eval_info.as_min() - slack)
        length, accept, result, following = super().step(first_step, y, y_eval, f_info, lower, state)
        if self.growth is not None:
            # What is called the first step only looks at the start.
            length = jnp.where(accept & ~first_step, self.growth * state.step_size, length)
            following = eqx.tree_at(lambda s: s.step_size, following, length)
        return length, accept, result, following


class Smooth(Solver[SmoothState]):
    """A minimiser of optimistix as a `Solver`, for smooth priors."""

    state_type: ClassVar[type] = SmoothState
    uses_prox: ClassVar[bool] = False

    iterations: int = 200
    tolerance: float | int = 1e-4
    # Always so: where λ∇Ψ is known, β‖∇F‖ bounds ‖X − G(X)‖, and nothing is gained by a gap.
    stopping: Stopping = eqx.field(default=FixedPoint(), init=False)

    @abc.abstractmethod
    def _method(self) -> Any:
        """The minimiser of optimistix."""

    def check(self, prior: Prior) -> None:
        """Raises `InputError` for a prior with kinks."""
        if not prior.smooth:
            raise InputError(
                f"{type(self).__name__} was given {type(prior).__name__}, which has kinks; it needs a smooth "
                "prior such as HuberTotalVariation, or for this one another solver: FISTA, ADMM or CondatVu."
            )

    def init(self, problem: Problem, image: Float[Array, "H W"]) -> SmoothState:
        data = problem.data
        if image.dtype != jax.dtypes.canonicalize_dtype(float):
            # Optimistix makes its own numbers in JAX's default precision.
            raise InputError(
                f"{type(self).__name__} was given a problem in {image.dtype}, but jax_enable_x64 is on; switch it off, "
                "or take FISTA, ADMM or CondatVu, which work in either."
            )
        blurred = data.blurred(image)
        state = SmoothState(
            image=image,
            slope=jnp.zeros_like(image),
            inner=None,
            origin=image,
            target=data.target - data.stencil(blurred),
            energy=2 * data.value(image),
            step_size=1 / lipschitz_bound(data),
        )
        inner, _ = eqx.partition(self._begin(state.objective(problem), image), eqx.is_array)
        return state._replace(inner=inner)

    @compiled
    def step(self, problem: Problem, state: SmoothState) -> tuple[SmoothState, Record]:
        # The state holds functions, too, always the same: those of a state that is thrown away.
        objective = state.objective(problem)
        _, functions = eqx.partition(self._begin(objective, state.image), eqx.is_array)
        inner = eqx.combine(state.inner, functions)
        image, inner, _ = self._method().step(_value, state.image, objective, {}, inner, frozenset())
        data, penalty = inner.aux
        slope = inner.f_info.grad / state.step_size
        residual = relative(state.step_size * jnp.linalg.norm(slope), image)
        inner, _ = eqx.partition(inner, eqx.is_array)
        record = Record(data, penalty, residual, jnp.full_like(residual, UNMEASURED), state.step_size)
        return state._replace(image=image, slope=slope, inner=inner), record

    def kept(self, state: SmoothState) -> SmoothState:
        return state._replace(slope=state.image, inner=None, origin=state.image, target=state.image)

    def image(self, state: SmoothState) -> Float[Array, "H W"]:
        return state.image

    def gradient_step(self, problem: Problem, state: SmoothState) -> Float[Array, "H W"]:
        # X + βλ∇Ψ(X), with λ∇Ψ = ∇F − ∇f.
        return state.image + state.step_size * (state.slope - problem.data.gradient(state.image))

    def _begin(self, objective: _Objective, image: Float[Array, "H W"]) -> Any:
        value, parts = jax.eval_shape(_value, image, objective)
        return self._method().init(_value, image, objective, {}, value, parts, frozenset())


def _value(image: Float[Array, "H W"], objective: _Objective) -> tuple[Array, tuple[Array, Array]]:
    """βF, so that a step of length 1 along its gradient is a sensible one, and the two parts of F."""
    data = _data(objective.data, image - objective.origin)
    penalty = objective.strength * objective.prior.value(image)
    return objective.step_size * (data + penalty), (data, penalty)


@jax.custom_jvp
def _data(data: DataTerm, image: Float[Array, "H W"]) -> Float[Array, ""]:
    return data.value(image)


@_data.defjvp
def _(primals, tangents):
    # The gradient comes with the value; by differentiation M and B would be applied once more.
    data, image = primals
    value, gradient = data.value_and_gradient(image)
    return value, jnp.sum(gradient * tangents[1])


class NonlinearCG(Smooth):
    """Nonlinear conjugate gradients for minimise f(X) + λΨ(X), Ψ smooth: `optimistix.NonlinearCG` (Polak and Ribière,
    1969), with its backtracking line search (Armijo).

    An iteration is one evaluation of F, the first one of F at the start; where the line search refuses it, the picture
    stays as it is. Stationary points of a convex F are its minimisers. In float32 the residual comes down to 2e-5 at
    the usual strengths and 2e-4 at ten times these.

    **Fields:** `iterations`, `tolerance`: as of every `Solver`; `residual` is the bound β‖∇F‖ / ‖X‖, β = 1/L.

    **Errors:** `InputError`, when a run begins, for a prior that is not smooth (`Prior.smooth`).
    """

    # Within reach of float32 (above).
    tolerance: float | int = 3e-4

    def _method(self) -> Any:
        # Of 1.5, 2 and 3 the first needed the fewest iterations.
        return optx.NonlinearCG(rtol=0.0, atol=0.0, search=_Search(growth=1.5))


class LBFGS(Smooth):
    """L-BFGS for minimise f(X) + λΨ(X), Ψ smooth: `optimistix.LBFGS` (Liu and Nocedal, 1989), with its backtracking
    line search (Armijo).

    **Fields:** as of `NonlinearCG`; `history`: pairs of steps and changes of the gradient that are kept, two pictures
    each.

    **Errors:** as of `NonlinearCG`.
    """

    history: int = 10

    def __check_init__(self):
        iteration_count("LBFGS", self.history, "pairs of history")

    def _method(self) -> Any:
        method = optx.LBFGS(rtol=0.0, atol=0.0, history_length=self.history)
        return eqx.tree_at(lambda m: m.search, method, _Search())
