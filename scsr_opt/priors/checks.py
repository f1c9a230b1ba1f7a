"""Whether the proximal step of a prior belongs to its value: a check for priors of one's own."""

from typing import Any, SupportsFloat

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scsr_opt.errors import InputError
from scsr_opt.priors.prior import Prior

# Rows and columns of the picture that is tried: few, and of different number, as a step may exchange them.
_SHAPE = (16, 12)
# How far pictures beside the one of the proximal step are from it, in lengths of a direction.
_DISTANCES = (-1, -0.1, -0.01, 0.01, 0.1, 1)


def check_prox(prior: Prior[Any], strength: SupportsFloat, *, tolerance: SupportsFloat = 1e-5) -> None:
    """Finds out whether `prior.prox` gives the minimum of strength · Ψ(X) + ½‖X − v‖² (paper, Eq. 5, second line), v a
    random picture.

    The picture of the proximal step is compared with pictures beside it, of which none may have a smaller value. They
    lie towards v and towards a random picture. `reconstruct` does not check this: with a step that does not belong to
    the value it converges to another picture.

    **Arguments:** `strength`: above 0; `tolerance`: share by which the value may be larger, for steps that are
    iterations and so end near the minimum.

    **Raises:** `InputError` if a picture beside it has a smaller value, if a value is not finite, or as `Prior.check`.
    """
    prior.check(_SHAPE)
    random = np.random.default_rng(0)
    v = jnp.asarray(random.random(_SHAPE), jnp.float32)
    weight, most, name = float(strength), 1 + float(tolerance), type(prior).__name__
    found, _ = prior.prox(v, jnp.float32(weight), prior.initial_state(v))

    def objective(image: Float[Array, "H W"]) -> float:
        return float(weight * prior.value(image) + jnp.sum((image - v) ** 2) / 2)

    least = objective(found)
    if not np.isfinite(least):
        what = "value" if bool(jnp.isfinite(found).all()) else "prox"
        raise InputError(f"{name}.{what} gives a number that is not finite, for intensities from 0 to 1.")
    for direction in (v - found, jnp.asarray(random.standard_normal(_SHAPE), jnp.float32)):
        for distance in _DISTANCES:
            beside = objective(found + distance * direction)
            if least > beside * most:
                raise InputError(
                    f"{name}.prox does not give the minimum of strength · value(X) + ½‖X − v‖²: its picture has "
                    f"{least:.6g}, a picture beside it {beside:.6g}, so that prox or value is wrong, for example by a "
                    f"factor ½."
                )
