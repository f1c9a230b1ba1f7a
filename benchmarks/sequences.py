"""What a sequence of key frames saves against as many pictures from scratch, and how far its pictures are from those.

    python -m benchmarks.sequences FILE[:WIDTHxHEIGHT] [--pictures 20] [--step 5] [--scale 4] [--first 60]

Both are made in turns, a picture of the one, a picture of the other, after a first of each that compiles. The table
gives the median seconds of each and their ratio, in all and of pictures whose motion was carried on; the number of
these; iterations; and the largest change of the mean of a tile of 16 sensor pixels and the root mean square by which
the pictures differ, both in 1/255 of white.
"""

import argparse
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from benchmarks.skipping import tile_change
from scsr_opt import Recording, Solution, reconstruct, sequence
from scsr_opt.camera import read_recording
from scsr_opt.errors import InputError

Made = TypeVar("Made")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file")
    parser.add_argument("--pictures", type=int, default=20)
    parser.add_argument("--step", type=int, default=5)
    parser.add_argument("--first", type=int, default=60)
    parser.add_argument("--scale", type=int, default=4)
    chosen = parser.parse_args()
    path, _, size = chosen.file.partition(":")
    try:
        recording = read_recording(path, size=size) if size else read_recording(path)
        keys = range(chosen.first, chosen.first + chosen.pictures * chosen.step, chosen.step)
        print(table(recording, keys, chosen.scale))
    except InputError as error:
        parser.error(str(error))


def table(recording: Recording, keys: range, scale: int) -> str:
    """Measures and prints a line for each picture, and returns the table."""
    list(sequence(recording, keys[:2], scale=scale))  # compiles
    following = sequence(recording, keys, scale=scale)
    alone: list[float] = []
    together: list[float] = []
    carried: list[bool] = []
    iterations: list[tuple[int, int]] = []
    changes: list[tuple[float, float]] = []
    for key in keys:
        one, seconds = _timed(lambda key=key: reconstruct(recording, scale=scale, key=key))
        alone.append(seconds)
        other, seconds = _timed(lambda: next(following))
        together.append(seconds)
        carried.append(other.stats["carried"])
        iterations.append((one.stats["iterations"], other.stats["iterations"]))
        changes.append((abs(tile_change(one.image, other.image, scale)), _difference(one, other)))
        print(f"frame {key}: {alone[-1]:.2f} s, {together[-1]:.2f} s{', carried' if carried[-1] else ''}", flush=True)
    rows = [("all", np.ones(len(keys), bool)), ("carried", np.array(carried)), ("estimated", ~np.array(carried))]
    lines = [
        "| pictures | number | from scratch, s | sequence, s | ratio | iterations | tile's mean, 1/255 | rms, 1/255 |",
        "|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for name, which in rows:
        if which.any():
            first, second = np.median(np.array(alone)[which]), np.median(np.array(together)[which])
            before, after = np.median(np.array(iterations)[which], axis=0)
            tile, rms = np.max(np.array(changes)[which], axis=0)
            lines.append(
                f"| {name} | {which.sum()} | {first:.2f} | {second:.2f} | {first / second:.2f} | "
                f"{before:.0f} → {after:.0f} | {tile:.2f} | {rms:.2f} |"
            )
    return "\n".join(lines)


def _timed(make: Callable[[], Made]) -> tuple[Made, float]:
    begin = time.perf_counter()
    made = make()
    return made, time.perf_counter() - begin


def _difference(first: Solution, second: Solution) -> float:
    return 255 * float(np.sqrt(np.mean((first.image - second.image) ** 2)))


if __name__ == "__main__":
    main()
