"""SpikeSR-Net (AAAI 2023, Eq. 3 and 6-14): spike encoder, initialisation, and T stages of gradient and proximal module.

Each stage gives an R^(t) and an X^(t), as each iteration of a solver does, so the two can be laid side by side.

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

What light there is does not matter to the network: it sees the spikes divided by `white_rate`, whose mean over time is
intensity. X^(0) is the enlarged firing rate of all blocks plus what the initialisation adds, and the modules only ever
add to a picture.
"""

import dataclasses
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from learned.encoder import PASE, check_blocks, check_branches, spike_blocks
from learned.fusion import Initialisation
from learned.gradient import GradientModule
from learned.layers import at_least_float32
from learned.proximal import ProximalModule
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

    def __post_init__(self):
        for name in ("encoder_channels", "channels", "proximal_channels", "groups", "stages", "scale", "working_scale"):
            self._check(name, 1)
        for name in ("encoder_blocks", "degradation_blocks", "refinement_blocks", "proximal_blocks", "levels"):
            self._check(name, 0)
        check_blocks(self.blocks, self.length, self.spacing)
        check_branches(self.branches)
        if self.scale % self.working_scale:
            raise InputError(f"working_scale is {self.working_scale}; it must divide the scale, {self.scale}.")
        if self.channels % self.groups:
            raise InputError(f"groups is {self.groups}; it must divide channels, {self.channels}.")
        if not (self.gradient or self.proximal):
            raise InputError("gradient and proximal are both False, and a stage would do nothing; leave out one only.")

    def _check(self, name: str, least: int) -> None:
        if getattr(self, name) < least:
            raise InputError(f"{name} is {getattr(self, name)}; it must be at least {least}.")

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
    """What the stages give, in intensity (1 = white), with time as the first axis.

    **Fields:** `gradient_steps`: R^(1) … R^(T); `images`: X^(1) … X^(T), the last one the result. Both (T, H, W).
    """

    gradient_steps: Float[Array, "stages H W"]
    images: Float[Array, "stages H W"]


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
        self, image: Float[Array, "H W"], latent: Float[Array, "n C h w"]
    ) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
        """X^(t−1) and Y to R^(t) and X^(t)."""
        step = image if self.gradient is None else self.gradient(image, latent)
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
    ) -> tuple[Float[Array, "n C h w"], Float[Array, "h w"]]:
        """Y_1 … Y_n (Eq. 3), and the firing rate of all blocks as intensity.

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
        return latent, rate.astype(at_least_float32(dtype))

    def initial(self, latent: Float[Array, "n C h w"], rate: Float[Array, "h w"]) -> Float[Array, "H W"]:
        """X^(0): the enlarged firing rate (cubic) and what the motion-aligned fusion adds to it."""
        rows, columns = (self.config.scale * size for size in rate.shape)
        base = jax.image.resize(rate, (rows, columns), "cubic")
        return base + self.initialisation(latent).astype(base.dtype)

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
        latent, rate = self.encode(spikes, key_frame, white_rate)
        if start is None:
            start = self.initial(latent, rate)
        elif start.shape != tuple(self.config.scale * size for size in rate.shape):
            raise InputError(
                f"The start has shape {start.shape}; for this recording at scale {self.config.scale} it must be "
                f"{tuple(self.config.scale * size for size in rate.shape)}."
            )

        start = start.astype(rate.dtype)

        def run(image: Float[Array, "H W"], weights: UnrolledStage) -> tuple[Float[Array, "H W"], Iterates]:
            step, image = weights(image, latent)
            return image, Iterates(step, image)

        if self.config.rematerialise:
            run = jax.checkpoint(run)
        # Both unrolled, as in `ConvGRU`: loops are slow on a CPU.
        if self.config.share_stages:
            shared = self.stage(1)
            return jax.lax.scan(lambda x, _: run(x, shared), start, length=self.config.stages, unroll=True)[1]
        return jax.lax.scan(run, start, self.stages, unroll=True)[1]


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
