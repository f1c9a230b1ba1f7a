"""Primal–dual methods: one step for the picture, one for the dual variable of the prior, in turns."""

import abc
from typing import Any, ClassVar, NamedTuple

import jax
from jaxtyping import Array, Float

from scsr_opt._kernels.programs import compiled
from scsr_opt._validation import finite
from scsr_opt.errors import InputError
from scsr_opt.solvers.linear_solve import ConjugateGradients, LinearSolve
from scsr_opt.solvers.problem import Problem, lipschitz_bound
from scsr_opt.solvers.solver import Record, Solver
from scsr_opt.solvers.splitting import Dual, splitting_of
from scsr_opt.solvers.step_size import Balance
from scsr_opt.solvers.stopping import FixedPoint, Stopping


class PrimalDualState(NamedTuple):
    """Changes every iteration: `image` X, `dual` p and `back` K*p; and the relaxed point that the next iteration starts
    from: `ahead`, `ahead_gradient` ∇f there, `ahead_dual`, `ahead_back`. Fixed when the run begins: `lipschitz` L."""

    image: Float[Array, "H W"]
    dual: Dual
    back: Float[Array, "H W"]
    ahead: Float[Array, "H W"]
    ahead_gradient: Float[Array, "H W"]
    ahead_dual: Dual
    ahead_back: Float[Array, "H W"]
    lipschitz: Float[Array, ""]


class _PrimalDual(Solver[PrimalDualState]):
    state_type: ClassVar[type] = PrimalDualState

    iterations: int = 400
    tolerance: float | int = 1e-4
    stopping: Stopping = FixedPoint()
    balance: Balance = Balance()

    @property
    @abc.abstractmethod
    def _over(self) -> float | int:
        """Over-relaxation: the length of the step that is taken, in lengths of the step."""

    @abc.abstractmethod
    def _primal(self, lipschitz: Array) -> Float[Array, ""]:
        """τ."""

    @abc.abstractmethod
    def _move(self, problem: Problem, slope: Array, τ: Array) -> Float[Array, "H W"]:
        """The change of the picture where ∇f(X) + λK*p is `slope`."""

    def init(self, problem: Problem, image: Float[Array, "H W"]) -> PrimalDualState:
        return self._begin(problem, image, splitting_of(problem.prior).initial(image))

    def warm(self, problem: Problem, state: PrimalDualState) -> PrimalDualState:
        return self._begin(problem, state.image, state.dual)

    def retargeted(self, problem: Problem, before: Problem, state: PrimalDualState) -> PrimalDualState:
        change = problem.change_of_gradient(before)
        return state._replace(ahead_gradient=state.ahead_gradient + change)

    def _begin(self, problem: Problem, image: Float[Array, "H W"], dual: Dual) -> PrimalDualState:
        splitting = splitting_of(problem.prior)
        back = splitting.adjoint(dual.field)
        lipschitz = lipschitz_bound(problem.data)
        gradient = problem.data.gradient(image)
        return PrimalDualState(image, dual, back, image, gradient, dual, back, lipschitz)

    @compiled
    def step(self, problem: Problem, state: PrimalDualState) -> tuple[PrimalDualState, Record]:
        splitting, λ, over = splitting_of(problem.prior), problem.strength, self._over
        τ, σ = self._primal(state.lipschitz), self.balance.dual(state.lipschitz, splitting.norm_squared)
        image = state.ahead + self._move(problem, state.ahead_gradient + λ * state.ahead_back, τ)
        data, gradient = problem.data.value_and_gradient(image)
        field = splitting.analysis(image)
        dual = splitting.ascend(state.ahead_dual, splitting.analysis(2 * image - state.ahead), λ, σ)
        back = splitting.adjoint(dual.field)
        penalty, evidence = splitting.evidence(image, field, data, gradient + λ * back, dual, λ, 1 / state.lipschitz)

        def relaxed(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda a, b: b + over * (a - b), new, old)

        # All of it is linear, so that the relaxed point needs no operator of its own.
        following = PrimalDualState(
            image=image,
            dual=dual,
            back=back,
            ahead=relaxed(image, state.ahead),
            ahead_gradient=relaxed(gradient, state.ahead_gradient),
            ahead_dual=dual._replace(field=relaxed(dual.field, state.ahead_dual.field)),
            ahead_back=relaxed(back, state.ahead_back),
            lipschitz=state.lipschitz,
        )
        return following, Record(data, penalty, evidence.residual, self.stopping.gap(evidence), τ)

    def image(self, state: PrimalDualState) -> Float[Array, "H W"]:
        return state.image

    def gradient_step(self, problem: Problem, state: PrimalDualState) -> Float[Array, "H W"]:
        return state.image + problem.strength / state.lipschitz * state.back


class CondatVu(_PrimalDual):
    """Primal–dual splitting with an explicit gradient step (Condat, 2013, "A primal-dual splitting method for convex
    optimization involving Lipschitzian, proximable and linear composite terms"; Vũ, 2013, "A splitting algorithm for
    dual monotone inclusions involving cocoercive operators"):

        X' = X − τ(∇f(X) + λK*p),    p' = the dual step from K(2X' − X) with σ,
        (X, p) ← (X, p) + α((X', p') − (X, p)).

    It converges for 1/τ − σ‖K‖² ≥ L/2 and α < 2 − (L/2)/(1/τ − σ‖K‖²). Here τ = 1/(L + σ‖K‖²), which allows α < 1.5;
    1.4 is taken. One application of the data term and one dual step an iteration: the cheapest iterations there are, of
    which it needs several times as many as `FISTA`.

    **Fields:** `iterations`, `tolerance`, `stopping`: as of every `Solver`; `residual` is a bound
    (`scsr_opt.solvers.stopping`). `balance`: σ and τ. The `step_size` of its records is τ.
    """

    @property
    def _over(self) -> float | int:
        return 1.4

    def _primal(self, lipschitz: Array) -> Float[Array, ""]:
        return 1 / ((1 + self.balance.ratio) * lipschitz)

    def _move(self, problem: Problem, slope: Array, τ: Array) -> Float[Array, "H W"]:
        return -τ * slope


class ChambollePock(_PrimalDual):
    """Primal–dual splitting with the proximal step of f (Chambolle and Pock, 2011, "A first-order primal-dual algorithm
    for convex problems with applications to imaging"; over-relaxed as by He and Yuan, 2012):

        X' = argmin f(X) + ‖X − (X − τλK*p)‖²/(2τ),    p' = the dual step from K(2X' − X) with σ,

    then both over-relaxed by α. It converges for τσ‖K‖² ≤ 1 and α < 2; here τ = 1/(σ‖K‖²) and α = `relaxation`. The
    proximal step is the linear system (BᵀMB + 1/τ)δ = −∇f(X) − λK*p for the change of X. It is solved by `linear_solve`
    and not by a dual variable of the data term as well: its condition number is at most 1 + 1/κ, so that few steps of
    conjugate gradients are exact enough, whereas a dual variable would live on the samples, which are no longer there
    once BᵀMB is accumulated.

    **Fields:** as of `CondatVu`; `linear_solve`: of the linear system; `relaxation`: 0 < α < 2.
    """

    linear_solve: LinearSolve = ConjugateGradients(steps=2)
    relaxation: float | int = 1.6

    def __check_init__(self):
        if not 0 < finite(self.relaxation) < 2:
            raise InputError(f"ChambollePock was given relaxation={self.relaxation!r}; it has to be between 0 and 2.")

    @property
    def _over(self) -> float | int:
        return self.relaxation

    def _primal(self, lipschitz: Array) -> Float[Array, ""]:
        return 1 / (self.balance.ratio * lipschitz)

    def _move(self, problem: Problem, slope: Array, τ: Array) -> Float[Array, "H W"]:
        return self.linear_solve(lambda image: problem.data.normal(image) + image / τ, -slope)
