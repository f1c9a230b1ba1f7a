"""How near to the best is the strength that `reconstruct` sets from the data?

    python -m benchmarks.strength [--pictures camera coins brick astronaut]

Stills that come with scikit-image, at rest, panning and turning, in daylight and dim light, are reconstructed with
strengths from a quarter of the chosen one to four times it. Prints the PSNR at each, relative to the best.
"""

import argparse

import numpy as np
from skimage import data

from scsr_opt import reconstruct
from scsr_opt.camera.pictures import as_intensity
from scsr_opt.camera.scenes import Affine, Scene, Static, Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.cli.demo_scene import psnr

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
LIGHTS = {"day": Sensor(white_rate=0.6, photons=1000.0), "dim": Sensor(white_rate=0.1, photons=25.0)}
SIZE = 240


def scenes(name: str, scale: int) -> dict[str, Scene]:
    picture = as_intensity(getattr(data, name)())
    top, left = ((n - SIZE) // 2 for n in picture.shape)
    picture = picture[max(top, 0) : top + SIZE, max(left, 0) : left + SIZE]
    return {
        "at rest": Static(picture),
        "panning": Translation(picture, velocity=(0.07 * scale, -0.12 * scale)),
        "turning": Affine(picture, rotation=0.0012, zoom=0.0008, drift=(0.02 * scale, 0.01 * scale)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", nargs="+", default=["camera", "coins", "brick", "astronaut"])
    arguments = parser.parse_args()
    print("light scale scene    picture    chosen    dB at " + " ".join(f"{factor:5g}x" for factor in FACTORS))
    lost = []
    for light, sensor in LIGHTS.items():
        for scale in (2, 4):
            for picture in arguments.pictures:
                for scene, world in scenes(picture, scale).items():
                    made = simulate(world, scale=scale, sensor=sensor)
                    truth = made.truth(50)
                    first = reconstruct(made.spikes, scale=scale, key=50, white_rate=sensor.white_rate)
                    chosen = first.stats["strength"]
                    scores = []
                    for factor in FACTORS:
                        tried = reconstruct(
                            made.spikes, scale=scale, key=50, white_rate=sensor.white_rate, strength=chosen * factor
                        )
                        scores.append(psnr(truth, tried.image, 8 * scale))
                    lost.append(max(scores) - scores[FACTORS.index(1.0)])
                    row = " ".join(f"{score:6.2f}" for score in scores)
                    print(f"{light:5s} x{scale}    {scene:8s} {picture:10s} {chosen:.6f}       {row}", flush=True)
    print(f"lost by not knowing the best: {np.mean(lost):.2f} dB in the mean, {np.max(lost):.2f} at most")


if __name__ == "__main__":
    main()
