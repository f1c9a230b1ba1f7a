"""Check of the device that JAX runs on, made before the work begins."""

import functools
import os

import jax
import numpy as np
from jaxtyping import Array

from scsr_opt.errors import InputError

# Variables of the environment that choose a device; all but the second are settings of JAX, too.
_DEVICE_SETTINGS = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME", "JAX_DEFAULT_DEVICE")


@functools.cache
def check_device() -> None:
    """**Raises:** `InputError` if JAX finds no device of the kind that it has to use, such as `JAX_PLATFORMS=cuda`
    where there is no GPU, or JAX was installed without support for it."""
    try:
        jax.devices()
        jax.device_put(np.zeros(()))  # to the default device
    except Exception as error:  # a RuntimeError that tells why, or where the kind is known only by name, an assertion
        settings = {name: getattr(jax.config, name.lower(), None) or os.environ.get(name) for name in _DEVICE_SETTINGS}
        settings = {name: kind for name, kind in settings.items() if kind}
        asked = " and ".join(f"{name}={kind}" for name, kind in settings.items())
        raise InputError(
            f"JAX finds no device of the kind that {asked} asks for: unset {' and '.join(settings)} or set it to "
            f"cpu, or install the JAX that supports the device (for NVIDIA's GPUs: pip install 'jax[cuda12]')."
        ) from error


def on_device(array: np.ndarray | np.generic) -> Array:
    """A copy of a NumPy array as one of JAX's. `jnp.asarray` would compile a program for each shape."""
    return jax.device_put(array, may_alias=False)
