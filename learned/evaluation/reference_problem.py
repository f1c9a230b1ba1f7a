"""Eq. 4 for one recording: what the optimizer finds out before it iterates, so that networks can be measured by it.

Motion, measurements, strength and first picture are those of `reconstruct` (`scsr_opt.pipeline.assembly`). Two
differences: the prior is Huber-TV at every scale, and a sensor's fixed pattern is not looked for. Networks know nothing
of it, so it stays in what all are compared on, unless the gains are handed in.
"""

import time
from dataclasses import dataclass
from functools import cached_property
from typing import SupportsFloat, SupportsIndex

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped
from numpy.typing import ArrayLike
from scipy.ndimage import distance_transform_edt

from scsr_opt._kernels.programs import ready
from scsr_opt._validation import picture_shape, pixel_gain, whole
from scsr_opt.camera.recording import Recording
from scsr_opt.motion.trajectory import Motion
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.sampling import PlacedSamples, accumulate
from scsr_opt.pipeline.assembly import assemble_task
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.options import Options
from scsr_opt.pipeline.task import task_of
from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.priors.prior import Prior
from scsr_opt.solvers.problem import Problem

PRIOR = HuberTotalVariation()
"""Ψ of the problem that all models are measured by, whatever they were given or have learned."""


@dataclass(frozen=True)
class ReferenceClip:
    """A key frame of a recording and the frames around it, as `reconstruct` cuts them out.

    **Fields:** `recording`; `scale` s; `clip`, the frames that are used.
    """

    recording: Recording
    scale: int
    clip: Clip

    @property
    def key(self) -> int:
        """The key frame, a frame of the recording."""
        return self.clip.key_frame

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the picture."""
        return self.scale * self.recording.height, self.scale * self.recording.width

    @cached_property
    def seen(self) -> Shaped[np.ndarray, "T h w"]:
        """The spikes of the clip as a network sees them: a bad pixel fires as the nearest good one does."""
        spikes, bad = self.clip.spikes, self.clip.bad_pixels
        if bad is None or not bad.any() or bad.all():
            return spikes
        row, column = np.asarray(distance_transform_edt(bad, return_distances=False, return_indices=True))
        return spikes[:, row, column]


def reference_clip(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
) -> ReferenceClip:
    """The moment of `spikes`, (T, h, w) of 0 and 1 or a `Recording`, that `reconstruct` would show.

    **Raises:** `InputError` if something handed in cannot be used.
    """
    ready()
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
    scale = whole(scale, "scale", 1)
    picture_shape((recording.height, recording.width), scale)
    return ReferenceClip(recording, scale, Clip.around(recording, key, white_rate=white_rate))


@dataclass(frozen=True)
class ReferenceProblem:
    """minimise over X of f(X) + λΨ(X) (Eq. 4, halved) for one moment.

    **Fields:**
    - `clip`; `motion` there; `gain` of each pixel, None for 1.
    - `placed`: the measurements at their places; `plain`: f, each exposure with the narrow stencil of its own places.
    - `strength` λ; `prior` Ψ; `first`: X^(0) of the solvers.
    - `seconds`: how long motion, samples and strength took.
    """

    clip: ReferenceClip
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
        """Whether there is anything to reconstruct from; if not, `reconstruct` ends with `Status.no_samples`."""
        return bool(self.clip.clip.spikes.any()) and self.weight > 0

    def problem(self, image: Float[Array, "H W"]) -> Problem:
        """The problem with f exact at `image`, its value and its gradient: the motion during exposures is in it.

        Elsewhere f is on or above the exact one (`with_exposure`). Where exposures are short, the two are the same
        everywhere.
        """
        data = self.plain if self.placed.finest == 1 else with_exposure(self.plain, self.placed, image)
        return Problem(data, self.prior, self.strength)


def reference_problem(
    clip: ReferenceClip,
    *,
    prior: Prior = PRIOR,
    gain: ArrayLike | None = None,
    strength: SupportsFloat | None = None,
) -> ReferenceProblem:
    """The problem that `reconstruct` would solve for this moment.

    **Arguments:** `gain`: (h, w), 1 if not given; `strength`: validated for `prior` if not given.

    **Raises:** `InputError` if one of these cannot be used.
    """
    begin = time.perf_counter()
    # Never "auto", which would look for them.
    gains = None if gain is None else pixel_gain(gain, clip.recording.height, clip.recording.width)
    options = Options(white_rate=clip.clip.white_rate, gain=gains, prior=prior, strength=strength)
    assembly = assemble_task(task_of(clip.recording, clip.scale, clip.key, options))
    # Of an empty recording nothing is known of the noise, and nothing will be solved.
    λ = assembly.strength if assembly.usable or strength is not None else 0.0
    return ReferenceProblem(
        clip=clip,
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
    """What Eq. 4 says of a picture X.

    **Fields:** `data` f(X), `prior` λΨ(X), `slope` ∇f(X).
    """

    data: Float[Array, ""]
    prior: Float[Array, ""]
    slope: Float[Array, "H W"]

    @property
    def objective(self) -> Float[Array, ""]:
        return self.data + self.prior


def read(posed: ReferenceProblem, image: Float[Array, "H W"]) -> Reading:
    """f, λΨ and ∇f at a picture, f exact there."""
    return _read(posed.problem(image), image)


@eqx.filter_jit
def _read(problem: Problem, image: Float[Array, "H W"]) -> Reading:
    data, slope = problem.data.value_and_gradient(image)
    return Reading(data, problem.strength * problem.prior.value(image), slope)
