"""`Settings`, the base of frozen dataclasses whose fields are numbers that a computation hinges on."""

import math
import operator
from dataclasses import dataclass, fields
from typing import ClassVar

from scsr_opt.errors import InputError, shown


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Numbers that a stage hinges on, each a field with a sentence on its unit and what it decides.

    **Class variable:** `above_zero`: names of the fields that something is divided by, or that count what has to be
    there.

    **Raises:** `InputError` for a field that is not what its default is: a whole number, a finite number that is not
    negative, a tuple of such numbers, or settings; and for a 0 in a field that must be above.
    """

    above_zero: ClassVar[frozenset[str]] = frozenset()

    def __post_init__(self):
        for one in fields(self):
            value, name = getattr(self, one.name), f"{type(self).__name__}.{one.name}"
            example = one.default_factory() if callable(one.default_factory) else one.default
            if isinstance(example, Settings):
                if not isinstance(value, type(example)):
                    raise InputError(f"{name} is {shown(value)}; it must be a {type(example).__name__}.")
            elif isinstance(example, tuple):
                if not isinstance(value, tuple) or len(value) != len(example):
                    raise InputError(f"{name} is {shown(value)}; it must be a tuple of {len(example)} numbers.")
                object.__setattr__(
                    self, one.name, tuple(_number(part, like, name) for part, like in zip(value, example, strict=True))
                )
            else:
                object.__setattr__(self, one.name, _number(value, example, name))
            checked = getattr(self, one.name)
            if one.name in self.above_zero and 0 in (checked if isinstance(checked, tuple) else (checked,)):
                raise InputError(f"{name} is {shown(value)}; it must be above 0, such as {example!r}.")


def _number(value: object, example: object, name: str) -> float | int:
    """`value` as the int or float that `example` is."""
    whole = isinstance(example, int)
    try:
        found = math.nan if isinstance(value, bool | str | bytes) else operator.index(value) if whole else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not (math.isfinite(found) and found >= 0):
        kind = "whole" if whole else "finite"
        raise InputError(
            f"{name} is {shown(value)}; it must be a {kind} number that is not negative, such as {example!r}."
        )
    return found
