"""Exceptions of the library: `InputError` for what cannot be used, `SolveError` for a solve that failed."""

from typing import Any


class InputError(ValueError):
    """A recording, a file or an argument cannot be used as it is.

    Its message is one sentence that says what was found, what is allowed and how to mend it. The command line prints
    it as it stands and ends with exit code 2; in Python it is an ordinary `ValueError`.
    """


class SolveError(RuntimeError):
    """A solve failed; raised only where `throw=True` asks for it. Its message is that of the `Status`."""


_SHOWN = 80
"""Characters of a value, at most, that an error shows."""


def shown(value: Any) -> str:
    """`value` for an error, on one line: an array by its shape, and the beginning of what is long."""
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple) and shape:
        return f"an array of shape {shape}"
    try:
        text = " ".join(repr(value).split())
    except Exception:  # whatever the `__repr__` of another library raises; Python's own for integers of 4,300 digits
        text = f"a value of type {type(value).__name__}"
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
