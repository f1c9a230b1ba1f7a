"""The record of a network's stages, as a solver keeps it of its iterations: Eq. 4 at the network's own iterates."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from learned.evaluation.inference import Run
from learned.evaluation.reference_problem import ReferenceProblem, read
from scsr_opt.priors.prior import Prior
from scsr_opt.solvers.problem import Problem, lipschitz_bound
from scsr_opt.solvers.record import Stage


def stages_of(
    posed: ReferenceProblem, found: Run, *, seconds: float, keep_images: bool, dual_steps: int = 100
) -> tuple[Stage, ...]:
    """A `Stage` of each iterate of a network.

    `objective`, `data`, `prior`: at X^(t), the data term exact there. `residual`: ‖X^(t) − G(X^(t))‖ / ‖X^(t)‖, G a
    proximal-gradient step from X^(t): 0 at the minimiser. `step_size`: the β for which X^(t−1) − β∇f(X^(t−1)) comes
    nearest to R^(t), which for ISTA is its own β. `seconds`: those of the whole network, whose stages are not timed one
    by one. `dual_steps` of the residual's proximal step, whose dual variable begins at zero.
    """
    stages = []
    before, slope = found.start, read(posed, found.start).slope
    prior = posed.prior.with_inner_iterations(dual_steps)
    for number, (step, image) in enumerate(zip(found.gradient_steps, found.images, strict=True), 1):
        reading = read(posed, image)
        stages.append(
            Stage(
                number=number,
                objective=float(reading.objective),
                data=float(reading.data),
                prior=float(reading.prior),
                residual=float(_residual(posed.problem(image), prior, image)),
                step_size=float(_step_size(before, slope, step)),
                seconds=seconds,
                gradient_step=np.array(step) if keep_images else None,
                image=np.array(image) if keep_images else None,
            )
        )
        before, slope = image, reading.slope
    return tuple(stages)


@eqx.filter_jit
def _residual(problem: Problem, prior: Prior, image: Float[Array, "H W"]) -> Float[Array, ""]:
    β = 1 / lipschitz_bound(problem.data)
    step = image - β * problem.data.gradient(image)
    following, _ = prior.prox(step, β * problem.strength, prior.initial_state(image))
    size = jnp.maximum(jnp.linalg.norm(image), jnp.finfo(image.dtype).tiny)
    return jnp.linalg.norm(image - following) / size


@jax.jit
def _step_size(before: Float[Array, "H W"], slope: Float[Array, "H W"], step: Float[Array, "H W"]) -> Float[Array, ""]:
    return jnp.sum((before - step) * slope) / jnp.sum(slope**2)
