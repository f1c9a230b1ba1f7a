"""ISTA and FISTA: Eq. 5 of the paper, plain and accelerated."""

import abc
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scsr_opt._kernels.programs import compiled
from scsr_opt.priors.analysis import Analysis
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.solver import Record, Solver
from scsr_opt.solvers.step_size import NormBound, Separable, StepSize
from scsr_opt.solvers.stopping import Evidence, FixedPoint, Stopping, misfit, relative


class ProximalGradientState(NamedTuple):
    """Changes every iteration: `image`, `gradient` of f there, `ahead` (where the next step starts), `ahead_gradient`,
    `gradient_step` R, `momentum` t, `objective` F, the prior's state and `step_size` β, of all pixels or of each."""

    image: Float[Array, "H W"]
    gradient: Float[Array, "H W"]
    ahead: Float[Array, "H W"]
    ahead_gradient: Float[Array, "H W"]
    gradient_step: Float[Array, "H W"]
    momentum: Float[Array, ""]
    objective: Float[Array, ""]
    prior: Any
    step_size: Float[Array, "*pixels"]


class _Step(NamedTuple):
    """A proximal-gradient step that is tried: from `gradient_step` to `image`."""

    step_size: Float[Array, "*pixels"]
    gradient_step: Float[Array, "H W"]
    image: Float[Array, "H W"]
    prior: Any
    data: Float[Array, ""]
    gradient: Float[Array, "H W"]


class ProximalGradient(Solver[ProximalGradientState]):
    """Gradient steps on one of f and λΨ and proximal ones on the other: what such methods have in common. Their states
    are alike, so that each can start from another's: a scene may come to rest."""

    state_type: ClassVar[type] = ProximalGradientState

    def image(self, state: ProximalGradientState) -> Float[Array, "H W"]:
        return state.image

    def gradient_step(self, problem: Problem, state: ProximalGradientState) -> Float[Array, "H W"]:
        return state.gradient_step

    def warm(self, problem: Problem, state: ProximalGradientState) -> ProximalGradientState:
        return self.init(problem, state.image)._replace(prior=state.prior)

    def retargeted(self, problem: Problem, before: Problem, state: ProximalGradientState) -> ProximalGradientState:
        # The momentum is kept: begun anew every few iterations it would never build up.
        return state._replace(
            objective=jnp.full_like(state.objective, jnp.inf)
        )  # that of another problem is not comparable

    def kept(self, state: ProximalGradientState) -> ProximalGradientState:
        image = state.image
        return state._replace(gradient=image, ahead=image, ahead_gradient=image, gradient_step=image, step_size=image)

    def _first(
        self,
        problem: Problem,
        image: Float[Array, "H W"],
        *,
        gradient: Float[Array, "H W"],
        step_size: Float[Array, "*pixels"],
    ) -> ProximalGradientState:
        """The state before the first iteration, without momentum."""
        return ProximalGradientState(
            image=image,
            gradient=gradient,
            ahead=image,
            ahead_gradient=gradient,
            gradient_step=image,
            momentum=jnp.ones((), image.dtype),
            objective=jnp.full((), jnp.inf, image.dtype),
            prior=problem.prior.initial_state(image),
            step_size=step_size,
        )


class _PriorProximal(ProximalGradient):
    """Eq. 5: gradient steps on f, proximal ones on λΨ."""

    iterations: int = 200
    tolerance: float | int = 1e-4
    stopping: Stopping = FixedPoint()
    step_size: StepSize = NormBound()

    def prepared(self, problem: Problem) -> Problem:
        return super().prepared(problem) if self.step_size.needs_bound(problem) else problem

    def init(self, problem: Problem, image: Float[Array, "H W"]) -> ProximalGradientState:
        return self._first(
            problem, image, gradient=problem.data.gradient(image), step_size=self.step_size.first(problem)
        )

    @compiled
    def step(self, problem: Problem, state: ProximalGradientState) -> tuple[ProximalGradientState, Record]:
        step = self._step(problem, state)
        image, β = step.image, step.step_size
        # A pixel whose step is 0 is held where it is (`scsr_opt.solvers.tiles`).
        shortest = β if β.ndim == 0 else jnp.min(β, where=β > 0, initial=jnp.inf)
        # The same slope counts as much wherever it is, as if all steps were as long as the shortest. Differences are
        # seen through a barrier: with those that follow made one, XLA would write them to memory for both.
        new, old, start = jax.lax.optimization_barrier((image, state.image, state.ahead))
        moved = new - start if β.ndim == 0 else (new - start) * jnp.where(β > 0, shortest / β, 0)
        residual = relative(jnp.linalg.norm(moved), image)
        uphill = jnp.sum(moved * (new - old)) < 0
        penalty, evidence = _evidence(problem, step, residual)
        momentum, along, beyond = self._extrapolation(state.momentum, uphill | (evidence.objective > state.objective))
        # f is quadratic, so its gradient at the point ahead follows from two known ones; the application of M that this
        # saves has given f at the picture itself instead, for the record.
        following = ProximalGradientState(
            image=image,
            gradient=step.gradient,
            ahead=image + along * (image - state.image) + beyond * (image - state.ahead),
            ahead_gradient=step.gradient
            + along * (step.gradient - state.gradient)
            + beyond * (step.gradient - state.ahead_gradient),
            gradient_step=step.gradient_step,
            momentum=momentum,
            objective=evidence.objective,
            prior=step.prior,
            step_size=β,
        )
        return following, Record(step.data, penalty, residual, self.stopping.gap(evidence), shortest)

    def retargeted(self, problem: Problem, before: Problem, state: ProximalGradientState) -> ProximalGradientState:
        change = problem.change_of_gradient(before)
        state = super().retargeted(problem, before, state)
        return state._replace(gradient=state.gradient + change, ahead_gradient=state.ahead_gradient + change)

    def _step(self, problem: Problem, state: ProximalGradientState) -> _Step:
        """From the point ahead, with a step size that is short enough."""

        def attempt(β: Array) -> _Step:
            gradient_step = state.ahead - β * state.ahead_gradient
            image, prior = problem.prior.prox(gradient_step, β * problem.strength, state.prior)
            return _Step(β, gradient_step, image, prior, *problem.data.value_and_gradient(image))

        def curvature(step: _Step) -> Float[Array, ""]:
            moved = step.image - state.ahead
            square = jnp.maximum(jnp.sum(moved**2), jnp.finfo(moved.dtype).tiny)
            return jnp.sum(moved * (step.gradient - state.ahead_gradient)) / square

        def too_long(step: _Step) -> Any:
            return self.step_size.too_long(step.step_size, curvature(step))

        step = attempt(self.step_size.trial(state.step_size))
        if too_long(step) is None:
            return step
        return jax.lax.while_loop(
            too_long, lambda step: attempt(self.step_size.shorter(step.step_size, curvature(step))), step
        )

    @abc.abstractmethod
    def _extrapolation(
        self, t: Float[Array, ""], worse: Bool[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """The next t, and how far to go ahead: along the change from picture to picture, and along the last step, which
        began at the point ahead. `worse`: whether the momentum points uphill, or the objective rose."""


def _evidence(problem: Problem, step: _Step, residual: Float[Array, ""]) -> tuple[Float[Array, ""], Evidence]:
    """λΨ(X), and what the step tells of X. What is not measured of it is not computed, either."""
    λ, prior = problem.strength, problem.prior
    # X = R − βλK*p, p the prior's state.
    slope = step.gradient + (step.gradient_step - step.image) / step.step_size
    if isinstance(prior, Analysis):
        penalty, off = misfit(prior, prior.analysis(step.image), step.prior)
        return λ * penalty, Evidence(step.image, step.data + λ * penalty, slope, λ * off, residual)
    penalty = λ * prior.value_after(step.image, step.prior)
    return penalty, Evidence(step.image, step.data + penalty, slope, None, residual)


class ISTA(_PriorProximal):
    """Iterative shrinkage-thresholding: X ← prox(X − β∇f(X)), Eq. 5 as it stands.

    The objective decreases in every iteration for β ≤ 1/L (L the Lipschitz constant of ∇f), as O(1/t) (Beck and
    Teboulle, 2009), as far as the proximal step is exact. For comparison and study; FISTA needs far fewer iterations.

    **Fields:** `iterations`, `tolerance`, `stopping`: as of every `Solver`. `step_size`: how β is chosen.
    """

    def _extrapolation(self, t, worse):
        none = jnp.zeros_like(t)
        return t, none, none


class FISTA(_PriorProximal):
    """ISTA with momentum: O(1/t²) (Beck and Teboulle, 2009), restarted whenever the momentum points uphill or the
    objective rose (both schemes of O'Donoghue and Candès, 2015), which makes it linear where the problem allows it.

    To Nesterov's momentum comes that of the optimised gradient method, t/t' times the last step (Kim and Fessler, 2016,
    "Optimized first-order methods for smooth convex minimization"). For smooth functions that halves the bound; with a
    proximal step nothing is proved for it, which the restarts make good, and 20 to 30 % of the iterations were saved.

    The prior's state (total variation's dual variable) is carried from one proximal step to the next. A proximal step
    that is not exact, as total variation's, is what momentum may add up; the second test is what ends that.

    **Fields:** as of `ISTA`; each pixel has its own step size where the prior is `separable`. `optimised`: whether the
    second momentum is there. The first one's rate is proved for step sizes that do not grow; where `Backtracking` lets
    them, the second restart ends what goes wrong.
    """

    step_size: StepSize = Separable()
    optimised: bool = True

    def _extrapolation(self, t, worse):
        return momentum(t, worse, optimised=self.optimised)


def momentum(
    t: Float[Array, ""], worse: Bool[Array, ""], *, optimised: bool = True
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Momentum of `FISTA`: the next t, and the factors of the change from picture to picture and of the last step.
    `worse`: whether it begins anew."""
    t = jnp.where(worse, 1, t)
    following = (1 + jnp.sqrt(1 + 4 * t**2)) / 2
    beyond = jnp.where(worse, 0, t / following) if optimised else jnp.zeros_like(t)
    return following, jnp.where(worse, 0, (t - 1) / following), beyond
