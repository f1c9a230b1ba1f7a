"""Run time against error of every rung of the ladder of models, on recordings as large as the sensor.

    python -m benchmarks.ladder [--scales 2 4] [--sensor 250 400] [--models fista-huber ridge …] [--rounds 1]

A still turns before the camera, by day and over 101 frames; every model makes the picture of the key frame, from the
spikes on, compiled. The table gives the medians of the seconds, in turns, their ratio to `reconstruct`, PSNR and SSIM.
"""

import argparse
import time
from statistics import median
from typing import Any

import numpy as np

from benchmarks.bench_cases import FRAMES, quality, recording_of, still_of
from benchmarks.choosing_cases import LIGHTS
from benchmarks.choosing_page import table
from learned.zoo import Network, model, names
from scsr_opt.camera.scenes import Affine
from scsr_opt.camera.simulator import Simulation, simulate
from scsr_opt.errors import InputError
from scsr_opt.priors import HuberTotalVariation, RidgeRegulariser, default_prior

# The same as `reconstruct`, which all others are compared with.
USUAL = {RidgeRegulariser: "ridge", HuberTotalVariation: "fista-huber"}
# Published for SpikeSR-Net and for Spk2VidNet, on an RTX 3090 and recordings of their own.
_PUBLISHED = {"SpikeSR-Net (published, RTX 3090)": 1.088, "Spk2VidNet (published, RTX 3090)": 0.043}


def turning(scale: int, height: int, width: int, seed: int = 0) -> Simulation:
    """A still that turns by 0.0004 radians per frame, seen by height × width sensor pixels."""
    picture = still_of("camera", scale * max(height, width))[: scale * height, : scale * width]
    scene = Affine(picture, rotation=4e-4, key=FRAMES // 2)
    return simulate(scene, scale=scale, frames=FRAMES, sensor=LIGHTS["day"], seed=seed)


def rows(made: Simulation, chosen: list[str], rounds: int) -> list[list[str]]:
    """A line of the table for each model, the most accurate first."""
    recording, truth = recording_of(made), made.truth(FRAMES // 2)
    taken: dict[str, list[float]] = {name: [] for name in chosen}
    found: dict[str, tuple[float, float]] = {}
    for turn in range(1 + rounds):  # the first compiles
        for name in chosen:
            made_by = model(name, made.scale)
            only_picture: dict[str, Any] = {"record": False} if isinstance(made_by, Network) else {}
            begin = time.perf_counter()
            image = np.asarray(made_by(recording, scale=made.scale, **only_picture).image)
            if turn:
                taken[name].append(time.perf_counter() - begin)
            found[name] = quality(truth, image, made.scale)
    default = USUAL[type(default_prior(made.scale))]
    usual = median(taken[default]) if default in taken else None

    def ratio(seconds: float) -> str:
        return "–" if usual is None else f"{seconds / usual:.2f}"

    lines = [
        [f"`{name}`", f"{median(taken[name]):.2f}", ratio(median(taken[name])), f"{found[name][0]:.2f}",
         f"{found[name][1]:.3f}"]
        for name in sorted(chosen, key=lambda name: -found[name][0])
    ]  # fmt: skip
    return lines + [[name, f"{seconds:.2f}", ratio(seconds), "–", "–"] for name, seconds in _PUBLISHED.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scales", nargs="+", type=int, default=[2, 4])
    parser.add_argument("--sensor", nargs=2, type=int, default=[250, 400], metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--models", nargs="+", help="all whose weights are there, if not given")
    parser.add_argument("--rounds", type=int, default=1)
    asked = parser.parse_args()
    if min(asked.rounds, *asked.sensor, *asked.scales) < 1:
        parser.error("--rounds, --sensor and --scales take whole numbers of at least 1.")
    try:
        for scale in asked.scales:
            made = turning(scale, *asked.sensor)
            chosen = asked.models or names(scale)
            print(f"\n×{scale}, {asked.sensor[1]}×{asked.sensor[0]} sensor pixels:\n")
            print(
                table(["model", "seconds", "over `reconstruct`", "PSNR, dB", "SSIM"], rows(made, chosen, asked.rounds))
            )
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
