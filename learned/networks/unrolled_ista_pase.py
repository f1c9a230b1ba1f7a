"""The unrolled iteration with learned measurements: short blocks of spikes, encoded.

Encoded blocks replace spike intervals. The Y_i of Eq. 4 are the outputs of PASE (Eq. 3) for n short-term blocks around
the key frame, the mean over its branches, placed along the motion at the blocks' middle frames. Where they lie, and so
M = Σ ω r_j r_jᵀ, follows from the motion alone; c = Σ ω r_j Y_j is linear in Y, so that the loss's gradient reaches the
encoder. The stages are those of `learned.networks.unrolled_ista`.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from learned.networks.encoder import PASE, check_blocks, check_branches, spike_blocks
from learned.networks.inputs import Inputs, members_of
from learned.networks.layers import check_sizes
from learned.networks.spikesr import Iterates
from learned.networks.unrolled_ista import UnrolledConfig, UnrolledISTA
from scsr_opt.camera.samples import Samples
from scsr_opt.motion.estimators.automatic import estimate_motion
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.data_term import DataTerm, Stencil
from scsr_opt.operators.sampling import PlacedSamples, Taps, accumulate, place
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.initial_image import initial_image
from scsr_opt.pipeline.strength import noise_of_mean
from scsr_opt.solvers.problem import lipschitz_bound


@dataclasses.dataclass(frozen=True)
class UnrolledPASEConfig(UnrolledConfig):
    """All sizes of an `UnrolledPASE`: those of `UnrolledConfig`, and of the encoder.

    **Fields:**
    - `moments`, `length`, `spacing`: how many blocks of spikes (odd), of how many frames, and the frames from one to
      the next (`spike_blocks`).
    - `branches`: the filter sizes of the PASE, odd.
    - `encoder_channels`, `encoder_blocks`: of its kernel predictor.

    **Raises:** `InputError` for a value that is not allowed.
    """

    moments: int = 9
    length: int = 13
    spacing: int = 10
    branches: tuple[int, ...] = (1, 3, 3, 5)
    encoder_channels: int = 16
    encoder_blocks: int = 4

    def __post_init__(self):
        super().__post_init__()
        check_sizes(self, encoder_channels=1, encoder_blocks=0)
        check_blocks(self.moments, self.length, self.spacing)
        check_branches(self.branches)


class SpikeInputs(eqx.Module):
    """Blocks of spikes, where their measurements lie on the picture, and where to start.

    **Fields:**
    - `spikes`: (n, L, h, w), 0 and 1, the blocks; `white_rate`: spikes per frame of intensity 1.
    - `index`, `down`, `right`, `weight` (n·h·w,): as of `PlacedSamples`, by block, row and column.
    - `members`: (G − 1, n·h·w), 1 for the samples of each later group.
    - `planes`: (G, 5, H, W), M of all samples, then M_g of the later groups.
    - `image`, `step_size`, `noise`: as of `Inputs`.
    """

    spikes: Shaped[Array, "n L h w"]
    white_rate: Float[Array, ""]
    index: Shaped[Array, " m"]
    down: Float[Array, " m"]
    right: Float[Array, " m"]
    weight: Float[Array, " m"]
    members: Float[Array, "later m"]
    planes: Float[Array, "groups 5 H W"]
    image: Float[Array, "H W"]
    step_size: Float[Array, ""]
    noise: Float[Array, ""]

    def measured_as(self, values: Float[Array, "n h w"], scale: int) -> Inputs:
        """Inputs of the iteration for blocks that measure `values`."""
        shape = (self.image.shape[0], self.image.shape[1])
        measured = values.reshape(-1)
        taps = Taps(self.index[None], self.down[None], self.right[None])
        placed = PlacedSamples(taps, jnp.ones_like(self.index), measured, self.weight, scale, shape)
        weighted = self.weight * measured
        energy = jnp.sum(weighted * measured)
        term = DataTerm(Stencil(self.planes[0]), placed.spread(weighted), energy, Aperture(shape, scale), None)
        targets = [placed.spread(weighted * member) for member in self.members]
        return Inputs(
            term,
            self.planes[1:],
            jnp.stack(targets) if targets else jnp.zeros((0, *shape)),
            self.image,
            self.step_size,
            self.noise,
        )

    def arrays(self) -> dict[str, Shaped[Array, "..."]]:
        """All fields by name; `of_arrays` goes back."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @classmethod
    def of_arrays(cls, arrays: dict[str, Shaped[Array, "..."]]) -> "SpikeInputs":
        """The inputs that `arrays` took apart, at any precision."""
        found = {field.name: jnp.asarray(arrays[field.name]) for field in dataclasses.fields(cls)}
        floats = {name: v.astype(jnp.float32) for name, v in found.items() if jnp.issubdtype(v.dtype, jnp.floating)}
        return cls(**(found | floats))


def make_spike_inputs(
    clip: Clip, *, scale: int, config: UnrolledPASEConfig, motion: Motion | None = None
) -> SpikeInputs:
    """The inputs of a recording.

    **Arguments:** `motion`: if it is known; estimated as `scsr_opt.reconstruct` does by itself if not given.

    **Raises:** `InputError` if the recording is shorter than a block.
    """
    frames, height, width = clip.spikes.shape
    sizes = (config.moments, config.length, config.spacing)
    blocks = spike_blocks(jnp.asarray(clip.spikes, jnp.uint8), clip.key, *sizes)
    numbers = jnp.arange(frames, dtype=jnp.float32).reshape(frames, 1, 1)
    middle = np.asarray(spike_blocks(numbers, clip.key, *sizes).mean(axis=(1, 2, 3)))
    if motion is None:
        motion = estimate_motion(clip.spikes, key=clip.key, white_rate=clip.white_rate, bad_pixels=clip.bad_pixels)
    moment, row, column = (v.reshape(-1).astype(np.int32) for v in np.indices((config.moments, height, width)))
    good = np.ones((height, width), bool) if clip.bad_pixels is None else ~clip.bad_pixels
    # Weighted as intervals are: a pixel that is seen all the time has Σω = 1.
    weight = good[row, column].astype(np.float32) / np.float32(config.moments)
    time = jnp.asarray(middle[moment])
    samples = Samples(jnp.asarray(row), jnp.asarray(column), time, time, jnp.zeros_like(time), jnp.asarray(weight))
    path = trajectory_of(motion, key=clip.key, start=0, stop=frames)
    shape = (scale * height, scale * width)
    placed = place(samples, path, scale=scale, shape=shape)
    term = accumulate(placed)
    members = members_of(jnp.abs(time - clip.key), config.boundaries)
    planes = [term.stencil.planes, *(accumulate(placed, robust=member).stencil.planes for member in members)]
    return SpikeInputs(
        blocks,
        jnp.asarray(clip.white_rate, jnp.float32),
        placed.taps.index[0],
        placed.taps.down[0],
        placed.taps.right[0],
        placed.weight,
        jnp.stack(members) if members else jnp.zeros((0, time.size)),
        jnp.stack(planes),
        initial_image(clip, shape),
        1 / lipschitz_bound(term),
        jnp.asarray(noise_of_mean(clip), jnp.float32),
    )


class UnrolledPASE(eqx.Module):
    """The spike encoder and the stages: `net(inputs)` gives the `Iterates`.

    **Arguments:**
    - `config`: the sizes.
    - `key`: of the random first weights.
    """

    encoder: PASE
    iteration: UnrolledISTA
    config: UnrolledPASEConfig = eqx.field(static=True)

    def __init__(self, config: UnrolledPASEConfig, *, key: PRNGKeyArray):
        encoder, iteration = jax.random.split(key)
        self.encoder = PASE(config.length, config.branches, config.encoder_channels, config.encoder_blocks, key=encoder)
        self.iteration = UnrolledISTA(config, key=iteration)
        self.config = config

    def encode(self, inputs: SpikeInputs) -> Float[Array, "n h w"]:
        """Y_1 … Y_n, intensity: the mean over the branches."""
        blocks = inputs.spikes.astype(jnp.float32) / inputs.white_rate
        latent = jax.vmap(self.encoder)(blocks.astype(self.encoder.first.weight.dtype))
        return jnp.mean(latent.astype(jnp.float32), axis=1)

    def __call__(self, inputs: SpikeInputs, start: Float[Array, "H W"] | None = None) -> Iterates:
        """R^(t) and X^(t) of all stages. **Arguments** and **Raises:** as of `UnrolledISTA`."""
        return self.iteration(inputs.measured_as(self.encode(inputs), self.config.scale), start)
