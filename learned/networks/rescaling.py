"""A trained SpikeSR-Net as the start of one for another scale.

Features live at the picture's resolution, so most layers have the same shape at every scale and are taken as they are.
What depends on the scale, D_s, D_s⁻¹ and the pixel shuffle of X^(0), is resampled (`rescaled`).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from learned.networks.spikesr import SpikeSRNet
from scsr_opt.errors import InputError


def rescaled(given: SpikeSRNet, like: SpikeSRNet) -> SpikeSRNet:
    """`like` with the weights of `given`, a network of the same sizes for another scale.

    Kernels of D_s and D_s⁻¹ are read, as functions of the place in sensor pixels, at the places of the new ones (linear
    between them), and multiplied such that their answer to a constant keeps its mean. A channel of the pixel shuffle is
    that of the pixel which lay at its place.

    **Raises:** `InputError` if the networks differ in more than their scale.
    """
    weights = {jax.tree_util.keystr(place): leaf for place, leaf in jax.tree_util.tree_leaves_with_path(given)}
    (old, worked), (new, works) = ((net.config.scale, net.config.working_scale) for net in (given, like))

    def of(place: Any, leaf: Array) -> Array:
        name = jax.tree_util.keystr(place)
        found = weights.get(name)
        if found is not None and found.shape != leaf.shape:
            if name.startswith(".initialisation.output."):
                found = _shuffled(found, old, new)
            elif name.endswith(".down.weight"):
                found = _resampled(found, worked, works)
            elif name.endswith((".up.weight", ".residual_up.weight")):
                found = _resampled(found, worked, works) * (works / worked) ** 2
        if found is None or found.shape != leaf.shape:
            raise InputError(
                f"A network for ×{old} has {'no weights' if found is None else f'weights of shape {found.shape}'} at "
                f"{name}, where one for ×{new} has {leaf.shape}: both must be of the same sizes."
            )
        return found

    return jax.tree_util.tree_map_with_path(of, like)


def _resampled(kernel: Float[Array, "*c k k"], old: int, new: int) -> Float[Array, "*c m m"]:
    """A kernel of s + 2 pixels with the stride s, for another s; the sum of one that is constant stays."""
    there, here = ((np.arange(s + 2) - (s + 1) / 2) / s for s in (old, new))
    # Each row: the weights with which one new tap reads the old ones.
    read = np.stack([np.interp(here, there, unit) for unit in np.eye(old + 2)], axis=1)
    read *= (old + 2) / read.sum()
    return jnp.einsum("...ij,mi,nj->...mn", kernel, *(jnp.asarray(read, kernel.dtype),) * 2)


def _shuffled(layer: Array, old: int, new: int) -> Array:
    """Weights or biases of a layer before the pixel shuffle, an output for each of s×s pixels."""
    place = np.arange(new) * old // new
    return layer[(place[:, None] * old + place[None, :]).reshape(-1)]
