"""Time that a sequence of key frames saves against as many pictures from scratch, and how its pictures differ.

    python -m benchmarks.sequences FILE[:WIDTHxHEIGHT] [--pictures 20] [--step 5] [--scale 4] [--first 50] [--rounds 2]

In turns, after a first of each that compiles: the sequence; as many pictures from scratch; and as many from scratch by
the full computation (`Shortcuts.none()`). The table gives the seconds per picture (a sequence prepares the next picture
while it solves, so that only the whole can be timed), medians of the rounds; how many times as long each takes as the
sequence; iterations; and by how much pictures of the sequence differ from each: the largest change of the mean of a
tile of 16 sensor pixels and the root mean square, both in 1/255 of white. Those are mostly differences of the motion
that was estimated; so below it stands, of every fifth picture, how far it is from the full computation with its motion,
strength and gains: by how much the objective is above, and the largest change of a tile's mean.
"""

import argparse
from collections.abc import Callable
from statistics import median

import numpy as np

from benchmarks.skipping import opened, tile_change, unskipped
from benchmarks.timing import in_turns
from scsr_opt import Recording, Shortcuts, Solution, reconstruct, reconstruct_sequence
from scsr_opt.errors import InputError
from scsr_opt.pipeline.clip import Clip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file")
    parser.add_argument("--pictures", type=int, default=20)
    parser.add_argument("--step", type=int, default=5)
    parser.add_argument("--first", type=int, default=50)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=2)
    chosen = parser.parse_args()
    try:
        recording = opened(chosen.file)
        keys = range(chosen.first, chosen.first + chosen.pictures * chosen.step, chosen.step)
        print(table(recording, keys, chosen.scale, chosen.rounds))
    except InputError as error:
        parser.error(str(error))


def table(recording: Recording, keys: range, scale: int, rounds: int) -> str:
    """Measures and returns the table."""

    def alone(shortcuts: Shortcuts) -> list[Solution]:
        return [reconstruct(recording, scale=scale, key=key, shortcuts=shortcuts) for key in keys]

    ways: dict[str, Callable[[], list[Solution]]] = {
        "sequence": lambda: list(reconstruct_sequence(recording, keys, scale=scale)),
        "from scratch": lambda: alone(Shortcuts()),
        "in full": lambda: alone(Shortcuts.none()),
    }
    made = {name: make() for name, make in ways.items()}  # compiles
    seconds = {name: median(taken) / len(keys) for name, taken in in_turns(ways, rounds).items()}
    following = made["sequence"]
    carried = sum(bool(solution.diagnostics.motion_carried) for solution in following)
    lines = [
        f"{carried} of {len(keys)} motions were carried on.",
        "",
        "| pictures | s a picture | times the sequence | iterations | tile's mean, 1/255 | rms, 1/255 |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    for name, solutions in made.items():
        iterations = median(solution.diagnostics.iterations for solution in solutions)
        pairs = list(zip(solutions, following, strict=True))
        tile = max(tile_change(one.image, other.image, scale) for one, other in pairs)
        rms = max(_difference(one, other) for one, other in pairs)
        lines.append(
            f"| {name} | {seconds[name]:.2f} | {seconds[name] / seconds['sequence']:.2f} | {iterations:.0f} | "
            f"{tile:.2f} | {rms:.2f} |"
        )
    fifth = list(zip(keys, following, strict=True))[::5]
    apart = [_apart(recording, key, scale, solution) for key, solution in fifth]
    above, tile = (max(numbers) for numbers in zip(*apart, strict=True))
    lines += [
        "",
        f"With the motion of the sequence, in full: objective above {100 * above:.3f} %, tile's mean {tile:.2f}.",
    ]
    return "\n".join(lines)


def _apart(recording: Recording, key: int, scale: int, solution: Solution) -> tuple[float, float]:
    """Relative objective of a picture above that of the full computation with its motion, and the largest change of a
    tile's mean."""
    assert solution.motion is not None
    λ = solution.diagnostics.strength or 0.0
    given = {"scale": scale, "key": key, "motion": solution.motion, "strength": λ, "gain": solution.gain}
    full = reconstruct(recording, **given, shortcuts=Shortcuts.none())
    objective = unskipped(Clip.around(recording, key), solution.motion, scale, λ, solution.gain)
    above = objective(solution.image) / objective(full.image) - 1
    return above, tile_change(full.image, solution.image, scale)


def _difference(first: Solution, second: Solution) -> float:
    return 255 * float(np.sqrt(np.mean((first.image - second.image) ** 2)))


if __name__ == "__main__":
    main()
