"""Progress of long work, as an object that can be a no-op.

Whoever works for more than about a second takes a `progress: Progress | None` argument and tells it what is going on;
the caller decides whether anybody sees it. Compiled loops report after each chunk of iterations, not after each one.
"""

import threading
from typing import IO, TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    import rich.progress


@runtime_checkable
class Progress(Protocol):
    """What long work calls: `start`, then `advance` any number of times, then `finish`; then perhaps `start` again.

    - `start(total, what)`: begins a part of the work of `total` steps (None where nobody knows); `what` says in a few
      words what is being done, for example "Solving".
    - `advance(done)`: `done` more steps are finished since the last call.
    - `finish()`: this part is over. Also called when the work fails.
    """

    def start(self, total: int | None, what: str) -> None: ...

    def advance(self, done: int) -> None: ...

    def finish(self) -> None: ...


class NoProgress:
    """Progress that nobody sees."""

    def start(self, total: int | None, what: str) -> None:
        pass

    def advance(self, done: int) -> None:
        pass

    def finish(self) -> None:
        pass


class RichProgress:
    """A bar on standard error, shown once a part of the work has taken longer than `delay` seconds.

    The bar is drawn from a timer and not from `advance`, so that it appears while a first compilation keeps the first
    `advance` waiting. It is removed when its part is over: what is left on the screen is the command's own output.
    """

    def __init__(self, *, delay: float = 1.0, file: IO[str] | None = None):
        self._delay = delay
        self._file = file
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None
        self._bar: rich.progress.Progress | None = None
        self._what = ""
        self._total: int | None = None
        self._done = 0

    def start(self, total: int | None, what: str) -> None:
        self.finish()
        with self._lock:
            self._what, self._total, self._done = what, total, 0
            self._timer = threading.Timer(self._delay, self._show)
            self._timer.daemon = True
            self._timer.start()

    def advance(self, done: int) -> None:
        with self._lock:
            self._done += done
            if self._bar is not None:
                self._bar.update(self._bar.task_ids[0], completed=self._done)

    def finish(self) -> None:
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            if self._bar is not None:
                self._bar.stop()
                self._bar = None

    def _show(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        with self._lock:
            if self._timer is None:  # finished between the timer's end and the lock
                return
            console = Console(file=self._file, stderr=self._file is None)
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TaskProgressColumn(),
                TimeElapsedColumn(),
                console=console,
                transient=True,
            )
            self._bar.add_task(self._what, total=self._total, completed=self._done)
            self._bar.start()
