"""Cost of sequences of long recordings on many workers: figures of this machine, and a simulation fed with them.

    python -m benchmarks.planning FILE[:WIDTHxHEIGHT] [--scale 4] [--every 2] [--page docs/planning.md]

Three parts, an hour or less on two cores:

1. `scsr sequence` of FILE by one and by two workers, each held to one core: when each group of pictures was there. From
   one worker come the seconds until it works, and those of a group; two workers check the simulation.
2. A group of pictures of a sensor of 1000×1000 pixels, FILE side by side as often as it takes, on one core.
3. Empty tasks through the scheduler, for the seconds that it needs for each.

The simulation (`simulated`) has workers, each with one group at a time; a scheduler that hands out one group at a time;
and storage that reads and writes at a given rate in all. The page tells what a recording of ten minutes takes.
"""

import argparse
import heapq
import multiprocessing
import os
import shlex
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from benchmarks.command import check_page, machine, made_by, table, write_page
from benchmarks.skipping import opened
from scsr_opt import Recording, reconstruct_sequence
from scsr_opt.errors import InputError
from scsr_opt.sequences import Plan, Workers, write_sequence

Result = TypeVar("Result")

_GROUP = 10
_LARGE = 1000  # sensor pixels a side
_SECONDS, _FRAMES_PER_SECOND = 600, 40_000
_EVERY = 400  # frames from picture to picture of the recording of ten minutes: 100 pictures per second
_WORKERS = (1, 10, 100, 1000)
# What storage reads and writes in all, bytes per second: a fast disk, a parallel file system.
_STORAGE = {"1 GB/s": 1e9, "20 GB/s": 2e10}


@dataclass(frozen=True)
class Costs:
    """Costs of a sequence, as they are measured for one worker.

    **Fields:** `start`, seconds until a worker works; `first` and `following`, core-seconds of the first picture of a
    group and of each other one; `handing_out`, seconds of the scheduler for a group; `read`, bytes of a group of
    `_GROUP` pictures; `written`, bytes of a picture.
    """

    start: float
    first: float
    following: float
    handing_out: float
    read: float
    written: float

    @property
    def group(self) -> float:
        """Core-seconds of a group."""
        return self.first + (_GROUP - 1) * self.following


class Course(NamedTuple):
    """**Fields:** `seconds` of a whole run, and the shares of them in which the workers (in the mean), the storage and
    the scheduler were busy."""

    seconds: float
    workers: float
    storage: float
    scheduler: float

    @property
    def limit(self) -> str:
        """Name of the part that is busy for the largest share: "solving", "storage" or "scheduler"."""
        shares = {"solving": self.workers, "storage": self.storage, "scheduler": self.scheduler}
        return max(shares, key=lambda name: shares[name])


def simulated(costs: Costs, groups: int, workers: int, storage: float) -> Course:
    """A run of so many groups by so many workers, with a storage of so many bytes per second.

    A worker waits for the scheduler, reads, solves, writes. Scheduler and storage serve one worker after the other, in
    the order in which they ask; storage is as fast for one worker as for all.
    """
    asking = [(costs.start, "ask", number) for number in range(workers)]
    scheduler = disk = 0.0  # when each is free
    left, end = groups, 0.0
    reading, writing = costs.read / storage, _GROUP * costs.written / storage
    while asking:
        now, what, worker = heapq.heappop(asking)
        if what == "ask" and left:
            left -= 1
            scheduler = max(now, scheduler) + costs.handing_out
            heapq.heappush(asking, (scheduler, "read", worker))
        elif what == "read":
            disk = max(now, disk) + reading
            heapq.heappush(asking, (disk + costs.group, "write", worker))
        elif what == "write":
            disk = max(now, disk) + writing
            heapq.heappush(asking, (disk, "ask", worker))
        end = max(end, now)
    busy = groups * np.array([costs.group / workers, reading + writing, costs.handing_out])
    return Course(end, *map(float, busy / end))


class _Times:
    """Progress that remembers when groups were there, seconds from when it was made."""

    def __init__(self):
        self.began, self.solving, self.times = time.perf_counter(), False, [0.0]

    def start(self, total: int | None, what: str) -> None:
        self.solving = what == "Solving"

    def advance(self, done: int) -> None:
        if self.solving:
            self.times.append(time.perf_counter() - self.began)

    def finish(self) -> None:
        self.solving = False


def on_cores(cores: int, function: Callable[..., Result], *arguments: Any) -> Result:
    """Calls `function` in a new process that may use so many cores, and returns its result."""
    chosen = sorted(os.sched_getaffinity(0))[:cores]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, os.sched_setaffinity, (0, chosen)) as process:
        return process.submit(function, *arguments).result()


def times_of_groups(file: str, keys: range, scale: int, workers: int) -> tuple[list[float], float]:
    """Seconds until each group was there, by workers, and the bytes that were written for each picture."""
    times = _Times()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "made.zarr"
        plan = Plan.of(opened(file), keys, scale=scale, group=_GROUP)
        write_sequence(plan, place, workers=Workers(workers), progress=times)
        written = sum(path.stat().st_size for path in place.rglob("*") if path.is_file())
    return times.times, written / len(keys)


def times_of_pictures(file: str, every: int, scale: int, side: int) -> list[float]:
    """Seconds of each of three pictures of the recording, side by side to `side`×`side` pixels; compiled before."""
    recording = tiled(opened(file), side)
    middle = recording.frames // 2
    keys, taken = range(middle - every, middle + every + 1, every), []
    for _ in range(2):
        taken, before = [], time.perf_counter()
        for _ in reconstruct_sequence(recording, keys, scale=scale):
            taken.append(time.perf_counter() - before)
            before = time.perf_counter()
    return taken


def tiled(recording: Recording, side: int) -> Recording:
    """The recording side by side, so often that it fills a sensor of `side`×`side` pixels."""
    spikes = recording.spikes
    rows, columns = (-(-side // length) for length in spikes.shape[1:])
    return Recording.from_array(np.tile(spikes, (1, rows, columns))[:, :side, :side], white_rate=recording.white_rate)


def seconds_of_a_task(tasks: int = 500) -> float:
    """Seconds that the scheduler takes for a task: the mean over so many empty ones, handed out a few at a time."""
    import distributed

    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=":0") as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        client.submit(int, pure=False).result()
        began, handed_out = time.perf_counter(), 0
        running = distributed.as_completed(loop=client.loop)
        for _ in range(4):
            running.add(client.submit(int, pure=False))
        for _ in running:
            handed_out += 1
            if handed_out <= tasks - 4:
                running.add(client.submit(int, pure=False))
        return (time.perf_counter() - began) / tasks


def bytes_of_frames(keys: range, shape: tuple[int, int], around: int = 801) -> float:
    """Bytes of the frames that a group of neighbouring pictures reads: `around` frames about each key frame, which tell
    whether lamps flicker. `shape`: rows and columns of the sensor."""
    return ((_GROUP - 1) * keys.step + around) * -(-shape[0] * shape[1] // 8)


def measured(file: str, scale: int, every: int) -> tuple[Costs, str]:
    """Costs of the recording at its own size, and a table that compares the simulation with one and two workers."""
    recording = opened(file)
    keys = range(50, recording.frames - 50, every)
    keys = keys[: len(keys) // _GROUP * _GROUP]
    if len(keys) < 4 * _GROUP:
        raise InputError(f"{file} has {recording.frames} frames, too few for four groups of {_GROUP} pictures.")
    on_cores(1, times_of_groups, file, keys[:_GROUP], scale, 1)  # compiles, into the cache of programs
    found = {n: on_cores(n, times_of_groups, file, keys, scale, n) for n in (1, 2)}
    times, written = found[1]
    each = float(np.median(np.diff(times[1:])))
    own = Costs(times[1] - each, each / _GROUP, each / _GROUP, seconds_of_a_task(), 0.0, written)
    rows = []
    for workers, (taken, _) in found.items():
        told = simulated(own, len(keys) // _GROUP, workers, np.inf).seconds
        rows.append([str(workers), f"{taken[-1]:.1f}", f"{told:.1f}", f"{100 * (told / taken[-1] - 1):+.0f} %"])
    lines = table(["workers", "measured, s", "simulated, s", "difference"], rows)
    return replace(own, read=bytes_of_frames(keys, recording.shape[1:])), lines


def page(file: str, scale: int, every: int) -> str:
    """Text of the page: all figures and tables, in Markdown."""
    own, checked = measured(file, scale, every)
    first, *following = on_cores(1, times_of_pictures, file, every, scale, _LARGE)
    shape, keys = (_LARGE, _LARGE), range(0, _SECONDS * _FRAMES_PER_SECOND, _EVERY)
    sensor = opened(file).shape[1:]
    large = replace(
        own,
        first=first,
        following=float(np.mean(following)),
        read=bytes_of_frames(keys, shape),
        written=own.written * _LARGE**2 / np.prod(sensor),
    )
    size, handed = "×".join(str(length) for length in reversed(sensor)), f"{1e3 * own.handing_out:.1f}"
    costs = table(
        ["", f"{size}, ×{scale}", f"{_LARGE}×{_LARGE}, ×{scale}"],
        [
            ["pictures per second of a core", *(f"{_GROUP / one.group:.3f}" for one in (own, large))],
            ["read for a picture, MB", *(f"{one.read / _GROUP / 1e6:.1f}" for one in (own, large))],
            ["written for a picture, MB", *(f"{one.written / 1e6:.1f}" for one in (own, large))],
            ["until a worker works, s", f"{own.start:.1f}", f"not measured; {own.start:.1f} in the simulation"],
            ["scheduler for a group, ms", handed, f"not measured; {handed} in the simulation"],
        ],
    )
    rows = []
    for workers in _WORKERS:
        courses = [simulated(large, len(keys) // _GROUP, workers, rate) for rate in _STORAGE.values()]
        rows.append([f"{workers:,}", *(f"{_duration(one.seconds)} ({one.limit})" for one in courses)])
    plan = table(["workers of one core", *(f"storage of {name}" for name in _STORAGE)], rows)
    total = {"in": len(keys) / _GROUP * large.read / 1e12, "out": len(keys) * large.written / 1e12}
    return (
        f"{costs}\n\nThe simulation against real workers, {size} at ×{scale}, each worker held to one core:\n\n"
        f"{checked}\n\nTen minutes at {_LARGE}×{_LARGE} and ×{scale}, a picture every {_EVERY} frames: {len(keys):,} "
        f"pictures, {total['in']:.1f} TB read, {total['out']:.1f} TB written. In brackets: what is busiest.\n\n{plan}"
    )


def _duration(seconds: float) -> str:
    for unit, length in (("days", 86400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--every", type=int, default=2)
    parser.add_argument("--page", type=Path, help="page whose figures are to be written anew")
    chosen = parser.parse_args()
    try:
        if chosen.page is not None:
            check_page(chosen.page)
        about, began = machine(), time.perf_counter()
        text = page(chosen.file, chosen.scale, chosen.every)
        about |= {"seconds": time.perf_counter() - began}
        name = Path(chosen.file).name
        command = shlex.join(["python", "-m", "benchmarks.planning", name, "--scale", str(chosen.scale)])
        text = f"{made_by(command, about)}\n\n{text}"
        print(text)
        if chosen.page is not None:
            write_page(chosen.page, text, {})
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
