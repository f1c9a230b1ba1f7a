"""Batches of examples in a fixed order, made by other processes while the network learns.

The simulator is NumPy and holds Python's lock most of the time, so threads would not help; processes do. They are
started afresh and not forked, which a process with an accelerator does not survive. Those that make plain examples do
not import JAX; one that does (`learned.training.prepared_cache`) keeps to the CPU, as the accelerator is the parent's.
"""

import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Generator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection, get_context, parent_process
from typing import Any, Protocol, runtime_checkable

import numpy as np

from learned.training.data import Example
from scsr_opt.errors import InputError


@runtime_checkable
class Source(Protocol):
    """An endless list of examples, each a named tuple or a dictionary of arrays; `learned.training.data.Examples` is
    one."""

    def __getitem__(self, number: int, /) -> Any: ...


def batches(
    examples: Source, batch: int, start: int, stop: int, *, workers: int, ahead: int = 4
) -> Generator[Any, None, None]:
    """Batches number `start` to `stop` − 1: batch n holds the examples n·batch to (n + 1)·batch − 1.

    **Arguments:**
    - `workers`: processes that make examples ahead of their use; 0: each is made here when it is needed. A script
      that uses some keeps its own work under `if __name__ == "__main__":`, because they import it.
    - `ahead`: the most batches that are made ahead.

    Close the iterator (`contextlib.closing`) where it is not read to its end: that ends the workers. They also end when
    this process is killed.

    **Raises:** `InputError` if an example cannot be made, or a worker was killed.
    """
    if workers == 0:
        for n in range(start, stop):
            yield stacked([examples[i] for i in range(n * batch, (n + 1) * batch)])
        return
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (examples,))
    waiting: deque[Future[Any]] = deque()
    try:
        numbers = iter(range(start * batch, stop * batch))
        for _ in range(start, stop):
            while len(waiting) < (ahead + 1) * batch and (number := next(numbers, None)) is not None:
                waiting.append(pool.submit(_make, number))
            yield stacked([waiting.popleft().result() for _ in range(batch)])
    except BrokenProcessPool as error:
        raise InputError(
            "A worker that makes training examples came to an end by itself: there may be too little memory (use fewer "
            "workers), or the script that trains lacks `if __name__ == '__main__':`."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def stacked(examples: list[Any]) -> Any:
    """Examples as one, with one more axis in front of each array."""
    if isinstance(examples[0], Mapping):
        return {name: np.stack([example[name] for example in examples]) for name in examples[0]}
    return Example(*(np.stack(part) for part in zip(*examples, strict=True)))


_here: Source | None = None
"""In a worker: the examples that it makes, sent once and not with every task."""


def _begin(examples: Source) -> None:
    global _here
    _here = examples
    os.environ["JAX_PLATFORMS"] = "cpu"
    if "jax" in sys.modules:  # it looks at the environment when it is imported only
        sys.modules["jax"].config.update("jax_platforms", "cpu")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the parent, which ends its workers

    def end_with_parent() -> None:
        # A worker holds both ends of the queue it reads, so it would wait for ever for a parent that was killed.
        parent = parent_process()
        if parent is not None:
            connection.wait([parent.sentinel])
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def _make(number: int) -> Any:
    assert _here is not None
    return _here[number]
