"""The alternating direction method of multipliers (ADMM)."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from scsr_opt._kernels.programs import compiled
from scsr_opt._validation import finite
from scsr_opt.errors import InputError
from scsr_opt.solvers.linear_solve import ConjugateGradients, JaxoptConjugateGradients, LinearSolve
from scsr_opt.solvers.problem import Problem, lipschitz_bound
from scsr_opt.solvers.solver import Record, Solver
from scsr_opt.solvers.splitting import Dual, splitting_of
from scsr_opt.solvers.stopping import FixedPoint, Stopping


class ADMMState(NamedTuple):
    """Changes every iteration: `image` X, `gradient` ∇f(X), `field` K X, `split` z, `dual` p, `back` K*p, `penalty` ρ
    and `done`. Fixed when the run begins: `step_size` 1/L, the measure of its residual."""

    image: Float[Array, "H W"]
    gradient: Float[Array, "H W"]
    field: Any
    split: Any
    dual: Dual
    back: Float[Array, "H W"]
    penalty: Float[Array, ""]
    done: Int[Array, ""]
    step_size: Float[Array, ""]


class ADMM(Solver[ADMMState]):
    """minimise f(X) + λφ(z) over K X = z (Boyd, Parikh, Chu, Peleato, Eckstein, 2011, "Distributed optimization and
    statistical learning via the alternating direction method of multipliers"):

        X ← argmin f(X) + ρ/2‖K X − z + u‖²,    z ← argmin λφ(z) + ρ/2‖K̂ − z + u‖²,    u ← u + K̂ − z,

    K̂ = αK X + (1 − α)z, u = (λ/ρ)p. For an `Analysis` prior K is its own; for any other it is the identity. The first
    step is the linear system (BᵀMB + ρK*K)δ = −∇f(X) − λK*p − ρK*(K X − z) for the change of X, solved by
    `linear_solve` to the accuracy of a few steps. It converges for every ρ and 0 < α < 2 where the errors of these
    steps can be summed (Eckstein and Bertsekas, 1992). ρ is balanced during the first 40 iterations of a run, from
    L/‖K‖², so that ‖K X − z‖ and ρ‖K*(z − z')‖, each relative to what it is the difference of (Wohlberg, 2017, "ADMM
    penalty parameter selection by residual balancing"), stay alike.

    **Fields:**
    - `iterations`, `tolerance`, `stopping`: as of every `Solver`; `residual` is a bound (`scsr_opt.solvers.stopping`).
    - `linear_solve`: of the linear system.
    - `relaxation`: α; 1.5 to 1.8 is mostly faster than 1.

    The `step_size` of its records is 1/ρ.
    """

    state_type: ClassVar[type] = ADMMState
    # Residual balancing (Boyd et al., 2011, §3.4.1): ρ changes by the factor where one residual is more than the ratio
    # times the other, and no more after these iterations: with ρ fixed from then on the proof of convergence holds.
    BALANCING_FACTOR: ClassVar[float] = 2.0
    BALANCING_RATIO: ClassVar[float] = 10.0
    BALANCED_ITERATIONS: ClassVar[int] = 40

    iterations: int = 200
    tolerance: float | int = 1e-4
    stopping: Stopping = FixedPoint()
    linear_solve: LinearSolve = ConjugateGradients()
    relaxation: float | int = 1.6

    def __check_init__(self):
        if not 0 < finite(self.relaxation) < 2:
            raise InputError(
                f"{type(self).__name__} was given relaxation={self.relaxation!r}; it has to be between 0 and 2."
            )

    def init(self, problem: Problem, image: Float[Array, "H W"]) -> ADMMState:
        splitting = splitting_of(problem.prior)
        return self._begin(problem, image, splitting.initial(image), None)

    def warm(self, problem: Problem, state: ADMMState) -> ADMMState:
        return self._begin(problem, state.image, state.dual, state)

    def retargeted(self, problem: Problem, before: Problem, state: ADMMState) -> ADMMState:
        change = problem.change_of_gradient(before)
        return state._replace(gradient=state.gradient + change)

    def _begin(self, problem: Problem, image: Float[Array, "H W"], dual: Dual, before: ADMMState | None) -> ADMMState:
        splitting = splitting_of(problem.prior)
        lipschitz = lipschitz_bound(problem.data)
        field = splitting.analysis(image)
        return ADMMState(
            image=image,
            gradient=problem.data.gradient(image),
            field=field,
            split=field if before is None else before.split,
            dual=dual,
            back=splitting.adjoint(dual.field),
            penalty=lipschitz / splitting.norm_squared if before is None else before.penalty,
            done=jnp.zeros((), jnp.int32),
            step_size=1 / lipschitz,
        )

    @compiled
    def step(self, problem: Problem, state: ADMMState) -> tuple[ADMMState, Record]:
        splitting, λ, ρ, α = splitting_of(problem.prior), problem.strength, state.penalty, self.relaxation

        def normal(image: Array) -> Array:
            return problem.data.normal(image) + ρ * splitting.adjoint(splitting.analysis(image))

        apart = splitting.adjoint(jax.tree.map(lambda k, z: k - z, state.field, state.split))
        δ = self.linear_solve(normal, -state.gradient - λ * state.back - ρ * apart)
        image = state.image + δ
        data, gradient = problem.data.value_and_gradient(image)
        field = splitting.analysis(image)
        relaxed = jax.tree.map(lambda k, z: α * k + (1 - α) * z, field, state.split)
        dual = splitting.ascend(state.dual, relaxed, λ, ρ)
        # z = w − (λ/ρ)p with w = K̂ + (λ/ρ)p'.
        split = jax.tree.map(lambda k, old, new: k + λ / ρ * (old - new), relaxed, state.dual.field, dual.field)
        back = splitting.adjoint(dual.field)
        penalty, evidence = splitting.evidence(image, field, data, gradient + λ * back, dual, λ, state.step_size)
        following = ADMMState(
            image,
            gradient,
            field,
            split,
            dual,
            back,
            _balanced(ρ, state, field, split, λ * back, splitting),
            state.done + 1,
            state.step_size,
        )
        return following, Record(data, penalty, evidence.residual, self.stopping.gap(evidence), 1 / ρ)

    def image(self, state: ADMMState) -> Float[Array, "H W"]:
        return state.image

    def gradient_step(self, problem: Problem, state: ADMMState) -> Float[Array, "H W"]:
        return state.image + state.step_size * problem.strength * state.back


def _balanced(ρ: Array, state: ADMMState, field: Any, split: Any, pull: Array, splitting: Any) -> Float[Array, ""]:
    """ρ for the next iteration."""
    tiny = jnp.finfo(ρ.dtype).tiny ** 0.5
    primal = _norm(jax.tree.map(lambda k, z: k - z, field, split))
    primal = primal / jnp.maximum(jnp.maximum(_norm(field), _norm(split)), tiny)
    moved = splitting.adjoint(jax.tree.map(lambda new, old: new - old, split, state.split))
    dual = ρ * jnp.linalg.norm(moved) / jnp.maximum(jnp.linalg.norm(pull), tiny)
    ratio, more = ADMM.BALANCING_RATIO, ADMM.BALANCING_FACTOR
    factor = jnp.where(primal > ratio * dual, more, jnp.where(dual > ratio * primal, 1 / more, 1.0))
    return jnp.where(state.done < ADMM.BALANCED_ITERATIONS, ρ * factor.astype(ρ.dtype), ρ)


def _norm(field: Any) -> Float[Array, ""]:
    return jnp.sqrt(sum(jnp.sum(v**2) for v in jax.tree.leaves(field)))


class JaxoptADMM(ADMM):
    """`ADMM` whose linear systems are solved by `jaxopt.linear_solve.solve_cg`.

    **Fields:** as of `ADMM`.
    """

    linear_solve: LinearSolve = eqx.field(default=JaxoptConjugateGradients())
