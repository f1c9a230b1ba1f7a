"""Entry point of `scsr`: commands, exit codes, and errors in one line.

Exit codes: 0 done; 1 a solve failed and its picture was not written; 2 the request cannot be carried out
(wrong arguments, unreadable file, no place to write); 130 interrupted; 143 terminated.
"""

import functools
import gc
import io
import operator
import os
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import entry_points
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

from cyclopts import App, Parameter, Token, convert

from scsr_opt._kernels.memory import use_few_arenas
from scsr_opt.cli.baseline import baseline
from scsr_opt.cli.batch import batch
from scsr_opt.cli.cache import cache, warm
from scsr_opt.cli.calibrate import calibrate
from scsr_opt.cli.demo import demo
from scsr_opt.cli.info import info
from scsr_opt.cli.options import say_error
from scsr_opt.cli.play import play
from scsr_opt.cli.sequence import export, sequence
from scsr_opt.cli.simulate import simulate
from scsr_opt.cli.solve import solve
from scsr_opt.cli.wording import Terminated, sentence, signal_behind


def _version() -> str:
    from importlib.metadata import version

    return version("scsr-opt")


def _converted(kind: Any, tokens: Sequence[Token]) -> Any:
    """The value as the parser has it, which otherwise takes the words none and null for an option that is not given:
    `--prior none` would be the default prior."""
    others = (
        [one for one in get_args(kind) if one is not NoneType] if get_origin(kind) in (Union, UnionType) else [kind]
    )
    return convert(functools.reduce(operator.or_, others), tokens)


# Of commands that take several files, which Cyclopts calls ARGS.
_USAGES = {
    "batch": "batch --output PATH [OPTIONS] FILE...",
    "calibrate": "calibrate --output PATH [OPTIONS] [SCENES...]",
}


@functools.cache
def _app() -> App:
    """The application with the commands of this package and those that others add (entry points `scsr.commands`)."""
    app = App(
        name="scsr",
        help="Super-resolved pictures from the recordings of a spike camera.\n\n"
        "A recording holds binary frames: a pixel fires when it has gathered a fixed amount of light since its last "
        "spike. Intensity is linear, 1 = white; frames are counted from 0; velocities are in sensor pixels per frame.",
        help_epilogue="Exit codes: 0 done, 1 a solve failed (its picture is not written), 2 the request cannot be "
        "carried out.",
        help_format="plaintext",
        version=_version,
        default_parameter=Parameter(converter=_converted),
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    added = sorted(entry_points(group="scsr.commands"), key=lambda entry: entry.name)
    for command in (
        info,
        calibrate,
        simulate,
        play,
        solve,
        batch,
        sequence,
        export,
        baseline,
        demo,
        warm,
        cache,
        *(entry.load() for entry in added),
    ):
        # Paragraphs are filled to the terminal's width; the line breaks are those of the source.
        paragraphs = [" ".join(part.split()) for part in (command.__doc__ or "").split("\n\n")]
        usage = _USAGES.get(command.__name__)
        app.command(
            command, help="\n\n".join(paragraphs), **({} if usage is None else {"usage": f"Usage: scsr {usage}"})
        )
    return app


def _terminate(*_: object) -> None:
    raise Terminated


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `scsr` with `arguments` (those of the process if None) and returns its exit code.

    What is wrong with the request is said in one line on standard error. With SCSR_TRACEBACK=1 in the environment every
    error keeps its traceback, for finding faults in the program itself.
    """
    if arguments is None:  # a process of its own
        # Tracing programs makes many objects, and next to none of them is garbage: 0.4 of 5.8 s of a solve.
        gc.set_threshold(50_000, 20, 50)
        use_few_arenas()
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # names of files may hold bytes that are no text
        signal.signal(signal.SIGTERM, _terminate)
    try:
        with _warnings_in_one_line():
            given = list(sys.argv[1:] if arguments is None else arguments)
            code = _app()(given, exit_on_error=False, print_error=False)
            sys.stdout.flush()
        return code if isinstance(code, int) else 0
    except (KeyboardInterrupt, Terminated) as signalled:
        return _ended_by(signalled)
    except BrokenPipeError:
        # Whoever read the output has seen enough. Python would complain once more when it closes the stream.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if (signalled := signal_behind(error)) is not None:
            return _ended_by(signalled)
        if os.environ.get("SCSR_TRACEBACK"):
            raise
        return _fail(sentence(error), 2)


def _ended_by(signalled: BaseException) -> int:
    return _fail("terminated.", 143) if isinstance(signalled, Terminated) else _fail("interrupted.", 130)


def _fail(why: str, code: int) -> int:
    say_error(why)
    return code


@contextmanager
def _warnings_in_one_line() -> Iterator[None]:
    """Shows the project's own warnings as one line each; those of libraries are for developers and not shown."""

    def show(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: object) -> None:
        if issubclass(category, UserWarning) and ("scsr_opt" in filename or "learned" in filename):
            print("scsr: warning:", " ".join(str(message).split()), file=sys.stderr, flush=True)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
