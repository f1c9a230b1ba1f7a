"""What the priors ask of their arguments, in one place and one wording; and a strength that may be divided by."""

import math

import jax.numpy as jnp
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float

from scsr_opt.errors import InputError


def finite(given: object) -> float:
    """`given` as a float; not a number where it is none, or is not finite."""
    try:
        found = math.nan if isinstance(given, str | bytes) else float(given)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return math.nan
    return found if math.isfinite(found) else math.nan


def whole(owner: str, given: float | int, what: str) -> int:
    """`given` as an int.

    **Errors:** `InputError` unless it is a whole number of at least 1.
    """
    found = finite(given)
    if not (found >= 1 and found == int(found)):
        raise InputError(f"{owner} was given {given!r} {what}; it needs a whole number of at least 1.")
    return int(given)


def positive(owner: str, name: str, given: float | int, most: float | int = math.inf) -> float:
    """`given` as a float.

    **Errors:** `InputError` unless it is above 0, finite and not above `most`.
    """
    found = finite(given)
    if not 0 < found <= most:
        limit = "" if most == math.inf else f" and at most {most:g}"
        raise InputError(f"{owner} was given {name} {given!r}; it needs a finite number above 0{limit}.")
    return found


def checked_tolerance(owner: str, given: float | int) -> None:
    """**Errors:** `InputError` unless `given` is a finite number of at least 0."""
    if not finite(given) >= 0:
        raise InputError(
            f"{owner} was given tolerance {given!r}; it is a relative measure of at least 0 (0: use all iterations)."
        )


def divisible(
    strength: Float[ArrayLike, "*pixels"], dtype: DTypeLike
) -> tuple[Bool[Array, "*pixels"], Float[Array, "*pixels"]]:
    """Whether the strength is so small (below 1e-19 in float32) that it counts as 0, and one to calculate with.

    That is 1 where it counts as 0: 1/strength or its derivative would be infinite, and not a number behind a `where`. A
    strength that is itself not a number is let through, to be noticed in the result.
    """
    given = jnp.asarray(strength, dtype)
    off = given < jnp.finfo(dtype).tiny ** 0.5
    return off, jnp.where(off, 1, given)
