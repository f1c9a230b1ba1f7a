"""Checks of arguments, in one place and in one wording."""

import math
import operator
from collections.abc import Callable
from typing import Any, SupportsFloat

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from scsr_opt._arrays import as_array
from scsr_opt.errors import InputError, shown

# Pixels of the largest picture: a solve holds about 40 numbers for each, 16 GB in all.
_MOST_PIXELS = 10**8
# λ² and λΨ have to be numbers in float32, below 3e38; Ψ of the largest picture is below 1e12.
_MOST_STRENGTH = 1e18


def whole(value: Any, name: str, least: int, most: int | None = None) -> int:
    """`value` as an int from `least` to `most`, or an `InputError` that names it."""
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < least or (most is not None and number > most):
        limits = f"at least {least}" if most is None else f"from {least} to {most}"
        raise InputError(f"{name} is {shown(value)}; it must be a whole number, {limits}.")
    return number


def number(value: SupportsFloat, name: str, allowed: Callable[[float], bool], limits: str) -> float:
    """`value` as a finite float that is `allowed`, or an `InputError` that names it and its `limits`."""
    try:
        # NumPy's complex numbers would drop their imaginary part.
        found = math.nan if isinstance(value, np.complexfloating) else float(value)
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not (math.isfinite(found) and allowed(found)):
        raise InputError(f"{name} is {shown(value)}; it must be a finite number {limits}.")
    return found


def prior_strength(strength: SupportsFloat, name: str = "strength") -> float:
    """λ as a float. **Raises:** `InputError` if it is not a number from 0 to 1e18, the most that float32 works with."""
    return number(strength, name, lambda v: 0 <= v <= _MOST_STRENGTH, f"from 0 to {_MOST_STRENGTH:g}")


def flag(value: object, name: str) -> bool:
    """`value` as a bool. **Raises:** `InputError` for anything else, as "no" would be true."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} is {shown(value)}; it must be True or False.")
    return bool(value)


def check_type(value: object, kind: type, name: str, example: str) -> None:
    """**Raises:** `InputError` if `value` is neither None nor a `kind`, with an `example` of one."""
    if value is not None and not isinstance(value, kind):
        raise InputError(f"{name} is {shown(value)}; it must be a {kind.__name__}, such as {example}.")


def picture_shape(sensor: tuple[int, int], scale: int) -> tuple[int, int]:
    """(s·h, s·w) of a `sensor` (h, w). **Raises:** `InputError` if such a picture does not fit into memory."""
    height, width = sensor
    if scale**2 * height * width > _MOST_PIXELS:
        millions = shown(scale**2 * height * width // 10**6)
        raise InputError(
            f"At scale {shown(scale)} the picture would have {millions} million pixels; at most "
            f"{_MOST_PIXELS // 10**6} million fit in memory: take a smaller scale, or a crop."
        )
    return scale * height, scale * width


def rectangle(crop: Any, name: str = "crop") -> tuple[int, int, int, int]:
    """`crop` as (top, left, height, width). **Raises:** `InputError` if it is not four whole numbers."""
    try:
        if any(isinstance(number, bool) for number in crop):
            raise TypeError("a mask")
        top, left, height, width = map(operator.index, crop)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{name} is {shown(crop)}; it must be (top, left, height, width), four whole numbers of sensor pixels."
        ) from error
    return top, left, height, width


def pixel_gain(gain: ArrayLike, height: int, width: int) -> Float[np.ndarray, "h w"]:
    """`gain` as float32 (h, w). **Raises:** `InputError` if it has another shape or is not finite and above 0."""
    array = np.asarray(gain) if isinstance(gain, str) else as_array(gain, "gain")  # a word that is none of the two
    kind = "a complex array" if np.iscomplexobj(array) else "an array"
    try:
        found = None if np.iscomplexobj(array) else array.astype(np.float32)  # a copy
    except (TypeError, ValueError, OverflowError):
        kind, found = f"an array of type {array.dtype}", None
    if found is None or found.shape != (height, width):
        given = shown(gain) if array.ndim == 0 else f"{kind} of shape {array.shape}"
        raise InputError(
            f"gain is {given}; it must be 'auto', 'blind' or one gain for each pixel, ({height}, {width})."
        )
    wrong = int(np.count_nonzero(~(np.isfinite(found) & (found > 0))))
    if wrong:
        raise InputError(
            f"gain holds {wrong} values that are not finite and above 0; mark such pixels as bad_pixels and give them "
            f"gain 1."
        )
    return found


def pixel_dark(dark: ArrayLike, height: int, width: int) -> Float[np.ndarray, "h w"]:
    """`dark` as float32 (h, w). **Raises:** `InputError` if it has another shape or is not from 0 to below 1."""
    array = as_array(dark, "dark")
    if array.shape != (height, width) or array.dtype.kind not in "fiu":
        raise InputError(
            f"dark is an array of {array.dtype} of shape {array.shape}; it must be the spikes per frame that each "
            f"pixel fires in darkness, ({height}, {width})."
        )
    if not np.all((array >= 0) & (array < 1)):
        raise InputError("dark holds values that are not from 0 to below 1 spikes per frame; mark such pixels as bad.")
    return array.astype(np.float32)


def finite(given: object) -> float:
    """`given` as a float; not a number where it is none, or is not finite."""
    try:
        found = math.nan if isinstance(given, str | bytes) else float(given)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return math.nan
    return found if math.isfinite(found) else math.nan


def iteration_count(owner: str, given: float | int, what: str) -> int:
    """`given` as an int.

    **Errors:** `InputError` unless it is a whole number of at least 1.
    """
    found = finite(given)
    if not (found >= 1 and found == int(found)):
        raise InputError(f"{owner} was given {shown(given)} {what}; it needs a whole number of at least 1.")
    return int(given)


def positive(owner: str, name: str, given: float | int, most: float | int = math.inf) -> float:
    """`given` as a float.

    **Errors:** `InputError` unless it is above 0, finite and not above `most`.
    """
    found = finite(given)
    if not 0 < found <= most:
        limit = "" if most == math.inf else f" and at most {most:g}"
        raise InputError(f"{owner} was given {name} {shown(given)}; it needs a finite number above 0{limit}.")
    return found


def checked_tolerance(owner: str, given: float | int) -> None:
    """**Errors:** `InputError` unless `given` is a finite number of at least 0."""
    if not finite(given) >= 0:
        raise InputError(
            f"{owner} was given tolerance {shown(given)}; it is a relative measure of at least 0 (0: use all "
            f"iterations)."
        )
