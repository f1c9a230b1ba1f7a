"""An error of any kind as the one sentence that `scsr` prints; signals, which are no errors."""

import os
import re
import traceback

from cyclopts import CycloptsError, MissingArgumentError, UnknownCommandError, UnusedCliTokensError

from scsr_opt.errors import InputError

# Where the parser begins another sentence.
_NEXT = re.compile(r"[.?]\s+(Did you mean|Choose from|Only got|Got|Use|This option)\b")


class Terminated(BaseException):
    """SIGTERM arrived; raised wherever the program is, so that files half written are removed."""


def signal_behind(error: BaseException) -> BaseException | None:
    """The exception of a signal that Python or a library turned into another error, as during an import; None
    if there was no signal."""
    behind: BaseException | None = error
    while behind is not None and not isinstance(behind, KeyboardInterrupt | Terminated):
        behind = behind.__cause__ or behind.__context__
    return behind


def sentence(error: Exception) -> str:
    """The error as a sentence for standard error."""
    if isinstance(error, CycloptsError):
        return _of_parser(error)
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, MemoryError):
        return "there is not enough memory for this; take fewer --frames, a --crop of the sensor or a smaller --scale."
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}." if error.filename else f"{error.strerror}."
    if (refused := _refused_by_jax(error)) is not None:
        return refused
    return f"{type(error).__name__}: {error} (a fault of the program; SCSR_TRACEBACK=1 shows where)"


def _refused_by_jax(error: Exception) -> str | None:
    """Sentence on a variable of the environment that JAX refuses when it is imported; None for any other error."""
    importing = any(
        frame.name == "<module>" and frame.filename.endswith(("jax/__init__.py", "jax\\__init__.py"))
        for frame in traceback.extract_tb(error.__traceback__)
    )
    variables = [f"{name}={value}" for name, value in os.environ.items() if name.startswith("JAX_")]
    if not importing or not isinstance(error, ValueError) or not variables:
        return None
    said = str(error).lower().replace(".", "_")
    named = [each for each in variables if each.split("=")[0].lower() in said]
    return f"JAX refuses the environment's {' or '.join(named or variables)}: correct or unset it."


def _of_parser(error: CycloptsError) -> str:
    command = " ".join(("scsr", *(error.command_chain or ())))
    if isinstance(error, MissingArgumentError) and error.argument is not None and not error.argument.tokens:
        name = " or ".join(error.argument.names)
        if error.keyword is None:
            # The parser's own sentence sounds as if the option were there and its value were not.
            return f"{command} needs {name}, which is missing: {_clause(error)}."
        wanted, _ = error.argument.token_count()
        if wanted > 1:
            found = len(error.tokens_so_far) % wanted
            return f"{error.keyword} needs {wanted} values, but got {found}: {_clause(error)}."
    if isinstance(error, UnknownCommandError) and error.unused_tokens and error.app is not None:
        known = [name for name in error.app if not name.startswith("-")]
        return f'Unknown command "{error.unused_tokens[0]}": choose from {", ".join(known)}.'
    if isinstance(error, UnusedCliTokensError) and error.unused_tokens:
        more = ", ".join(error.unused_tokens)
        return f"{command} has no use for {more}: leave it out, or see {command} --help for what it takes."
    return _NEXT.sub(lambda found: f"; {found[1].lower()}", str(error))


def _clause(error: MissingArgumentError) -> str:
    """The first clause of an option's help."""
    help = (error.argument.parameter.help if error.argument is not None else None) or "see --help"
    return help.split(". ")[0].rstrip(".")
