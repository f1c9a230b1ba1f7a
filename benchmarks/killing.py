"""Whether a sequence that is killed at random moments loses nothing: its store equals one that was left undisturbed.

    python -m benchmarks.killing [FILE[:WIDTHxHEIGHT]] [--kills 20] [--workers N [--cluster]] [--pictures 24]
                                 [--every 4] [--group 4] [--scale 2] [--frames 41] [--seed 0] [--folder FOLDER]
                                 [--longest SECONDS] [--options="OTHERS OF SCSR SEQUENCE"]

Without FILE the recording is simulated: an object that passes before a still, 48×48 sensor pixels. The undisturbed run
comes first; it compiles the programs. Then the same command is given again and again, and after random times a process
is ended by SIGKILL. A fourth of these times count from the start or the kill before, and are at most what a second
undisturbed run takes; the others count from the first picture that is written then, and are at most what that run takes
from its first picture to its end. Both are at most --longest, if it is given. What is killed:

- the run;
- with --workers N: in turn the run and one of its workers, whose loss the run has to survive;
- with --cluster as well: in turn the run, one of N `dask worker` and their `dask scheduler`. Where the scheduler was
  killed the run may end, if it says so.

Whatever ended is started again. When all kills are spent, or the store is whole, a last run is left to end. Where a
store is whole before all kills are spent, the next one is begun. Exit code 1 if a store differs from the undisturbed
one in a byte, or a run says that it failed.
"""

import argparse
import math
import os
import random
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

# What a run says whose scheduler is lost, or was lost before it began.
_SCHEDULER_LOST = ("The scheduler was lost", "No scheduler with workers answered")

# Share of the kills that may hit a process that has only begun: the start takes long, and has little to lose.
_EARLY_SHARE = 0.25


@dataclass
class Kills:
    """Kills of a run, and how the store that was left compares.

    **Fields:** `killed`: numbers of "runs", "workers" and "schedulers"; `writing`: kills before which pictures had been
    written since the kill, or the start, before; `stores` that were compared, `same` of them
    equal; `without`: runs that said that the scheduler was lost; `faults`: what other runs said that were not killed
    and failed.
    """

    killed: Counter[str] = field(default_factory=Counter)
    writing: int = 0
    stores: int = 0
    same: int = 0
    without: int = 0
    faults: list[str] = field(default_factory=list)

    @property
    def total(self) -> int:
        """Number of kills."""
        return self.killed.total()

    @property
    def lossless(self) -> bool:
        """True where nothing was lost."""
        return self.stores == self.same > 0 and not self.faults

    @property
    def line(self) -> str:
        """Sentence for people."""
        faults = "".join(f"\n{fault}" for fault in self.faults)
        killed = self.killed
        return (
            f"{self.total} kills ({killed['runs']} of runs, {killed['workers']} of workers, {killed['schedulers']} of "
            f"schedulers; {self.writing} after pictures were written): "
            f"{self.same} of {self.stores} stores equal the undisturbed one, {self.without} runs said that the "
            f"scheduler was lost, {len(self.faults)} runs failed.{faults}"
        )


class Cluster:
    """A `dask scheduler` and `dask worker`s beside the run: processes that are started again where they ended.

    **Fields:** `address` of the scheduler; `processes`: the scheduler's, then those of the workers.
    """

    def __init__(self, workers: int):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        # A worker without the process that would start it again: that is done here.
        scheduler = ["scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
        worker = ["worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        self._commands = [[sys.executable, "-m", "dask", *command] for command in (scheduler, *[worker] * workers)]
        self.processes = [_silent(command) for command in self._commands]

    def mend(self) -> None:
        """Starts what has ended: workers end by themselves when they lose their scheduler."""
        for number, process in enumerate(self.processes):
            if process.poll() is not None:
                self.processes[number] = _silent(self._commands[number])

    def living(self) -> dict[str, list[int]]:
        """Its processes that have not ended, by their kind."""
        scheduler, *workers = self.processes
        kinds = {"schedulers": [scheduler], "workers": workers}
        return {kind: [one.pid for one in these if one.poll() is None] for kind, these in kinds.items()}

    def __enter__(self) -> "Cluster":
        return self

    def __exit__(self, *_: Any) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--cluster", action="store_true")
    parser.add_argument("--pictures", type=int, default=24)
    parser.add_argument("--every", type=int, default=4)
    parser.add_argument("--group", type=int, default=4)
    parser.add_argument("--scale", type=int, default=2)
    parser.add_argument("--frames", type=int, default=41)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--longest", type=float, default=0.0)
    parser.add_argument("--options", type=shlex.split, default=[])
    chosen = parser.parse_args()
    if chosen.cluster and chosen.workers is None:
        parser.error("--cluster needs --workers N, the number of its workers.")
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.folder or Path(temporary)
        file, _, size = (chosen.file or "").partition(":")
        if not file:
            file = str(simulated(folder / "object.npy", chosen.pictures * chosen.every + chosen.frames))
        first = chosen.frames // 2
        options = [file, *(["--size", size] if size else []), "--scale", str(chosen.scale)]
        options += ["--start", str(first), "--stop", str(first + chosen.pictures * chosen.every)]
        options += ["--every", str(chosen.every), "--group", str(chosen.group), "--frames", str(chosen.frames)]
        options += chosen.options
        processes = {"workers": chosen.workers, "cluster": chosen.cluster}
        chance = random.Random(chosen.seed)
        kills = kill_often(folder, options, chosen.kills, chance, longest=chosen.longest, **processes)
    print(kills.line)
    return 0 if kills.lossless else 1


def simulated(file: Path, frames: int) -> Path:
    """Writes a recording of an object that passes before a still."""
    from skimage import data

    from scsr_opt.camera import Sensor, simulate
    from scsr_opt.camera.scenes import MovingObject

    scene = MovingObject(data.camera()[90:186, 150:246], data.brick()[:40, :40], velocity=(0.3, 0.5), key=frames // 2)
    made = simulate(scene, scale=2, frames=frames, sensor=Sensor(photons=1000.0), seed=3)
    np.save(file, made.spikes)
    return file


def kill_often(
    folder: Path,
    options: list[str],
    number: int,
    chance: random.Random,
    *,
    longest: float = 0.0,
    workers: int | None = None,
    cluster: bool = False,
) -> Kills:
    """Kills runs of `scsr sequence` with these options `number` times, in `folder`; with `workers` these as well, and
    with `cluster` their scheduler, too. Between kills there are at most `longest` seconds; where it is 0, what a second
    undisturbed run takes in all, or from its first picture on."""
    kills, whole = Kills(), folder / "undisturbed.zarr"
    most = longest, longest
    with Cluster(workers) if cluster and workers is not None else nullcontext() as beside:
        many = [] if workers is None else ["--workers", str(workers)]
        if beside is not None:
            many = ["--scheduler", beside.address]
        _, said = (process := started(whole, options)).communicate()
        if process.returncode == 0 and longest == 0.0:  # with programs that are compiled
            shutil.rmtree(whole)
            begin = time.monotonic()
            process = started(whole, [*options, *many])
            _wait(process, math.inf, beside, whole)
            solving = time.monotonic()
            _, said = process.communicate()
            most = time.monotonic() - begin, time.monotonic() - solving
        if process.returncode != 0:
            kills.faults.append(said)
            return kills
        expected = content(whole)
        while kills.total < number:
            # A name that none had before: workers of a scheduler that has lost its run may still write to the last one.
            store = folder / f"killed{kills.stores}.zarr"
            while _disturbed(started(store, [*options, *many]), store, most, number, beside, kills, chance) != 0:
                if kills.faults:
                    return kills
            kills.stores += 1
            kills.same += content(store) == expected
    return kills


def _disturbed(
    run: "subprocess.Popen[str]",
    store: Path,
    most: tuple[float, float],
    number: int,
    cluster: Cluster | None,
    kills: Kills,
    chance: random.Random,
) -> int:
    """Kills the run or what works for it until the run ends or there were `number` kills; the exit code of the run.

    `most`: seconds before a kill, from the start or the kill before, or from the first picture then."""
    while True:
        before, early = _newest(store), chance.random() < _EARLY_SHARE
        seconds = chance.uniform(0, most[not early]) if kills.total < number else math.inf
        if not early:
            _wait(run, math.inf, cluster, store, before)
        if _wait(run, seconds, cluster):
            break
        living = {"workers": workers_of(run.pid)} if cluster is None else cluster.living()
        victims = {"runs": [run.pid], **{kind: these for kind, these in living.items() if these}}
        kind = min(victims, key=lambda kind: kills.killed[kind])
        with suppress(ProcessLookupError):  # a worker that ended meanwhile
            os.kill(chance.choice(victims[kind]), signal.SIGKILL)
            kills.killed[kind] += 1
            kills.writing += _newest(store) != before
    _, said = run.communicate()
    if run.returncode not in (0, -signal.SIGKILL):
        if kills.killed["schedulers"] and len(said.splitlines()) == 1 and any(one in said for one in _SCHEDULER_LOST):
            kills.without += 1
        else:
            kills.faults.append(said)
    print(kills.line, flush=True)
    return run.returncode


def _wait(
    run: "subprocess.Popen[str]",
    seconds: float,
    cluster: Cluster | None,
    store: Path | None = None,
    before: float = 0.0,
) -> bool:
    """Whether the run ends within these seconds, or before a picture is written to `store` whose newest one was written
    `before`; meanwhile the cluster is mended."""
    end = time.monotonic() + seconds
    while run.poll() is None and time.monotonic() < end and (store is None or _newest(store) == before):
        if cluster is not None:
            cluster.mend()
        time.sleep(0.05)
    return run.poll() is not None


def _newest(store: Path) -> float:
    """When the last picture was written to a store; 0 where there is none."""
    return max((file.stat().st_mtime for file in (store / "image" / "c").glob("*/0/0")), default=0.0)


def workers_of(process: int) -> list[int]:
    """Processes of Python that a process spawned to work for it."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            command = (entry / "cmdline").read_bytes()
        except OSError:  # ended meanwhile
            continue
        if parent == process and b"spawn_main" in command:
            found.append(int(entry.name))
    return found


def started(store: Path, options: list[str]) -> "subprocess.Popen[str]":
    """A run of `scsr sequence`."""
    command = [sys.executable, "-m", "scsr_opt.cli", "sequence", *options, "-o", str(store), "--quiet"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def _silent(command: list[str]) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def content(store: Path) -> dict[str, bytes]:
    """The files of a store by their names, but for those that a worker of an earlier run was writing when it ended."""
    files = (file for file in store.rglob("*") if file.is_file() and file.suffix != ".partial")
    return {str(file.relative_to(store)): file.read_bytes() for file in files}


if __name__ == "__main__":
    sys.exit(main())
