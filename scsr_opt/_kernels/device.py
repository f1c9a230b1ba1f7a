"""Check of the device that JAX runs on, made before the work begins."""

import functools

import jax
import numpy as np
from jaxtyping import Array

from scsr_opt.errors import InputError


@functools.cache
def check_device() -> None:
    """**Raises:** `InputError` if JAX finds no device of the kind that it has to use, such as `JAX_PLATFORMS=cuda`
    where there is no GPU, or JAX was installed without support for it."""
    try:
        jax.devices()
    except Exception as error:  # a RuntimeError that tells why, or where the kind is known only by name, an assertion
        kind = jax.config.jax_platforms  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError(
            f"JAX finds no device of the kind that JAX_PLATFORMS={kind} asks for: unset JAX_PLATFORMS or set it to "
            f"cpu, or install the JAX that supports the device (for NVIDIA's GPUs: pip install 'jax[cuda12]')."
        ) from error


def on_device(array: np.ndarray | np.generic) -> Array:
    """A copy of a NumPy array as one of JAX's. `jnp.asarray` would compile a program for each shape."""
    return jax.device_put(array, may_alias=False)
