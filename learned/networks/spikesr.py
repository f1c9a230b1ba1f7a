"""SpikeSR-Net (AAAI 2023, Eq. 3 and 6-14): spike encoder, initialisation, and T stages of gradient and proximal module.

Each stage gives an R^(t) and an X^(t), as each iteration of a solver does, so that both can be compared.

**What the paper leaves open, and what is chosen here.** It gives the stage count (4), four residual blocks in the
kernel predictor, the loss, and no other size. The measure for the rest are the 3.34 M parameters that later work counts
(Spk2VidNet, in its comparison).

| left open | `full` | `small` |
|---|---|---|
| blocks n, their length L, frames between them | 5, 13, 7: 41 frames, as many as Spk2ImgNet (Zhao 2021b) | the same |
| filter sizes K of the PASE's branches | 1, 1, 3, 3, 3, 5, 5, 7 | 1, 3, 3, 5 |
| last layer of the kernel predictor | 1×1 | 1×1 |
| feature channels: encoder, super resolver, PMM | 64, 32, 64 | 16, 16, 48 |
| residual blocks in H, H⁻¹, P | 2, 2, 5 | 1, 1, 3 |
| weights of the stages | each its own | shared: each step of a short training teaches all four |
| offsets: groups of channels, pyramid levels | 4, 2 | 2, 1 |
| resolution of the gradient and proximal features | the picture's | the sensor's |
| activations | leaky ReLU, slope 0.1 | the same |
| kernels of D_s and D_s⁻¹ | s + 2 | s + 2 |
| parameters, ×2 and ×4 | 3.34 M, 3.41 M | 0.26 M, 0.28 M |

What light there is does not matter to the paper's parts: they see the spikes divided by `white_rate`, whose mean over
time is intensity. X^(0) is the enlarged firing rate of all blocks plus what the initialisation adds, and the modules
only ever add to a picture.

**What is added to the paper's.** With `velocity_channels` the network has an estimate of velocity that is taught the
true motion of simulated scenes (`learned.networks.velocity`, 0.05 M parameters). Offsets then start from the estimate,
and X^(0) from spike intervals read along the tracks (`learned.networks.compensation`); with `deblur_channels` that is
sharpened first, by layers gated by motion, noise and light. The shipped ones have both: where the scene moves,
offsets that only the picture's loss teaches stay far from the motion.
"""

import dataclasses
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from learned.networks.compensation import Deblurring, compensated
from learned.networks.encoder import PASE, block_times, check_blocks, check_branches, spike_blocks
from learned.networks.fusion import Initialisation
from learned.networks.gradient import GradientModule
from learned.networks.layers import at_least_float32, check_sizes
from learned.networks.proximal import ProximalModule
from learned.networks.velocity import VelocityEstimator, base_moments, refined
from scsr_opt.camera.recording import WHITE_RATE
from scsr_opt.errors import InputError


@dataclasses.dataclass(frozen=True)
class SpikeSRConfig:
    """All sizes of a `SpikeSRNet`, and what is left out of it.

    **Fields:**
    - `scale`: s ≥ 1.
    - `blocks`, `length`, `spacing`: n (odd), L and the frames from one block to the next (`spike_blocks`).
    - `branches`: the filter sizes of the PASE, odd.
    - `encoder_channels`, `encoder_blocks`: of the kernel predictor.
    - `channels`: features of the initialisation and the gradient modules.
    - `proximal_channels`, `proximal_blocks`: of the proximal modules.
    - `degradation_blocks`, `refinement_blocks`: residual blocks in H_i and H_i⁻¹.
    - `groups`, `levels`: of the alignment (`Align`); `groups` divides `channels`.
    - `working_scale`: resolution of the features of gradient and proximal modules in multiples of the sensor's, a
      divisor of `scale`.
    - `stages`: T ≥ 1. `share_stages`: whether all use the same weights.
    - `rematerialise`: keep only each stage's picture for the gradient and calculate the rest again: about a third more
      time, a T-th of the memory.
    - `pase`, `gradient`, `alignment`, `proximal`: False leaves the part out (the paper's Table 2). Without the PASE the
      latent intensity is the block of spikes as it is, its frames as channels; without the gradient module R^(t) =
      X^(t−1); without alignment its deformable convolutions are plain; without the proximal module X^(t) = R^(t).
    - `velocity_channels`: of the estimator of velocity (`learned.networks.velocity`); 0: there is none, as in the
      paper. With it X^(0) starts from `moments` short times brought to the key frame in the place of the plain firing
      rate, and offsets from the estimated displacement.
    - `deblur_channels`: with it, of the layers at the picture's resolution that sharpen what X^(0) starts from
      (`Deblurring`); 0: there are none. It takes an estimate of velocity.
    - `velocity_weight`: of the velocity's error in the training loss. The pictures do not teach it: at 0 the estimator
      stays as it was before training.

    **Raises:** `InputError` for a value that is not allowed, with the name of its field.
    """

    scale: int = 4
    blocks: int = 5
    length: int = 13
    spacing: int = 7
    branches: tuple[int, ...] = (1, 1, 3, 3, 3, 5, 5, 7)
    encoder_channels: int = 64
    encoder_blocks: int = 4
    channels: int = 32
    proximal_channels: int = 64
    degradation_blocks: int = 2
    refinement_blocks: int = 2
    proximal_blocks: int = 5
    groups: int = 4
    levels: int = 2
    working_scale: int = 4
    stages: int = 4
    share_stages: bool = False
    rematerialise: bool = False
    pase: bool = True
    gradient: bool = True
    alignment: bool = True
    proximal: bool = True
    velocity_channels: int = 0
    velocity_weight: float = 0.0
    moments: int = 21
    deblur_channels: int = 0

    def __post_init__(self):
        ones = ("encoder_channels", "channels", "proximal_channels", "groups", "stages", "scale", "working_scale")
        zeros = ("encoder_blocks", "degradation_blocks", "refinement_blocks", "proximal_blocks", "levels")
        zeros += ("velocity_channels", "velocity_weight", "deblur_channels")
        check_sizes(self, **dict.fromkeys(ones, 1), **dict.fromkeys(zeros, 0))
        if self.deblur_channels and not self.velocity_channels:
            raise InputError(
                f"deblur_channels is {self.deblur_channels}, but velocity_channels is 0: what is sharpened has been "
                f"brought together along the motion; give both, or deblur_channels = 0."
            )
        check_blocks(self.moments, 3, 3)
        check_blocks(self.blocks, self.length, self.spacing)
        check_branches(self.branches)
        if self.scale % self.working_scale:
            raise InputError(f"working_scale is {self.working_scale}; it must divide the scale, {self.scale}.")
        if self.channels % self.groups:
            raise InputError(f"groups is {self.groups}; it must divide channels, {self.channels}.")
        if not (self.gradient or self.proximal):
            raise InputError("gradient and proximal are both False, and a stage would do nothing; leave out one only.")

    @classmethod
    def full(cls, scale: int, **changes: Any) -> "SpikeSRConfig":
        """About as large as the paper's network, 3.34 M parameters; `changes` replace single fields."""
        return cls(**{"scale": scale, "working_scale": scale, **changes})

    @classmethod
    def small(cls, scale: int, **changes: Any) -> "SpikeSRConfig":
        """At most 0.4 M parameters and all work at the sensor's resolution; `changes` replace single fields."""
        sizes = {
            "scale": scale,
            "branches": (1, 3, 3, 5),
            "encoder_channels": 16,
            "channels": 16,
            "proximal_channels": 48,
            "degradation_blocks": 1,
            "refinement_blocks": 1,
            "proximal_blocks": 3,
            "groups": 2,
            "levels": 1,
            "working_scale": 1,
            "share_stages": True,
        }
        return cls(**{**sizes, **changes})


class Iterates(NamedTuple):
    """Pictures of the stages, in intensity (1 = white), with time as the first axis.

    **Fields:** `gradient_steps`: R^(1) … R^(T); `images`: X^(1) … X^(T), the last one the result. Both (T, H, W).
    """

    gradient_steps: Float[Array, "stages H W"]
    images: Float[Array, "stages H W"]


class Encoded(NamedTuple):
    """A recording as the stages see it.

    **Fields:**
    - `latent`: Y_1 … Y_n (Eq. 3).
    - `base`: what X^(0) starts from, intensity: the enlarged firing rate, or moments brought together along the
      estimated motion (`learned.networks.compensation`), sharpened if there is a `Deblurring`.
    - `guides`: with an estimator of velocity, where each block shows what the key frame does, sensor pixels.
    - `velocity`: with it, sensor pixels per frame.
    """

    latent: Float[Array, "n C h w"]
    base: Float[Array, "H W"]
    guides: Float[Array, "n 2 h w"] | None
    velocity: Float[Array, "2 h w"] | None


class UnrolledStage(eqx.Module):
    """One iteration of Eq. 6: R^(t) = G(X^(t−1), Y), X^(t) = P(R^(t)). A module that is None is left out."""

    gradient: GradientModule | None
    proximal: ProximalModule | None

    def __init__(self, config: SpikeSRConfig, *, key: PRNGKeyArray):
        gradient, proximal = jax.random.split(key)
        self.gradient = self.proximal = None
        if config.gradient:
            self.gradient = GradientModule(
                _latent_channels(config),
                config.channels,
                scale=config.scale,
                working_scale=config.working_scale,
                degradation=config.degradation_blocks,
                refinement=config.refinement_blocks,
                groups=config.groups,
                levels=config.levels,
                deform=config.alignment,
                key=gradient,
            )
        if config.proximal:
            folding = config.scale // config.working_scale
            self.proximal = ProximalModule(config.proximal_channels, config.proximal_blocks, folding, key=proximal)

    def __call__(
        self,
        image: Float[Array, "H W"],
        latent: Float[Array, "n C h w"],
        guides: Float[Array, "n 2 H_w W_w"] | None = None,
    ) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
        """X^(t−1) and Y to R^(t) and X^(t); `guides` as of `GradientModule`."""
        step = image if self.gradient is None else self.gradient(image, latent, guides)
        return step, step if self.proximal is None else self.proximal(step)


class SpikeSRNet(eqx.Module):
    """SpikeSR-Net: spikes around a key frame to the high-resolution picture of that moment, in T stages.

    `net(spikes, key_frame, white_rate)` gives the `Iterates`. Any recording of at least `length` frames and any sensor
    size will do; see `spike_blocks` for what happens at a recording's ends.

    **Arguments:**
    - `config`: the sizes.
    - `key`: of the random first weights.
    """

    encoder: PASE | None
    velocity: VelocityEstimator | None
    deblurring: Deblurring | None
    initialisation: Initialisation
    stages: UnrolledStage
    """All T stages in one, their weights stacked along a first axis (of length 1 where they are shared)."""
    config: SpikeSRConfig = eqx.field(static=True)

    def __init__(self, config: SpikeSRConfig, *, key: PRNGKeyArray):
        encoder, initialisation, stages = jax.random.split(key, 3)
        self.encoder = None
        if config.pase:
            channels, blocks = config.encoder_channels, config.encoder_blocks
            self.encoder = PASE(config.length, config.branches, channels, blocks, key=encoder)
        self.velocity = self.deblurring = None
        if config.deblur_channels:
            self.deblurring = Deblurring(config.deblur_channels, key=jax.random.fold_in(key, 2))
        if config.velocity_channels:
            # A key of its own: the other weights are those of a network without.
            self.velocity = VelocityEstimator(config.velocity_channels, key=jax.random.fold_in(key, 1))
        self.initialisation = Initialisation(
            _latent_channels(config),
            config.channels,
            scale=config.scale,
            groups=config.groups,
            levels=config.levels,
            deform=config.alignment,
            key=initialisation,
        )
        keys = jax.random.split(stages, 1 if config.share_stages else config.stages)
        self.stages = eqx.filter_vmap(lambda k: UnrolledStage(config, key=k))(keys)
        self.config = config

    def encode(
        self,
        spikes: Shaped[Array, "T h w"],
        key_frame: Int[Array, ""] | int,
        white_rate: Float[Array, ""] | float | int = WHITE_RATE,
    ) -> Encoded:
        """All that is calculated once, before the first stage.

        **Raises:** as `spike_blocks`.
        """
        config = self.config
        blocks = spike_blocks(spikes, key_frame, config.blocks, config.length, config.spacing)
        dtype = self.initialisation.entry.weight.dtype
        # Pictures are float32 at least: what half precision would lose of them no stage could bring back.
        blocks = blocks.astype(jnp.float32) / jnp.asarray(white_rate, jnp.float32)
        rate = jnp.mean(blocks, axis=(0, 1))
        blocks = blocks.astype(dtype)
        latent = blocks if self.encoder is None else jax.vmap(self.encoder)(blocks)
        precise = at_least_float32(dtype)
        if self.velocity is None:
            rows, columns = (config.scale * size for size in rate.shape)
            return Encoded(latent, jax.image.resize(rate.astype(precise), (rows, columns), "cubic"), None, None)
        velocity = self.velocity(spikes, key_frame, white_rate)
        # What the pictures say of the velocity is much less than what the simulator does, and dear.
        seen = base_moments(spikes, key_frame, white_rate, config.moments)
        known = refined(seen, jax.lax.stop_gradient(velocity))
        times = block_times(spikes.shape[0], key_frame, config.blocks, config.length, config.spacing)
        guides = jax.vmap(lambda time: time * known)(times)
        together = compensated(seen, known, config.scale)
        base = together.mean
        if self.deblurring is not None:
            base = self.deblurring(together, white_rate)
        return Encoded(latent, base.astype(precise), guides, velocity)

    def initial(self, seen: Encoded) -> Float[Array, "H W"]:
        """X^(0): the base, and what the motion-aligned fusion adds to it."""
        return seen.base + self.initialisation(seen.latent, seen.guides).astype(seen.base.dtype)

    def stage(self, number: int) -> UnrolledStage:
        """Stage t, counted from 1 as in the paper.

        **Raises:** `InputError` for a stage that does not exist.
        """
        if not 1 <= number <= self.config.stages:
            raise InputError(f"There is no stage {number}; this network's are 1 to {self.config.stages}.")
        place = 0 if self.config.share_stages else number - 1
        return jax.tree.map(lambda x: x[place], self.stages)

    def __call__(
        self,
        spikes: Shaped[Array, "T h w"],
        key_frame: Int[Array, ""] | int,
        white_rate: Float[Array, ""] | float | int = WHITE_RATE,
        start: Float[Array, "H W"] | None = None,
    ) -> Iterates:
        """R^(t) and X^(t) of all stages.

        **Arguments:**
        - `spikes`: (T, h, w), 0 and 1 of any dtype.
        - `key_frame`: 0 to T − 1; may be traced.
        - `white_rate`: spikes per frame of a pixel at intensity 1.
        - `start`: X^(0), if the iteration is to start at another picture than its own.

        **Raises:** `InputError` if the recording is too short or `start` has another shape than the picture.
        """
        return self.iterate(self.encode(spikes, key_frame, white_rate), start)

    def iterate(self, seen: Encoded, start: Float[Array, "H W"] | None = None) -> Iterates:
        """The stages alone. **Raises:** `InputError` if `start` has another shape than the picture."""
        if start is None:
            start = self.initial(seen)
        elif start.shape != seen.base.shape:
            raise InputError(
                f"The start has shape {start.shape}; for this recording at scale {self.config.scale} it must be "
                f"{seen.base.shape}."
            )

        start = start.astype(seen.base.dtype)
        guides = self.working_guides(seen)

        def run(image: Float[Array, "H W"], weights: UnrolledStage) -> tuple[Float[Array, "H W"], Iterates]:
            step, image = weights(image, seen.latent, guides)
            return image, Iterates(step, image)

        if self.config.rematerialise:
            run = jax.checkpoint(run)
        # Both unrolled, as in `ConvGRU`: loops are slow on a CPU.
        if self.config.share_stages:
            shared = self.stage(1)
            return jax.lax.scan(lambda x, _: run(x, shared), start, length=self.config.stages, unroll=True)[1]
        return jax.lax.scan(run, start, self.stages, unroll=True)[1]

    def working_guides(self, seen: Encoded) -> Float[Array, "n 2 H_w W_w"] | None:
        """The guides in pixels of the features of the gradient modules."""
        factor = self.config.working_scale
        if seen.guides is None or factor == 1:
            return seen.guides
        n, _, rows, columns = seen.guides.shape
        return factor * jax.image.resize(seen.guides, (n, 2, factor * rows, factor * columns), "linear")


def _latent_channels(config: SpikeSRConfig) -> int:
    return len(config.branches) if config.pase else config.length


def spikesr_loss(images: Float[Array, "stages H W"], truth: Float[Array, "H W"]) -> Float[Array, ""]:
    """Eq. 14: Σ_t λ_t ‖X^(t) − I‖₁, λ_t = 0.1 for t < T and 1 for the last, ‖·‖₁ as the mean over pixels.

    The paper writes a norm without saying which; L1 is chosen, usual for pictures.
    """
    errors = jnp.mean(jnp.abs(images - truth[None]), axis=(1, 2))
    return 0.1 * jnp.sum(errors[:-1]) + errors[-1]


def parameter_count(model: Any) -> int:
    """Numbers that are learned. `model` may be a shape only (`equinox.filter_eval_shape`)."""
    leaves = jax.tree.leaves(model)
    return sum(cast(int, leaf.size) for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.inexact))
