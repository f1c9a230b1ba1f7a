"""Groups of pictures by the workers of a Dask cluster.

A worker gets the plan and the number of a group, reads the recording itself and writes into the store itself: nothing
large goes through the scheduler. Groups are handed out a few ahead of the workers, so that the scheduler's memory does
not grow with the number of pictures. A group whose worker is lost is solved again by another one, to the same bits.
"""

import logging
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scsr_opt._kernels.memory import ARENAS
from scsr_opt._threads import cores
from scsr_opt._validation import whole
from scsr_opt.errors import InputError, shown
from scsr_opt.sequences.plan import Plan

if TYPE_CHECKING:
    import distributed

# Groups that are handed out for each worker: one that it solves, and one that it begins without waiting.
_GROUPS_AHEAD = 2
# Workers that may be lost while they solve one and the same group before it is given up: more than chance takes, few
# enough for a group that ends each worker, by its need of memory, not to go on for ever.
_LOST_WORKERS = 10
# Times that workers are started on this machine, if one of them is lost while it starts.
_STARTS = 3
# Addresses of a scheduler: a protocol of Dask, a host and a port.
_ADDRESS = re.compile(r"(tcp|tls|ws|wss|ucx)://(\[[0-9A-Fa-f:.%]+\]|[^\s:/\[\]]+):[0-9]{1,5}")
# Seconds to wait for a scheduler, and for its first worker.
_PATIENCE = 30


@dataclass(frozen=True)
class Workers:
    """Workers that solve for a sequence.

    **Fields:**
    - `number`: processes to start on this machine, which share its cores.
    - `scheduler`: address of a Dask scheduler whose workers are used instead, `tcp://HOST:PORT`. They have to see the
      store, and the recording unless it is read by a URL, under the same paths.
    - `started`: called with the address of the dashboard once the workers are there.

    **Raises:** `InputError` unless exactly one of the first two is given, or Dask is not installed.
    """

    number: int | None = None
    scheduler: str | None = None
    started: Callable[[str], None] | None = None

    def __post_init__(self):
        if (self.number is None) == (self.scheduler is None):
            raise InputError("Give the number of workers to start, or the address of a scheduler: one of the two.")
        if self.number is not None:
            whole(self.number, "workers", 1)
        elif not _ADDRESS.fullmatch(str(self.scheduler)):
            raise InputError(
                f"The scheduler is {shown(self.scheduler)}, which is no address: give one such as tcp://10.0.0.1:8786."
            )
        try:
            import distributed  # noqa: F401
        except ImportError:
            raise InputError(
                "Workers need the package distributed, which is not installed: pip install 'scsr-opt[sequence]'."
            ) from None


def solve_by_workers(
    workers: Workers, place: Path, plan: Plan, groups: list[int], solved: Callable[[int], None]
) -> None:
    """Has the groups of these numbers solved into the store `place`.

    **Arguments:** `solved`: called with the number of its pictures after each group.

    **Raises:** `InputError` that a worker raised, or if the scheduler or its workers are lost.
    """
    import distributed

    sizes = plan.groups
    with _while_the_scheduler_is_there(), _client(workers) as client:
        if workers.started is not None:
            workers.started(client.dashboard_link)
        waiting = iter(groups)
        running = distributed.as_completed(loop=client.loop)

        def hand_out() -> None:
            number = next(waiting, None)
            if number is not None:
                running.add(client.submit(_solve_group, str(place), plan, number, pure=False))

        for _ in range(_GROUPS_AHEAD * max(1, len(client.scheduler_info(n_workers=-1)["workers"]))):
            hand_out()
        for done in running:
            solved(len(sizes[_result(done)]))
            hand_out()


def _solve_group(place: str, plan: Plan, number: int) -> int:
    """A worker's task."""
    from scsr_opt.sequences.run import solve_group
    from scsr_opt.sequences.store import SequenceStore

    store = SequenceStore.open(place, write=True)
    store.check(plan)
    solve_group(store, plan, number, lambda _: None)
    return number


def _result(done: "distributed.Future") -> int:
    from distributed.scheduler import KilledWorker

    try:
        return done.result()
    except KilledWorker as error:
        raise InputError(
            f"{_LOST_WORKERS} workers ended while they solved for the same pictures, most likely for want of memory: "
            f"take fewer workers, a smaller scale or a crop; the pictures that are there stay."
        ) from error


@contextmanager
def _while_the_scheduler_is_there() -> Iterator[None]:
    """**Raises:** `InputError` if the connection to the scheduler is lost, while it is waited for or asked."""
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError

    try:
        yield
    except (FutureCancelledError, CommClosedError) as error:
        raise InputError("The scheduler was lost: give the command again once it is there.") from error


@contextmanager
def _client(workers: Workers) -> Iterator[Any]:
    """A client of the workers, which are started here unless there is a scheduler."""
    import distributed
    from dask import config

    for name in ("distributed", "distributed.client"):  # the second has a level of its own
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters is said by an error
    with ExitStack() as stack:
        stack.enter_context(
            config.set(
                {
                    "distributed.scheduler.allowed-failures": _LOST_WORKERS,
                    "distributed.comm.timeouts.connect": f"{_PATIENCE}s",
                }
            )
        )
        address: Any = workers.scheduler
        if workers.number is not None:
            address = stack.enter_context(_cluster(workers.number))
        try:
            client = stack.enter_context(distributed.Client(address, timeout=_PATIENCE, set_as_default=False))
            client.wait_for_workers(1, timeout=_PATIENCE)
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(
                f"No scheduler with workers answered at {workers.scheduler or 'this machine'} within {_PATIENCE} s: "
                f"check the address, such as tcp://10.0.0.1:8786, and that dask worker runs."
            ) from error
        yield client


def _cluster(number: int) -> Any:
    """So many workers on this machine, started again where one of them is lost meanwhile.

    **Raises:** `InputError` if that happens `_STARTS` times.
    """
    import distributed

    threads, lost = str(max(1, cores() // number)), None
    for _ in range(_STARTS):
        try:
            return distributed.LocalCluster(
                n_workers=number,
                threads_per_worker=1,
                processes=True,
                dashboard_address=":0",
                silence_logs=logging.CRITICAL,
                memory_limit=0,
                # Threads of XLA (and `in_threads`) and of NumPy's libraries: together as many as there are cores.
                env={"NPROC": threads, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
                | {"MALLOC_ARENA_MAX": str(ARENAS)},
            )
        except RuntimeError as error:
            lost = error
    raise InputError(
        f"{number} workers were started {_STARTS} times, and each time one of them ended at once, most likely for want "
        f"of memory: take fewer workers."
    ) from lost
