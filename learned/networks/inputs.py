"""Inputs of an unrolled iteration: the data term of Eq. 4 with its samples in groups, and a start.

All inputs are made by the functions that `scsr_opt.reconstruct` uses, from the motion that its estimator finds, so that
optimiser and network look at the same numbers.
"""

import itertools
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt.camera.sampling_rules import Intervals
from scsr_opt.motion.estimators.automatic import estimate_motion
from scsr_opt.motion.trajectory import Motion
from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.data_term import DataTerm, Stencil
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.sampling import accumulate
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.initial_image import initial_image
from scsr_opt.pipeline.measurement import measure
from scsr_opt.pipeline.strength import noise_of_mean, strength_of_noise
from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.solvers.loop import run
from scsr_opt.solvers.problem import Problem, lipschitz_bound
from scsr_opt.solvers.proximal_gradient import FISTA


class Inputs(eqx.Module):
    """The data term f of Eq. 4, what of it came from samples long before or after the key frame, and where to start.

    **Fields:**
    - `term`: f of all samples. Where exposures are long, its c is corrected at one picture (`with_exposure`).
    - `planes`, `targets`: M_g and c_g of the later groups g = 2 … G alone; the first group is what is left of `term`.
    - `image`: X^(0), intensity.
    - `step_size`: 1/L, L a certain bound on the Lipschitz constant of ∇f (`lipschitz_bound`).
    - `noise`: standard deviation of a pixel's mean over the recording, intensity (`noise_of_mean`).
    """

    term: DataTerm
    planes: Float[Array, "groups 5 H W"]
    targets: Float[Array, "groups H W"]
    image: Float[Array, "H W"]
    step_size: Float[Array, ""]
    noise: Float[Array, ""]

    def weighted(self, weights: Float[Array, " groups"]) -> DataTerm:
        """f with the samples of the later groups weighted anew, those of the first as they are.

        It is `term` + Σ_g (w_g − 1) f_g: with all weights 1, `term` to the last bit.
        """
        more = weights - 1
        planes = self.term.stencil.planes + jnp.tensordot(more, self.planes, 1)
        target = self.term.target + jnp.tensordot(more, self.targets, 1)
        return eqx.tree_at(lambda t: (t.stencil.planes, t.target), self.term, (planes, target))

    def arrays(self) -> dict[str, Float[Array, "..."]]:
        """All that an iteration uses, by name; `of_arrays` goes back. (f's constant e has no part in it.)"""
        return {
            "planes": jnp.concatenate([self.term.stencil.planes[None], self.planes]),
            "targets": jnp.concatenate([self.term.target[None], self.targets]),
            "image": self.image,
            "step_size": self.step_size,
            "noise": self.noise,
        }

    @classmethod
    def of_arrays(cls, arrays: dict[str, Float[Array, "..."]], scale: int) -> "Inputs":
        """The inputs that `arrays` took apart, at any precision."""
        planes, targets, image, step_size, noise = (
            jnp.asarray(arrays[name], jnp.float32) for name in ("planes", "targets", "image", "step_size", "noise")
        )
        height, width = image.shape
        energy = jnp.full((), jnp.nan, jnp.float32)  # not kept
        term = DataTerm(Stencil(planes[0]), targets[0], energy, Aperture((height, width), scale), None)
        return cls(term, planes[1:], targets[1:], image, step_size, noise)


def make_inputs(
    clip: Clip,
    *,
    scale: int,
    boundaries: tuple[int, ...] = (),
    motion: Motion | None = None,
    exposure_iterations: int = 4,
) -> Inputs:
    """The inputs of a recording, as `scsr_opt.reconstruct` would measure it: spike intervals, estimated motion.

    Where surfaces move during exposures, c is corrected for that once, at the picture after a few iterations of FISTA
    with total variation (Huber): an optimiser corrects it again after each solve. Gains of the pixels are taken as 1.

    **Arguments:**
    - `scale`: s ≥ 1.
    - `boundaries`: frames from the key frame at which one group of samples ends and the next begins, by the middle of
      their exposure; rising. None: one group.
    - `motion`: if it is known; estimated as `reconstruct` does by itself if not given.
    - `exposure_iterations`: of FISTA for the picture at which c is corrected. After 4 a solution is as good as with all
      corrections by day (3 scenes, ×4, within 0.1 dB); in dim light (5 scenes) 0.2 dB worse, and 0.85 dB better than
      without a correction.
    """
    height, width = clip.spikes.shape[1:]
    if motion is None:
        motion = estimate_motion(clip.spikes, key=clip.key, white_rate=clip.white_rate, bad_pixels=clip.bad_pixels)
    taken = measure(clip, motion, scale=scale, sampling=Intervals())
    placed, image = taken.placed, initial_image(clip, (scale * height, scale * width))
    term = accumulate(placed)
    away = jnp.abs(jnp.asarray(taken.padded.start + taken.padded.stop) / 2 - clip.key)
    members = members_of(away, boundaries)
    groups = [accumulate(placed, robust=member) for member in members]
    step_size, noise = 1 / lipschitz_bound(term), noise_of_mean(clip)
    if placed.finest > 1:
        prior = HuberTotalVariation()
        strength = jnp.asarray(strength_of_noise(noise, scale, prior), jnp.float32)
        touched = Problem(with_exposure(term, placed, image), prior, strength)
        touch = jnp.asarray(run(FISTA(exposure_iterations, 0.0), touched, image).image)
        term = with_exposure(term, placed, touch)
        groups = [
            with_exposure(group, placed, touch, robust=member) for group, member in zip(groups, members, strict=True)
        ]
    return Inputs(
        term,
        jnp.stack([g.stencil.planes for g in groups]) if groups else jnp.zeros((0, *term.stencil.planes.shape)),
        jnp.stack([g.target for g in groups]) if groups else jnp.zeros((0, *term.shape)),
        image,
        step_size,
        jnp.asarray(noise, jnp.float32),
    )


def members_of(away: Float[Array, " n"], boundaries: tuple[int, ...]) -> list[Float[Array, " n"]]:
    """1 for the samples of each later group, by how many frames from the key frame they lie; 0 for all others."""
    ends = itertools.pairwise((*boundaries, math.inf))
    return [jnp.asarray((away >= begin) & (away < end), away.dtype) for begin, end in ends]
