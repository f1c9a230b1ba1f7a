"""ISTA and FISTA: Eq. 5 of the paper, plain and accelerated."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt.solvers.iterate import Record, Solver
from scsr_opt.solvers.problem import Problem, lipschitz_bound


class ProximalGradientState(NamedTuple):
    """Changes every iteration: `image`, `gradient` of f there, `ahead` (where the next step starts), `ahead_gradient`,
    `gradient_step` R, `momentum` t, `objective` F and the prior's state. Fixed when the run begins: `step_size`."""

    image: Float[Array, "H W"]
    gradient: Float[Array, "H W"]
    ahead: Float[Array, "H W"]
    ahead_gradient: Float[Array, "H W"]
    gradient_step: Float[Array, "H W"]
    momentum: Float[Array, ""]
    objective: Float[Array, ""]
    prior: Any
    step_size: Float[Array, ""]


class _ProximalGradient(Solver[ProximalGradientState]):
    iterations: int = 200
    tolerance: float | int = 1e-4

    def init(self, problem: Problem, image: Float[Array, "H W"]) -> ProximalGradientState:
        gradient = problem.data.gradient(image)
        return ProximalGradientState(
            image=image,
            gradient=gradient,
            ahead=image,
            ahead_gradient=gradient,
            gradient_step=image,
            momentum=jnp.ones((), image.dtype),
            objective=jnp.full((), jnp.inf, image.dtype),
            prior=problem.prior.initial_state(image),
            step_size=1 / lipschitz_bound(problem.data),
        )

    def step(self, problem: Problem, state: ProximalGradientState) -> tuple[ProximalGradientState, Record]:
        β = state.step_size
        gradient_step = state.ahead - β * state.ahead_gradient
        image, prior = problem.prior.prox(gradient_step, β * problem.strength, state.prior)
        value, gradient = problem.data.value_and_gradient(image)
        penalty = problem.strength * problem.prior.value(image)
        momentum, extrapolation = self._extrapolation(state, image, value + penalty)
        # f is quadratic, so its gradient at the point ahead follows from two known ones; the application of M that this
        # saves has given f at the picture itself instead, for the record.
        following = ProximalGradientState(
            image=image,
            gradient=gradient,
            ahead=image + extrapolation * (image - state.image),
            ahead_gradient=gradient + extrapolation * (gradient - state.gradient),
            gradient_step=gradient_step,
            momentum=momentum,
            objective=value + penalty,
            prior=prior,
            step_size=β,
        )
        size = jnp.maximum(jnp.linalg.norm(image), jnp.finfo(image.dtype).tiny)
        residual = jnp.linalg.norm(image - state.ahead) / size
        return following, Record(value, penalty, residual, β)

    def image(self, state: ProximalGradientState) -> Float[Array, "H W"]:
        return state.image

    def gradient_step(self, state: ProximalGradientState) -> Float[Array, "H W"]:
        return state.gradient_step

    def warm(self, problem: Problem, state: ProximalGradientState) -> ProximalGradientState:
        return self.init(problem, state.image)._replace(prior=state.prior)

    def _extrapolation(
        self, state: ProximalGradientState, image: Float[Array, "H W"], objective: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The next t, and how far to go ahead along the latest change."""
        raise NotImplementedError


class ISTA(_ProximalGradient):
    """Iterative shrinkage-thresholding: X ← prox(X − β∇f(X)), Eq. 5 as it stands.

    The objective decreases in every iteration for β ≤ 1/L (L the Lipschitz constant of ∇f), as O(1/t) (Beck and
    Teboulle, 2009). β is 1 over a certain upper bound of L. For comparison and study; FISTA needs far fewer iterations.
    """

    def _extrapolation(self, state, image, objective):
        return state.momentum, jnp.zeros((), image.dtype)


class FISTA(_ProximalGradient):
    """ISTA with momentum: O(1/t²) (Beck and Teboulle, 2009), restarted whenever the momentum points uphill or the
    objective rose (both schemes of O'Donoghue and Candès, 2015), which makes it linear where the problem allows it.

    The prior's state (total variation's dual variable) is carried from one proximal step to the next. A proximal step
    that is not exact, as total variation's, is what momentum may add up; the second test is what ends that.
    """

    def _extrapolation(self, state, image, objective):
        uphill = jnp.sum((state.ahead - image) * (image - state.image)) > 0
        uphill |= objective > state.objective
        t = jnp.where(uphill, 1, state.momentum)
        following = (1 + jnp.sqrt(1 + 4 * t**2)) / 2
        return following, jnp.where(uphill, 0, (t - 1) / following)
