"""Arrays of users, read in one place: a mask is never ignored, and an array that cannot be read is named."""

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from scsr_opt.errors import InputError, shown

if TYPE_CHECKING:
    import jax


def as_array(value: Any, name: str) -> np.ndarray:
    """`value` as a NumPy array, which may share its memory.

    **Arguments:** `value`: anything that NumPy makes an array of; `name`: of it in errors.

    **Raises:** `InputError` if it is a masked array (or a list of some), whose mask would be ignored, a list whose
    parts differ in length, a path, or something that NumPy cannot read, such as a tensor on another device.
    """
    if isinstance(value, str | bytes | os.PathLike):
        raise InputError(
            f"{name} is {shown(value)}, but it must be an array: read a file first, a recording by "
            f"scsr_opt.camera.read_recording, a picture by scsr_opt.report.read_picture, an .npy file by numpy.load."
        )
    if _masked(value):
        raise InputError(
            f"{name} is a masked array, whose mask would be ignored; give array.filled(value), and mark pixels that "
            f"must not be used by bad_pixels."
        )
    try:
        return np.asarray(value)
    except Exception as error:  # whatever the `__array__` of another library raises
        if isinstance(value, list | tuple) and isinstance(error, ValueError):
            raise InputError(
                f"{name} is a list whose parts differ in length; every row must be as long as the others."
            ) from None
        why = " ".join(str(error).split()).split(". ")[0].rstrip(".")
        raise InputError(
            f"{name} is a {type(value).__name__} that NumPy cannot read ({type(error).__name__}: {why}); give a "
            f"NumPy array, for example tensor.detach().cpu().numpy()."
        ) from error


def _masked(value: Any) -> bool:
    """Test of a masked array, or one in a list at any depth."""
    if not isinstance(value, list | tuple):
        return isinstance(value, np.ma.MaskedArray)
    # By types, of which a list has few: numbers one by one take longer than to make an array of them.
    kinds = set(map(type, value))
    if any(issubclass(kind, np.ma.MaskedArray) for kind in kinds):
        return True
    return any(issubclass(kind, list | tuple) for kind in kinds) and any(map(_masked, value))


def own(value: Any, name: str) -> np.ndarray:
    """A copy of `value` as a NumPy array that nobody else writes to. **Raises:** as `as_array`."""
    return np.array(as_array(value, name))


def held(value: Any, name: str) -> "jax.Array":
    """A copy of `value` as JAX's array, for an operator or a prior to keep. **Raises:** as `as_array`."""
    import jax
    import jax.numpy as jnp  # here, so that reading a recording does not wait for JAX

    return jnp.array(value if isinstance(value, jax.Array) else as_array(value, name))
