"""The networks that can be trained and loaded by their name.

A name stands for a function of the scale and a table of sizes (as a configuration or a checkpoint holds them) to a
`Trainable`. The module of a network is imported when its name is looked up.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from learned.training.data import Example, turned
from scsr_opt.errors import InputError


class Preparation(NamedTuple):
    """Inputs of a network made from an example, where that takes long and cannot be compiled.

    **Fields:**
    - `make(example)`: arrays by name, of the same shapes for all examples of a size; made once
      (`learned.training.prepared_cache`).
    - `made_of`: those of the network's sizes that they depend on.
    - `picture(model, prepared)`: the picture of the key frame; may be compiled.
    - `varied(prepared, rng)`: as good an example, of the same shapes, each time that one is drawn; None: as it is.
    """

    make: Callable[[Example], Mapping[str, Any]]
    made_of: Mapping[str, Any]
    picture: Callable[[Any, Mapping[str, Any]], Float[Array, "H W"]]
    varied: Callable[[Mapping[str, Any], np.random.Generator], Mapping[str, Any]] | None = None


class Trainable(NamedTuple):
    """A network as the trainer sees it.

    **Fields:**
    - `build(key)`: a new `equinox.Module` with random weights.
    - `loss(model, example)`: what is made small, a scalar, for one example (the trainer takes the mean over a batch).
      In mixed precision the model's weights come as bfloat16, the example as it is: a model computes in the type of its
      weights, and the loss is summed in float32.
      Where there is a `preparation`, the example is what that made of it.
    - `picture(model, spikes, white_rate)`: the picture (s·h, s·w) of the key frame T // 2, intensity 1 = white. It may
      be compiled unless there is a `preparation`.
    - `preparation`: None for networks that take the spikes themselves.
    """

    build: Callable[[PRNGKeyArray], Any]
    loss: Callable[[Any, Example], Float[Array, ""]]
    picture: Callable[[Any, UInt8[Array, "T h w"], Float[Array, ""]], Float[Array, "H W"]]
    preparation: Preparation | None = None


MODELS: dict[str, Callable[[int, Mapping[str, Any]], Trainable]] = {}


def trainable(model: str, scale: int, network: Mapping[str, Any]) -> Trainable:
    """The network of this name and these sizes.

    **Raises:** `InputError` if there is no such network, or it does not have such sizes.
    """
    if model not in MODELS:
        raise InputError(f"There is no network {model!r}: model must be one of {', '.join(sorted(MODELS))}.")
    return MODELS[model](scale, network)


def _spikesr(scale: int, network: Mapping[str, Any]) -> Trainable:
    from learned.networks.compensation import base_loss
    from learned.networks.spikesr import SpikeSRConfig, SpikeSRNet, spikesr_loss
    from learned.networks.velocity import velocity_loss

    sizes = dict(network)
    named = {"small": SpikeSRConfig.small, "full": SpikeSRConfig.full}
    size = sizes.pop("size", "small")
    if size not in named:
        raise InputError(f"network.size is {size!r}, but it must be small or full.")
    config = _replaced(named[size](scale), sizes, "size")

    def loss(model: Any, example: Example) -> Float[Array, ""]:
        seen = model.encode(example.spikes, example.spikes.shape[0] // 2, example.white_rate)
        found = spikesr_loss(model.iterate(seen).images, example.truth)
        if config.deblur_channels:  # as much as another picture before the last; those behind it teach it little
            found = found + 0.1 * base_loss(seen.base, example.truth)
        if not config.velocity_channels or not config.velocity_weight:
            return found
        return found + config.velocity_weight * velocity_loss(seen.velocity, example.velocity)

    def picture(model: Any, spikes: UInt8[Array, "T h w"], white_rate: Float[Array, ""]) -> Float[Array, "H W"]:
        return model(spikes, spikes.shape[0] // 2, white_rate).images[-1]

    return Trainable(lambda key: SpikeSRNet(config, key=key), loss, picture)


def _velocity(scale: int, network: Mapping[str, Any]) -> Trainable:
    from learned.networks.compensation import compensated
    from learned.networks.velocity import VelocityConfig, VelocityNet, base_moments, refined, velocity_loss

    config = _replaced(VelocityConfig(), network)

    def estimate(model: Any, spikes: Any, white_rate: Any) -> Float[Array, "2 h w"]:
        return model.velocity(spikes, spikes.shape[0] // 2, white_rate)

    def loss(model: Any, example: Example) -> Float[Array, ""]:
        return velocity_loss(estimate(model, example.spikes, example.white_rate), example.velocity)

    def picture(model: Any, spikes: UInt8[Array, "T h w"], white_rate: Float[Array, ""]) -> Float[Array, "H W"]:
        seen = base_moments(spikes, spikes.shape[0] // 2, white_rate, config.moments)
        return compensated(seen, refined(seen, estimate(model, spikes, white_rate)), scale).mean

    return Trainable(lambda key: VelocityNet(config.channels, key=key), loss, picture)


def _compensation(scale: int, network: Mapping[str, Any]) -> Trainable:
    from learned.networks.compensation import CompensationConfig, CompensationNet, base_loss

    config = _replaced(CompensationConfig(scale), network)

    def picture(model: Any, spikes: UInt8[Array, "T h w"], white_rate: Float[Array, ""]) -> Float[Array, "H W"]:
        return model(spikes, spikes.shape[0] // 2, white_rate)

    def loss(model: Any, example: Example) -> Float[Array, ""]:
        return base_loss(picture(model, example.spikes, example.white_rate), example.truth)

    return Trainable(lambda key: CompensationNet(config, key=key), loss, picture)


def _unrolled(scale: int, network: Mapping[str, Any]) -> Trainable:
    from learned.networks.inputs import Inputs, make_inputs
    from learned.networks.unrolled_ista import UnrolledConfig, UnrolledISTA

    config = _replaced(UnrolledConfig(scale, folding=2 if scale % 2 == 0 else 1), network)
    return _on_inputs(
        scale,
        lambda key: UnrolledISTA(config, key=key),
        lambda clip: make_inputs(clip, scale=scale, boundaries=config.boundaries),
        lambda arrays: Inputs.of_arrays(arrays, scale),
        {"boundaries": list(config.boundaries)},
    )


def _unrolled_pase(scale: int, network: Mapping[str, Any]) -> Trainable:
    from learned.networks.unrolled_ista_pase import SpikeInputs, UnrolledPASE, UnrolledPASEConfig, make_spike_inputs

    config = _replaced(UnrolledPASEConfig(scale, folding=2 if scale % 2 == 0 else 1), network)
    return _on_inputs(
        scale,
        lambda key: UnrolledPASE(config, key=key),
        lambda clip: make_spike_inputs(clip, scale=scale, config=config),
        SpikeInputs.of_arrays,
        {name: getattr(config, name) for name in ("moments", "length", "spacing")}
        | {"boundaries": list(config.boundaries)},
    )


def _on_inputs(
    scale: int,
    build: Callable[[PRNGKeyArray], Any],
    inputs_of: Callable[[Any], Any],
    of_arrays: Callable[[Any], Any],
    made_of: Mapping[str, Any],
) -> Trainable:
    """A network that takes inputs made by `inputs_of` from a `Clip`, and from their `arrays` again by `of_arrays`."""
    from learned.networks.spikesr import spikesr_loss
    from learned.networks.unrolled_ista import iterate
    from scsr_opt.pipeline.clip import Clip

    def inputs(spikes: Any, white_rate: Any) -> Any:
        return inputs_of(Clip(np.asarray(spikes), len(spikes) // 2, float(white_rate), None))

    def make(example: Example) -> Mapping[str, Any]:
        return inputs(example.spikes, example.white_rate).arrays() | {"truth": example.truth}

    def loss(model: Any, prepared: Any) -> Float[Array, ""]:
        images = model(of_arrays(prepared)).images
        # There the scene has left the sensor for a part of the recording, and no motion is known.
        border = scale * min(8, min(images.shape[1:]) // scale // 8)
        inner = slice(border, -border or None)
        return spikesr_loss(images[:, inner, inner], prepared["truth"].astype(images.dtype)[inner, inner])

    def prepared_picture(model: Any, prepared: Any) -> Float[Array, "H W"]:
        return model(of_arrays(prepared)).images[-1]

    def picture(model: Any, spikes: Any, white_rate: Any) -> Float[Array, "H W"]:
        return iterate(model, inputs(spikes, white_rate)).images[-1]

    return Trainable(build, loss, picture, Preparation(make, made_of, prepared_picture))


def _restoration(scale: int, network: Mapping[str, Any]) -> Trainable:
    from learned.networks.restoration import RestorationConfig, RestorationNet, restoration_loss, restored
    from scsr_opt.pipeline.assembly import assemble_task
    from scsr_opt.pipeline.options import Options
    from scsr_opt.pipeline.reconstruct import UPDATES
    from scsr_opt.pipeline.restoration import Solved
    from scsr_opt.pipeline.task import task_of
    from scsr_opt.pipeline.updates import solve_with_updates, solved_by
    from scsr_opt.priors.ridge_regulariser import RidgeRegulariser

    config = _replaced(RestorationConfig(scale), network)

    def solution(spikes: Any, white_rate: Any) -> Solved:
        options = Options(white_rate=float(white_rate), prior=RidgeRegulariser.load())
        assembly = assemble_task(task_of(np.asarray(spikes), scale, None, options))
        if not assembly.usable:
            nothing = jnp.zeros(assembly.image.shape, jnp.float32)
            return Solved(nothing, nothing, nothing, jnp.zeros((), jnp.float32))
        assembly, found, *_ = solve_with_updates(assembly, None, UPDATES)
        return solved_by(assembly, found)

    def of_arrays(prepared: Mapping[str, Any]) -> Solved:
        return Solved(*(jnp.asarray(prepared[name], jnp.float32) for name in Solved._fields))

    def make(example: Example) -> Mapping[str, Any]:
        found = solution(example.spikes, example.white_rate)
        return {name: np.asarray(value) for name, value in found._asdict().items()} | {"truth": example.truth}

    def loss(model: Any, prepared: Any) -> Float[Array, ""]:
        found = of_arrays(prepared)
        border = scale * min(8, min(found.image.shape) // scale // 8)  # there no motion is known
        return restoration_loss(model(found), prepared["truth"], border)

    def varied(prepared: Mapping[str, Any], rng: np.random.Generator) -> Mapping[str, Any]:
        turns, flipped = int(rng.integers(4)), bool(rng.integers(2))
        return {name: turned(value, turns, flipped) if np.ndim(value) else value for name, value in prepared.items()}

    def prepared_picture(model: Any, prepared: Any) -> Float[Array, "H W"]:
        return restored(model, of_arrays(prepared))

    def picture(model: Any, spikes: Any, white_rate: Any) -> Float[Array, "H W"]:
        return restored(model, jax.tree.map(jnp.asarray, solution(spikes, white_rate)))

    return Trainable(
        lambda key: RestorationNet(config, key=key), loss, picture, Preparation(make, {}, prepared_picture, varied)
    )


MODELS["spikesr"] = _spikesr
MODELS["velocity"] = _velocity
MODELS["compensation"] = _compensation
MODELS["restoration"] = _restoration
MODELS["unrolled"] = _unrolled
MODELS["unrolled_pase"] = _unrolled_pase


def _replaced(config: Any, sizes: Mapping[str, Any], *also: str) -> Any:
    """A configuration with some of its sizes replaced. **Raises:** `InputError` if it has no such size.

    **Arguments:** `also`: what is allowed beside them, for the message.
    """
    known = {field.name for field in dataclasses.fields(config)} - {"scale"}
    for name, value in sizes.items():
        if name not in known:
            raise InputError(f"network.{name} is not known: allowed are {', '.join([*also, *sorted(known)])}.")
        now = getattr(config, name)
        if isinstance(now, tuple) != isinstance(value, list | tuple) or (
            not isinstance(now, tuple) and type(now) is not type(value)
        ):
            raise InputError(f"network.{name} is {value!r}, but it must be of the kind of {now!r}.")
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in sizes.items()}
    return dataclasses.replace(config, **values)
