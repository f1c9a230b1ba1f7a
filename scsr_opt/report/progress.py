"""Progress for people: a bar in a terminal, a line now and then elsewhere."""

import sys
import threading
import time
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    import rich.progress


class LineProgress:
    """A line on standard error every `every` seconds, for logs and pipes: what is done, how far, for how long.

    Lines come from a thread and not from `advance`, so that they also appear while a program is compiled. Work that
    takes less than `every` seconds shows nothing.
    """

    def __init__(self, *, every: float = 30.0, file: IO[str] | None = None):
        self._every, self._file = every, file
        self._began: float | None = None
        self._next = 0.0  # when the next line is due
        self._what = ""
        self._total: int | None = None
        self._done = 0
        self._ended: threading.Event | None = None

    def start(self, total: int | None, what: str) -> None:
        """Begins a part; lines of work that has several parts count from the first one."""
        self.finish()
        self._what, self._total, self._done = what, total, 0
        if self._began is None:
            self._began = time.monotonic()
            self._next = self._began + self._every
        self._ended = threading.Event()
        threading.Thread(target=self._lines, args=(self._ended, self._began), daemon=True).start()

    def advance(self, done: int) -> None:
        """Counts `done` more steps."""
        self._done += done

    def finish(self) -> None:
        """Ends the lines of this part."""
        if self._ended is not None:
            self._ended.set()
            self._ended = None

    def _lines(self, ended: threading.Event, began: float) -> None:
        while not ended.wait(max(self._next - time.monotonic(), 0)):
            self._next = time.monotonic() + self._every  # from now on: a compiler may have held all threads up
            of = "" if self._total is None else f": {self._done} of {self._total}"
            said = f"scsr: {self._what[:1].lower()}{self._what[1:]}{of} ({time.monotonic() - began:.0f} s)"
            print(said, file=self._file or sys.stderr, flush=True)


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
        """Sets the timer after which the bar of this part is shown."""
        self.finish()
        with self._lock:
            self._what, self._total, self._done = what, total, 0
            self._timer = threading.Timer(self._delay, self._show)
            self._timer.daemon = True
            self._timer.start()

    def advance(self, done: int) -> None:
        """Moves the bar on by `done` steps."""
        with self._lock:
            self._done += done
            if self._bar is not None:
                self._bar.update(self._bar.task_ids[0], completed=self._done)

    def finish(self) -> None:
        """Removes the bar, or its timer."""
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
