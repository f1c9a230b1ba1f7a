"""Eq. 4 for one recording, by which optimizers and networks are compared.

Motion, measurements, strength and initial image are those of `reconstruct` (`scsr_opt.pipeline.assembly`). Two
differences: the prior is Huber-TV at every scale, and a sensor's fixed pattern is not estimated, since networks do not
correct it either; gains can be given.
"""

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any, SupportsFloat, SupportsIndex

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from scsr_opt._validation import pixel_gain
from scsr_opt.camera.recording import Recording
from scsr_opt.motion.trajectory import Motion
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.sampling import PlacedSamples, accumulate
from scsr_opt.pipeline.assembly import assemble_task
from scsr_opt.pipeline.options import Options
from scsr_opt.pipeline.task import Task, task_of
from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.priors.prior import Prior
from scsr_opt.solvers.problem import Problem

PRIOR = HuberTotalVariation()
"""Ψ of the problem by which all models are measured, whatever prior they use themselves."""


def reference_task(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
    prior: Prior = PRIOR,
    gain: Float[np.ndarray, "h w"] | None = None,
    strength: SupportsFloat | None = None,
) -> Task:
    """The clip of `spikes`, (T, h, w) of 0 and 1 or a `Recording`, that `reconstruct` would use, and its options.

    **Raises:** `InputError` for an argument that cannot be used.
    """
    return task_of(spikes, scale, key, Options(white_rate=white_rate, prior=prior, gain=gain, strength=strength))


@dataclass(frozen=True)
class ReferenceProblem:
    """minimise over X of f(X) + λΨ(X) (Eq. 4, halved) for one key frame.

    **Fields:**
    - `task`, with the clip; `motion` there; `gain` of each pixel, None for 1.
    - `placed`: the measurements at their places; `plain`: f, each exposure with the narrow stencil of its own places.
    - `strength` λ; `prior` Ψ; `first`: X^(0) of the solvers.
    - `seconds`: how long motion, samples and strength took.
    """

    task: Task
    motion: Motion
    gain: Float[np.ndarray, "h w"] | None
    placed: PlacedSamples
    plain: DataTerm
    strength: Float[Array, ""]
    prior: Prior
    first: Float[Array, "H W"]
    seconds: float

    @cached_property
    def weight(self) -> float:
        """Σ_j ω_j."""
        return float(jnp.sum(self.placed.weight))

    @property
    def usable(self) -> bool:
        """True if there is a sample to reconstruct from; if not, `reconstruct` ends with `Status.no_samples`."""
        return bool(self.task.clip.spikes.any()) and self.weight > 0

    def problem(self, image: Float[Array, "H W"]) -> Problem:
        """The problem with f exact at `image`, its value and its gradient: the motion during exposures is in it.

        Elsewhere f is on or above the exact one (`with_exposure`). Where exposures are short, the two are the same
        everywhere.
        """
        data = self.plain if self.placed.finest == 1 else with_exposure(self.plain, self.placed, image)
        return Problem(data, self.prior, self.strength)


def reference_problem(
    task: Task,
    *,
    prior: Prior = PRIOR,
    gain: ArrayLike | None = None,
    strength: SupportsFloat | None = None,
) -> ReferenceProblem:
    """The problem that `reconstruct` would solve for this clip.

    **Arguments:** `gain`: (h, w), 1 if not given; `strength`: validated for `prior` if not given.

    **Raises:** `InputError` if one of these cannot be used.
    """
    begin = time.perf_counter()
    # Never "auto", which would estimate them.
    gains = None if gain is None else pixel_gain(gain, task.recording.height, task.recording.width)
    clip: dict[str, Any] = {"scale": task.scale, "key": task.clip.key_frame, "white_rate": task.clip.white_rate}
    task = reference_task(task.recording, **clip, gain=gains, prior=prior, strength=strength)
    assembly = assemble_task(task)
    # Without a spike nothing is known of the noise, and nothing will be solved.
    λ = assembly.strength if assembly.usable or strength is not None else 0.0
    return ReferenceProblem(
        task=task,
        motion=assembly.motion,
        gain=assembly.gain,
        placed=assembly.measurements.placed,
        plain=accumulate(assembly.measurements.placed),
        strength=jnp.asarray(λ, jnp.float32),
        prior=prior,
        first=assembly.image,
        seconds=time.perf_counter() - begin,
    )


class Reading(eqx.Module):
    """Value of Eq. 4 at a picture X: `data` f(X), `prior` λΨ(X), and `slope` ∇f(X)."""

    data: Float[Array, ""]
    prior: Float[Array, ""]
    slope: Float[Array, "H W"]

    @property
    def objective(self) -> Float[Array, ""]:
        """Eq. 4, halved: data part plus λΨ."""
        return self.data + self.prior


def read(posed: ReferenceProblem, image: Float[Array, "H W"]) -> Reading:
    """f, λΨ and ∇f at a picture, f exact there."""
    return _read(posed.problem(image), image)


@eqx.filter_jit
def _read(problem: Problem, image: Float[Array, "H W"]) -> Reading:
    data, slope = problem.data.value_and_gradient(image)
    return Reading(data, problem.strength * problem.prior.value(image), slope)
