"""NumPy on several cores: it releases the interpreter while it works through an array. How many cores there are."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Part = TypeVar("Part")
Result = TypeVar("Result")


def in_threads(function: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """`function` of each part, in order, in one thread for each of `cores`."""
    if len(parts) < 2:
        return [function(part) for part in parts]
    with ThreadPoolExecutor(cores()) as threads:
        return list(threads.map(function, parts))


def cores() -> int:
    """Number of cores for this process: the environment's `NPROC`, by which XLA goes as well, or else those on which
    the system lets it run."""
    number = os.environ.get("NPROC", "")
    if number.isdigit() and int(number) > 0:
        return int(number)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
