"""Forward–backward splitting with the roles of Eq. 5 exchanged, for scenes in which nothing moves."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt._kernels.programs import compiled
from scsr_opt.errors import InputError
from scsr_opt.priors.prior import Prior
from scsr_opt.solvers.problem import Problem, lipschitz_bound
from scsr_opt.solvers.proximal_gradient import ProximalGradient, ProximalGradientState, momentum
from scsr_opt.solvers.solver import Record
from scsr_opt.solvers.stopping import UNMEASURED, FixedPoint, Stopping, relative


class DataProximal(ProximalGradient):
    """X ← argmin over X of ½‖X − R‖² + τ f(X), R = X − τλ∇Ψ(X): Eq. 5 with its roles exchanged, with the momentum of
    `FISTA`, which begins anew whenever the objective rose.

    Where nothing moves and the lens is perfect, the light of a sensor pixel depends on its own s×s block of the picture
    and on no other. The proximal step of the data then adds a number to each block (`DataTerm.prox`), for
    any τ, and what is left to iterate for is the shape within blocks, which the prior alone decides. A smooth one needs
    no proximal step, and none of the dual steps that one is made of: λτ is one over the Lipschitz constant of ∇Ψ.
    (Gradient steps on the regulariser and proximal ones on the data: Hurault, Leclaire, Papadakis, 2022, "Gradient step
    denoiser for convergent plug-and-play".)

    What is held against the tolerance is a bound on the residual that `FISTA` measures. With β = 1/L, L the Lipschitz
    constant of ∇f, ‖X − prox(X − β∇f(X))‖ ≤ β‖∇F(X)‖, as the proximal step is nonexpansive and X is that of
    X + βλ∇Ψ(X); and ‖∇F(X)‖ ≤ ‖A − X‖/τ, A the picture that the step began at, as a gradient step of size τ on λΨ is
    nonexpansive, too.

    **Fields:** `iterations`, `tolerance`: as of every `Solver`.

    **Errors:** `InputError`, when a run begins, for a prior that is not smooth and convex (`Prior.lipschitz`), or for
    data that are not `DataTerm.block_diagonal`.
    """

    # λ·(Lipschitz constant of ∇Ψ) counts as no less than this times L: without a prior it then takes a few steps.
    LEAST_STEEPNESS: ClassVar[float] = 1e-3

    iterations: int = 200
    tolerance: float | int = 1e-4
    # Always so: there are no dual variables to make a gap of.
    stopping: Stopping = eqx.field(default=FixedPoint(), init=False)

    def check(self, prior: Prior) -> None:
        """Raises `InputError` for a prior that it cannot use."""
        if prior.lipschitz is None:
            raise InputError(
                f"DataProximal was given a {type(prior).__name__} that is not smooth and convex; it needs a prior such "
                "as HuberTotalVariation, or for this one another solver: FISTA, ADMM or CondatVu."
            )

    def init(self, problem: Problem, image: Float[Array, "H W"]) -> ProximalGradientState:
        if not problem.data.block_diagonal:
            raise InputError(
                "DataProximal was given data whose pixels overlap, as where something moves, a lens blurs or the "
                "sensor grid is not used (Shortcuts); it is for scenes at rest: take FISTA, which works for all."
            )
        assert problem.prior.lipschitz is not None  # `check` saw to it
        steepest = problem.strength * problem.prior.lipschitz
        step_size = 1 / jnp.maximum(steepest, self.LEAST_STEEPNESS * lipschitz_bound(problem.data))
        return self._first(problem, image, gradient=image, step_size=step_size)  # that of f is not looked at

    @compiled
    def step(self, problem: Problem, state: ProximalGradientState) -> tuple[ProximalGradientState, Record]:
        τ, ahead = state.step_size, state.ahead
        gradient_step = ahead - τ * problem.strength * problem.prior.gradient(ahead)
        image, data = problem.data.prox(gradient_step, τ)
        penalty = problem.strength * problem.prior.value(image)
        objective = data + penalty

        β = 1 / lipschitz_bound(problem.data)
        # Of a step shorter than rounding it is not known that it is none.
        residual = relative(jnp.linalg.norm(image - ahead), image) + jnp.finfo(image.dtype).eps
        residual = residual * (β / τ)
        t, along, beyond = momentum(state.momentum, objective > state.objective)
        following = state._replace(
            image=image,
            ahead=image + along * (image - state.image) + beyond * (image - ahead),
            gradient_step=gradient_step,
            momentum=t,
            objective=objective,
        )
        return following, Record(data, penalty, residual, jnp.full_like(residual, UNMEASURED), τ)
