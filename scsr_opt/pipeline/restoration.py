"""`Solved` and `Restoration`: input and interface of a network that restores a solution of Eq. 4 (`quality="best"`).

The network's picture X̂ is not the result: Eq. 4 is solved once more with the prior centred there (`Centred`), a
convex problem whatever X̂ is (`scsr_opt.pipeline.updates.CentreUpdate`). Networks come from other packages, by the
entry points of the group "scsr.restorations", so that this package needs none of them.
"""

from importlib.metadata import entry_points
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scsr_opt._kernels.device import on_device
from scsr_opt.errors import InputError
from scsr_opt.operators.data_term import DataTerm

GROUP = "scsr.restorations"
"""Group of entry points: each loads a function of the scale that returns a `Restoration`, or raises `InputError`."""

# Pixels with less weight than this share of the largest are hardly seen: what the data ask of them is noise.
_LEAST_WEIGHT = 1e-3


class Solved(NamedTuple):
    """A solution of Eq. 4, with the gradient and the weight of its data term.

    **Fields:**
    - `image`: X, (H, W), intensity.
    - `change`: −∇f(X) / (BᵀMB 1), (H, W), intensity: the step that the data term alone would make. It contains details
      that the prior removed as if they were noise, and noise.
    - `weight`: s² BᵀMB 1, (H, W): weight of the samples of each pixel, 1 for a pixel that was seen all the time.
    - `strength`: λ, ().
    """

    image: Float[Array, "H W"]
    change: Float[Array, "H W"]
    weight: Float[Array, "H W"]
    strength: Float[Array | np.ndarray, ""]


@runtime_checkable
class Restoration(Protocol):
    """A picture X̂ from a solution.

    **Fields:** `strength_ratio`: λ of the solve about X̂ over that of the solution.
    """

    strength_ratio: float

    def __call__(self, solved: Solved) -> Float[Array, "H W"]:
        """X̂, (H, W), intensity."""
        ...


def restoration_of(scale: int) -> Restoration:
    """The restoration of `quality="best"` for a scale.

    **Raises:** `InputError` if none is installed, or it does not know this scale.
    """
    for entry in entry_points(group=GROUP, name="best"):
        return entry.load()(scale)
    raise InputError(
        "quality is 'best', but no package that restores pictures is installed; install scsr-opt again, or take 'fast'."
    )


def solved(term: DataTerm, image: Float[np.ndarray, "H W"], strength: Float[Array, ""]) -> Solved:
    """The input of a restoration, for the solution `image` (intensity) of f = `term` with the strength λ."""
    picture = on_device(image)
    return Solved(picture, *_change_and_weight(term, picture), strength)


@eqx.filter_jit
def _change_and_weight(term: DataTerm, image: Float[Array, "H W"]) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    weight = term.normal(jnp.ones_like(image))
    least = _LEAST_WEIGHT * jnp.max(weight) + jnp.finfo(image.dtype).tiny
    # M is scaled so that a sensor pixel at rest has a weight of 1 in all, 1/s² in each of its pixels (`Problem`).
    return -term.gradient(image) / jnp.maximum(weight, least), term.aperture.scale**2 * weight
