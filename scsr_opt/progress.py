"""Progress of long work, as an object that can be a no-op.

Whoever works for more than about a second takes a `progress: Progress | None` argument and tells it what is going on;
the caller decides whether anybody sees it. Compiled loops report after each chunk of iterations, not after each one.
"""

from typing import Any, Protocol, runtime_checkable

from scsr_opt.errors import InputError, shown


@runtime_checkable
class Progress(Protocol):
    """Receiver of the progress of long work, which calls `start`, then `advance` any number of times, then `finish`; it
    may then call `start` again for a further part.

    - `start(total, what)`: begins a part of the work of `total` steps (None where nobody knows); `what` says in a few
      words what is being done, for example "Solving".
    - `advance(done)`: `done` more steps are finished since the last call.
    - `finish()`: this part is over. Also called when the work fails.
    """

    def start(self, total: int | None, what: str) -> None:
        """A part of the work begins, of `total` steps (None where nobody knows)."""
        ...

    def advance(self, done: int) -> None:
        """`done` more steps are finished."""
        ...

    def finish(self) -> None:
        """The part is over, or the work failed."""
        ...


def check_progress(progress: Any) -> None:
    """**Raises:** `InputError` if `progress` is neither None nor a `Progress`: a function, or a class in the place of
    one of its objects, would fail only in the middle of the work."""
    if progress is not None and (isinstance(progress, type) or not isinstance(progress, Progress)):
        raise InputError(
            f"progress is {shown(progress)}; it must be None or an object with the methods start, advance and finish "
            f"(scsr_opt.progress.Progress), such as scsr_opt.report.RichProgress()."
        )


class NoProgress:
    """Progress that nobody sees."""

    def start(self, total: int | None, what: str) -> None:
        """Shows nothing."""

    def advance(self, done: int) -> None:
        """Shows nothing."""

    def finish(self) -> None:
        """Shows nothing."""
