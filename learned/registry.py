"""The networks that can be trained and loaded by their name.

A name stands for a function of the scale and a table of sizes (as a configuration or a checkpoint holds them) to a
`Trainable`. The module of a network is imported when its name is asked for.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from learned.data import Example
from scsr_opt.errors import InputError


class Trainable(NamedTuple):
    """A network as the trainer sees it: three functions.

    **Fields:**
    - `build(key)`: a new `equinox.Module` with random weights.
    - `loss(model, example)`: what is made small, a scalar, for one example (the trainer takes the mean over a batch).
      In mixed precision the model's weights come as bfloat16, the example as it is: a model computes in the type of its
      weights, and the loss is summed in float32.
    - `picture(model, spikes, white_rate)`: the picture (s·h, s·w) of the key frame T // 2, intensity 1 = white.
    """

    build: Callable[[PRNGKeyArray], Any]
    loss: Callable[[Any, Example], Float[Array, ""]]
    picture: Callable[[Any, UInt8[Array, "T h w"], Float[Array, ""]], Float[Array, "H W"]]


MODELS: dict[str, Callable[[int, Mapping[str, Any]], Trainable]] = {}


def trainable(model: str, scale: int, network: Mapping[str, Any]) -> Trainable:
    """The network of this name and these sizes.

    **Raises:** `InputError` if there is no such network, or it does not have such sizes.
    """
    if model not in MODELS:
        raise InputError(f"There is no network {model!r}: model must be one of {', '.join(sorted(MODELS))}.")
    return MODELS[model](scale, network)


def _spikesr(scale: int, network: Mapping[str, Any]) -> Trainable:
    from learned.spikesr import SpikeSRConfig, SpikeSRNet, spikesr_loss

    sizes = dict(network)
    named = {"small": SpikeSRConfig.small, "full": SpikeSRConfig.full}
    size = sizes.pop("size", "small")
    if size not in named:
        raise InputError(f"network.size is {size!r}, but it must be small or full.")
    config = _replaced(named[size](scale), sizes)

    def loss(model: Any, example: Example) -> Float[Array, ""]:
        key_frame = example.spikes.shape[0] // 2
        return spikesr_loss(model(example.spikes, key_frame, example.white_rate).images, example.truth)

    def picture(model: Any, spikes: UInt8[Array, "T h w"], white_rate: Float[Array, ""]) -> Float[Array, "H W"]:
        return model(spikes, spikes.shape[0] // 2, white_rate).images[-1]

    return Trainable(lambda key: SpikeSRNet(config, key=key), loss, picture)


MODELS["spikesr"] = _spikesr


def _replaced(config: Any, sizes: Mapping[str, Any]) -> Any:
    """A configuration with some of its sizes replaced. **Raises:** `InputError` if it has no such size."""
    known = {field.name for field in dataclasses.fields(config)} - {"scale"}
    for name, value in sizes.items():
        if name not in known:
            raise InputError(f"network.{name} is not known: allowed are size, {', '.join(sorted(known))}.")
        now = getattr(config, name)
        if isinstance(now, tuple) != isinstance(value, list | tuple) or (
            not isinstance(now, tuple) and type(now) is not type(value)
        ):
            raise InputError(f"network.{name} is {value!r}, but it must be of the kind of {now!r}.")
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in sizes.items()}
    return dataclasses.replace(config, **values)
