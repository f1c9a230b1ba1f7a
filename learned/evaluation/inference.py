"""Running a network on the clip of a task: the one place that knows the arguments of each kind."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped, UInt8
from scipy.ndimage import distance_transform_edt

from learned.networks.inputs import Inputs, make_inputs
from learned.networks.layers import continued
from learned.networks.spikesr import SpikeSRNet
from learned.networks.unrolled_ista import UnrolledISTA
from learned.networks.unrolled_ista_pase import SpikeInputs, UnrolledPASE, make_spike_inputs
from learned.training.checkpoint import Card
from scsr_opt._kernels.programs import ready
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.task import Task


class Run(NamedTuple):
    """The pictures of a network's stages, intensity (1 = white).

    **Fields:** `start`: X^(0). `gradient_steps`: R^(1) … R^(T). `images`: X^(1) … X^(T), the last one the result.
    """

    start: Float[Array, "H W"]
    gradient_steps: Float[Array, "stages H W"]
    images: Float[Array, "stages H W"]


class Call(NamedTuple):
    """A network ready to be called: `function(*arguments)` gives the `Run` and can be compiled."""

    function: Any
    arguments: tuple[Any, ...]


def call(
    net: Any, card: Card, task: Task, start: Float[Array, "H W"] | None = None, motion: Motion | None = None
) -> Call:
    """`net` with its arguments for the clip of a task.

    **Arguments:** `start`: X^(0), the network's own if not given; `motion`: for the networks that use one, estimated if
    not given.

    **Raises:** `InputError` if the network's stages are not known, or the recording is too short for it.
    """
    check_stages(net, card)
    if isinstance(net, SpikeSRNet):
        rate = jnp.asarray(task.clip.white_rate, jnp.float32)
        spikes = jnp.asarray(plausible_spikes(task.clip))
        return Call(_spikesr, (net, spikes, jnp.asarray(task.clip.key), rate, start))
    if isinstance(net, UnrolledISTA):
        inputs = make_inputs(task.clip, scale=task.scale, boundaries=net.config.boundaries, motion=motion)
        return Call(_unrolled, (net, inputs, start))
    # The encoder looks at neighbours: a bad pixel's spikes must be plausible, though none are measured there.
    clip = task.clip._replace(spikes=plausible_spikes(task.clip))
    return Call(_unrolled, (net, make_spike_inputs(clip, scale=task.scale, config=net.config, motion=motion), start))


def plausible_spikes(clip: Clip) -> Shaped[np.ndarray, "T h w"]:
    """The spikes of a clip as a network sees them: a bad pixel fires as the nearest good one does."""
    spikes, bad = clip.spikes, clip.bad_pixels
    if bad is None or not bad.any() or bad.all():
        return spikes
    row, column = np.asarray(distance_transform_edt(bad, return_distances=False, return_indices=True))
    return spikes[:, row, column]


def run(made: Call) -> Run:
    """The pictures of a network."""
    ready()
    return _compiled()(made.function, made.arguments)


@functools.cache
def _compiled() -> Callable[[Any, tuple[Any, ...]], Run]:
    compiled: Any = eqx.filter_jit  # its types do not have the options of `jax.jit`, which it passes on
    return compiled(lambda function, arguments: function(*arguments), compiler_options=sparing())


@functools.cache
def sparing() -> dict[str, bool | str]:
    """Options for the compilation of a network, such that a CPU does not keep more in memory than it needs.

    In XLA's usual order moments and stages wait for each other with all that they have: 24 GB for the full SpikeSR-Net
    and a sensor of 250×400, in the place of 4.6. Versions that do not know the option do without.
    """
    options: dict[str, bool | str] = {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda: jnp.zeros(())).lower().compile(compiler_options=options)
    except jax.errors.JaxRuntimeError:
        return {}
    return options


def check_stages(net: Any, card: Card) -> None:
    """**Raises:** `InputError` for a network that can be trained, but is only a part of one that has stages."""
    if not isinstance(net, SpikeSRNet | UnrolledISTA | UnrolledPASE):
        raise InputError(f"The stages of {card.model} are not known; take a SpikeSR-Net or an unrolled iteration.")


@eqx.filter_jit
def _spikesr(
    net: SpikeSRNet,
    spikes: UInt8[Array, "T h w"],
    key_frame: Int[Array, ""],
    white_rate: Float[Array, ""],
    start: Float[Array, "H W"] | None,
) -> Run:
    (wide, within), scale = continued(spikes), net.config.scale
    if start is None:
        # What is calculated here and again in the call is the same to the compiler, which does it once.
        start = net.initial(net.encode(wide, key_frame, white_rate))
    else:
        start, _ = continued(start, scale)
    rows, columns = (slice(scale * side.start, scale * side.stop) for side in within)
    found = Run(start, *net(wide, key_frame, white_rate, start))
    return jax.tree.map(lambda pictures: pictures[..., rows, columns], found)


@eqx.filter_jit
def _unrolled(net: UnrolledISTA | UnrolledPASE, inputs: Inputs | SpikeInputs, start: Float[Array, "H W"] | None) -> Run:
    start = inputs.image if start is None else start
    return Run(start, *net(cast(Any, inputs), start))
