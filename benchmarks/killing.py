"""Whether a sequence that is killed at random moments loses nothing: its store equals one that was left undisturbed.

    python -m benchmarks.killing [FILE[:WIDTHxHEIGHT]] [--kills 20] [--workers N] [--pictures 24] [--every 4]
                                 [--group 4] [--scale 2] [--frames 41] [--seed 0] [--folder FOLDER]

Without FILE the recording is simulated: an object that passes before a still, 48×48 sensor pixels. The undisturbed run
comes first; it compiles the programs and its time is the unit of the moments. Then the same command is given again and
again, and ended by SIGKILL after a random time; with --workers every other kill hits a worker instead, and the run has
to go on by itself. When all kills are spent, or the store is whole, a last run is left to end. Where a store is whole
before all kills are spent, the next one is begun. Exit code 1 if a store differs from the undisturbed one in a byte,
or a run says that it failed.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np


@dataclass
class Kills:
    """Kills of a run, and how the store that was left compares.

    **Fields:** `runs` and `workers` that were killed; `stores` that were compared, `same` of them equal; `faults`: what
    runs said that were not killed and failed.
    """

    runs: int = 0
    workers: int = 0
    stores: int = 0
    same: int = 0
    faults: list[str] = field(default_factory=list)

    @property
    def total(self) -> int:
        """Number of kills."""
        return self.runs + self.workers

    @property
    def lossless(self) -> bool:
        """True where nothing was lost."""
        return self.stores == self.same > 0 and not self.faults

    @property
    def line(self) -> str:
        """Sentence for people."""
        faults = "".join(f"\n{fault}" for fault in self.faults)
        return (
            f"{self.total} kills ({self.runs} of runs, {self.workers} of workers): {self.same} of {self.stores} stores "
            f"equal the undisturbed one, {len(self.faults)} runs failed.{faults}"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--pictures", type=int, default=24)
    parser.add_argument("--every", type=int, default=4)
    parser.add_argument("--group", type=int, default=4)
    parser.add_argument("--scale", type=int, default=2)
    parser.add_argument("--frames", type=int, default=41)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.folder or Path(temporary)
        file, _, size = (chosen.file or "").partition(":")
        if not file:
            file = str(simulated(folder / "object.npy", chosen.pictures * chosen.every + chosen.frames))
        first = chosen.frames // 2
        options = [file, *(["--size", size] if size else []), "--scale", str(chosen.scale)]
        options += ["--start", str(first), "--stop", str(first + chosen.pictures * chosen.every)]
        options += ["--every", str(chosen.every), "--group", str(chosen.group), "--frames", str(chosen.frames)]
        kills = kill_often(folder, options, chosen.kills, chosen.workers, random.Random(chosen.seed))
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


def kill_often(folder: Path, options: list[str], number: int, workers: int | None, chance: random.Random) -> Kills:
    """Kills runs of `scsr sequence` with these options `number` times, in `folder`."""
    kills, whole, store = Kills(), folder / "undisturbed.zarr", folder / "killed.zarr"
    many = [] if workers is None else ["--workers", str(workers)]
    started(whole, options).communicate()
    begin = time.monotonic()
    shutil.rmtree(whole)
    ended, said = _end(started(whole, options))  # with programs that are compiled
    if ended != 0:
        kills.faults.append(said)
        return kills
    usual = time.monotonic() - begin
    expected = content(whole)
    while kills.total < number:
        shutil.rmtree(store, ignore_errors=True)
        while True:
            process = started(store, [*options, *many])
            if kills.total >= number:
                ended, said = _end(process)
            else:
                try:
                    process.wait(chance.uniform(0, 1.2 * usual))
                except subprocess.TimeoutExpired:
                    ended, said = _killed(process, workers is not None and kills.total % 2 == 1, kills, chance)
                else:
                    ended, said = _end(process)
            if ended == 0:
                break
            if ended != -signal.SIGKILL:
                kills.faults.append(said)
                return kills
        kills.stores += 1
        kills.same += content(store) == expected
        print(kills.line, flush=True)
    return kills


def _killed(process: "subprocess.Popen[str]", worker: bool, kills: Kills, chance: random.Random) -> tuple[int, str]:
    """Kills the run, or one of its workers, after which the run is left to end; its exit code and what it said."""
    children = workers_of(process.pid) if worker else []
    if children:
        kills.workers += 1
        os.kill(chance.choice(children), signal.SIGKILL)
    else:
        kills.runs += 1
        process.kill()
    return _end(process)


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


def _end(process: "subprocess.Popen[str]") -> tuple[int, str]:
    _, said = process.communicate()
    return process.returncode, said


def content(store: Path) -> dict[str, bytes]:
    """The files of a store by their names."""
    return {str(file.relative_to(store)): file.read_bytes() for file in store.rglob("*") if file.is_file()}


if __name__ == "__main__":
    sys.exit(main())
