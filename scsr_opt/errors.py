"""The one exception that means: what was handed in cannot be used."""


class InputError(ValueError):
    """A recording, a file or an argument cannot be used as it is.

    Its message is one sentence that says what was found, what is allowed and how to mend it. The command line prints
    it as it stands and ends with exit code 2; in Python it is an ordinary `ValueError`.
    """
