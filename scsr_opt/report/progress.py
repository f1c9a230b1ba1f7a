"""Progress for people: a bar in a terminal, a line now and then elsewhere."""

import sys
import threading
import time
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    import rich.progress

# Steps from which the remaining time is foretold: the first ones may compile programs, which later ones need not.
_FEWEST = 5


def speed(done: int, total: int | None, seconds: float) -> str:
    """The rate of `done` steps of `total` in `seconds`, and, from `_FEWEST` steps on, how long the rest takes at that
    rate, in words; empty where neither is known."""
    if total is None or not 0 < done < total or seconds <= 0:
        return ""
    each = seconds / done
    rate = f"{1 / each:.2g} per second" if each < 1 else f"{each:.2g} s each"
    if done < _FEWEST:
        return rate
    left = each * (total - done)
    shown = f"{left:.0f} s" if left < 120 else f"{left / 60:.0f} min" if left < 7200 else f"{left / 3600:.0f} h"
    return f"{rate}, {shown} left"


class LineProgress:
    """A line on standard error every `every` seconds, for logs and pipes: the part of the work, its progress, rate,
    remaining and elapsed time.

    Lines come from a thread and not from `advance`, so that they also appear while a program is compiled. Work that
    takes less than `every` seconds shows nothing.
    """

    def __init__(self, *, every: float | int = 30.0, file: IO[str] | None = None):
        self._every, self._file = every, file
        self._began: float | None = None
        self._part_began = 0.0
        self._next = 0.0  # when the next line is due
        self._what = ""
        self._total: int | None = None
        self._done = 0
        self._ended: threading.Event | None = None

    def start(self, total: int | None, what: str) -> None:
        """Begins a part; lines of work that has several parts count from the first one."""
        self.finish()
        self._what, self._total, self._done = what, total, 0
        self._part_began = time.monotonic()
        if self._began is None:
            self._began = self._part_began
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
            fast = speed(self._done, self._total, time.monotonic() - self._part_began)
            if self._total is None:
                of = f": {self._done} done" if self._done else ""
            else:
                of = f": {self._done} of {self._total}{fast and f', {fast}'}"
            said = f"scsr: {self._what[:1].lower()}{self._what[1:]}{of} ({time.monotonic() - began:.0f} s)"
            print(said, file=self._file or sys.stderr, flush=True)


class RichProgress:
    """A bar on standard error, with the remaining time, for parts of the work that take longer than `delay` seconds.

    The bar is drawn from a timer and not from `advance`, so that it appears while a first compilation keeps the first
    `advance` waiting. It is removed when its part is over: what is left on the screen is the command's own output.
    """

    def __init__(self, *, delay: float | int = 1.0, file: IO[str] | None = None):
        self._delay = delay
        self._file = file
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None
        self._bar: rich.progress.Progress | None = None
        self._what = ""
        self._total: int | None = None
        self._done = 0
        self._began = 0.0

    def start(self, total: int | None, what: str) -> None:
        """Sets the timer after which the bar of this part is shown."""
        self.finish()
        with self._lock:
            self._what, self._total, self._done, self._began = what, total, 0, time.monotonic()
            self._timer = threading.Timer(self._delay, self._show)
            self._timer.daemon = True
            self._timer.start()

    def advance(self, done: int) -> None:
        """Moves the bar on by `done` steps."""
        with self._lock:
            self._done += done
            if self._bar is not None:
                self._bar.update(self._bar.task_ids[0], completed=self._done, speed=self._speed())

    def finish(self) -> None:
        """Removes the bar, or its timer."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            if self._bar is not None:
                self._bar.stop()
                self._bar = None

    def _speed(self) -> str:
        return speed(self._done, self._total, time.monotonic() - self._began)

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
                TextColumn("{task.fields[speed]}"),
                console=console,
                transient=True,
            )
            self._bar.add_task(self._what, total=self._total, completed=self._done, speed=self._speed())
            self._bar.start()
