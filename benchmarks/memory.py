"""Memory mappings and resident memory of one process that reconstructs crops of many sizes.

    python -m benchmarks.memory --crops 60

Each size of sensor compiles programs of its own. What they take is bounded (`scsr_opt._kernels.programs`): after the
first ten crops neither column rises any more. With `--quick` programs are compiled with few optimisations: in less
time, to more mappings each.
"""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

from scsr_opt import reconstruct
from scsr_opt._kernels.programs import mappings
from scsr_opt.camera import Sensor, simulate
from scsr_opt.camera.scenes import Translation

_FRAMES, _SCALE = 40, 2
# The smallest crop, and by how much the sizes that follow differ in height and width, sensor pixels.
_SMALLEST = (20, 24)
_HEIGHTS, _WIDTHS = 21, 27


def crop_sizes(number: int) -> list[tuple[int, int]]:
    """`number` different sizes, of which none is much larger than another."""
    sizes = [(_SMALLEST[0] + n % _HEIGHTS, _SMALLEST[1] + n % _WIDTHS) for n in range(_HEIGHTS * _WIDTHS)]
    different = list(dict.fromkeys(sizes))
    if number > len(different):
        raise SystemExit(f"--crops is {number}; there are {len(different)} different sizes at most.")
    return different[:number]


def resident(process: int | str = "self") -> int:
    """Resident memory of a process, MB; 0 where it has ended, or the system does not tell."""
    try:
        text = Path(f"/proc/{process}/smaps_rollup").read_text()
    except OSError:
        return 0
    return next((int(line.split()[1]) // 1024 for line in text.splitlines() if line.startswith("Rss:")), 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--crops", type=int, default=60, help="how many sizes")
    parser.add_argument("--quick", action="store_true", help="compile with few optimisations")
    given = parser.parse_args()
    jax.config.update("jax_disable_most_optimizations", given.quick)
    sizes = crop_sizes(given.crops)
    height, width = (max(size[axis] for size in sizes) for axis in (0, 1))
    picture = np.kron(np.random.default_rng(0).uniform(0.1, 1, (height // 2 + 1, width // 2 + 1)), np.ones((4, 4)))
    scene = Translation(picture[: _SCALE * height, : _SCALE * width], velocity=(0.22, -0.34), key=_FRAMES // 2)
    spikes = simulate(scene, scale=_SCALE, frames=_FRAMES, sensor=Sensor(photons=1000.0), seed=0).spikes
    print(f"{'crop':>4} {'size':>7} {'mappings':>8} {'resident, MB':>12} {'seconds':>7}")
    for number, (rows, columns) in enumerate(sizes, 1):
        begin = time.perf_counter()
        reconstruct(spikes[:, :rows, :columns], scale=_SCALE)
        seconds = time.perf_counter() - begin
        size = f"{rows}x{columns}"
        print(f"{number:4} {size:>7} {mappings():8} {resident():12} {seconds:7.1f}", flush=True)


if __name__ == "__main__":
    main()
