"""A progress bar for the terminal."""

import threading
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    import rich.progress


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
