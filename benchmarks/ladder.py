"""Run time against error of every learned model, on recordings as large as the sensor.

    python -m benchmarks.ladder [--scales 2 4] [--sensor 250 400] [--models fista-huber ridge …] [--rounds 1]

A still turns before the camera, by day and over 101 frames; every model makes the picture of the key frame, from the
spikes on, compiled. The table gives the medians of the seconds, in turns, their ratio to `reconstruct`, PSNR and SSIM.
"""

import argparse
from functools import partial
from statistics import median

from benchmarks.bench.whole import default_model, picture_by_model
from benchmarks.command import table
from benchmarks.recordings import FRAMES, LIGHTS, quality, recording_of, still_of
from benchmarks.timing import in_turns
from learned.zoo import names
from scsr_opt.camera.scenes import Affine
from scsr_opt.camera.simulator import Simulation, simulate
from scsr_opt.errors import InputError

# Seconds that were published, for recordings of their own.
_PUBLISHED = {"SpikeSR-Net (published, RTX 3090)": 1.088, "Spk2VidNet (published, RTX 3090)": 0.043}


def turning(scale: int, height: int, width: int, seed: int = 0) -> Simulation:
    """A still that turns by 0.0004 radians per frame, seen by height × width sensor pixels."""
    picture = still_of("camera", scale * max(height, width))[: scale * height, : scale * width]
    scene = Affine(picture, rotation=4e-4, key=FRAMES // 2)
    return simulate(scene, scale=scale, frames=FRAMES, sensor=LIGHTS["day"], seed=seed)


def rows(made: Simulation, chosen: list[str], rounds: int) -> list[list[str]]:
    """A line of the table for each model, the most accurate first."""
    recording, truth = recording_of(made), made.truth(FRAMES // 2)
    pictures = {name: partial(picture_by_model(name, made.scale), recording) for name in chosen}
    scores = {name: quality(truth, picture(), made.scale) for name, picture in pictures.items()}  # compiles, too
    seconds = {name: median(taken) for name, taken in in_turns(pictures, rounds).items()}
    usual = seconds.get(default_model(made.scale))

    def line(name: str, taken: float, psnr: str, ssim: str) -> list[str]:
        return [name, f"{taken:.2f}", "–" if usual is None else f"{taken / usual:.2f}", psnr, ssim]

    ordered = sorted(chosen, key=lambda name: -scores[name][0])
    lines = [line(f"`{name}`", seconds[name], f"{scores[name][0]:.2f}", f"{scores[name][1]:.3f}") for name in ordered]
    return lines + [line(name, taken, "–", "–") for name, taken in _PUBLISHED.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scales", nargs="+", type=int, default=[2, 4])
    parser.add_argument("--sensor", nargs=2, type=int, default=[250, 400], metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--models", nargs="+", help="all whose weights are there, if not given")
    parser.add_argument("--rounds", type=int, default=1)
    options = parser.parse_args()
    if min(options.rounds, *options.sensor, *options.scales) < 1:
        parser.error("--rounds, --sensor and --scales take whole numbers of at least 1.")
    try:
        for scale in options.scales:
            made = turning(scale, *options.sensor)
            chosen = options.models or names(scale)
            print(f"\n×{scale}, {options.sensor[1]}×{options.sensor[0]} sensor pixels:\n")
            head = ["model", "seconds", "time relative to `reconstruct`", "PSNR, dB", "SSIM"]
            print(table(head, rows(made, chosen, options.rounds)))
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
