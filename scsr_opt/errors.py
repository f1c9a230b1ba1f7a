"""Exceptions of the library: `InputError` for what cannot be used, `SolveError` for a solve that failed."""


class InputError(ValueError):
    """A recording, a file or an argument cannot be used as it is.

    Its message is one sentence that says what was found, what is allowed and how to mend it. The command line prints
    it as it stands and ends with exit code 2; in Python it is an ordinary `ValueError`.
    """


class SolveError(RuntimeError):
    """A solve failed; raised only where `throw=True` asks for it. Its message is that of the `Status`."""
