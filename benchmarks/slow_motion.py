"""Motion that is hard to see: slow pans, short recordings, dim light, pans that leave the view.

    python -m benchmarks.slow_motion

For each kind of recording, six stills of scikit-image (100×100 sensor pixels, ×2) pan at a speed: the error of the
velocity that one fit finds (`Global`) and of what `Automatic` takes, relative to the speed, in the median and at worst;
the PSNR with `Automatic` and with the true velocity, dB; and of as many still scenes, how many are taken to move by
more than a tenth of a pixel.
"""

import numpy as np
from jaxtyping import Float
from skimage import color, data

from scsr_opt import reconstruct
from scsr_opt.camera import Sensor, Simulation, simulate
from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.motion import Estimator, Global, estimate_motion

SCALE, SIDE = 2, 200
_MOVES = 0.1  # sensor pixels at the ends of a recording
DAY, DIM = Sensor(photons=1000.0), Sensor(white_rate=0.1, photons=25.0)
KINDS = (
    ("day", DAY, 10, 0.2), ("day", DAY, 20, 0.05), ("day", DAY, 20, 0.1), ("day", DAY, 20, 0.2),
    ("day", DAY, 40, 0.025), ("day", DAY, 40, 0.1), ("day", DAY, 101, 0.003), ("day", DAY, 101, 0.01),
    ("day", DAY, 101, 0.14), ("day", DAY, 101, 0.8), ("dim", DIM, 101, 0.02), ("dim", DIM, 101, 0.14),
)  # fmt: skip
"""Light, camera, frames, and speed in sensor pixels per frame."""


def stills() -> list[Float[np.ndarray, "H W"]]:
    """Six parts of scikit-image's pictures, intensity."""
    corners = {"camera": (100, 100), "astronaut": (0, 100), "coffee": (60, 100), "coins": (0, 0), "chelsea": (30, 100),
               "brick": (0, 0)}  # fmt: skip
    found = []
    for name, (top, left) in corners.items():
        picture = getattr(data, name)()
        picture = color.rgb2gray(picture) if picture.ndim == 3 else picture / 255
        found.append(picture[top : top + SIDE, left : left + SIDE])
    return found


def error(made: Simulation, velocity: Float[np.ndarray, "2"], estimator: Estimator | None) -> float:
    """Mean length of the velocity's error over the speed; over the sensor for a scene at rest, pixels per frame."""
    key = len(made.spikes) // 2
    found = estimate_motion(made.spikes, key=key, white_rate=made.sensor.white_rate, estimator=estimator)
    away = float(np.hypot(*(found.velocity - velocity[:, None, None])).mean())
    return away / float(np.hypot(*velocity)) if velocity.any() else away


def main() -> None:
    print("| light | frames | px per frame | one fit | Automatic | PSNR, dB | true motion | at rest, moving |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|")
    for light, sensor, frames, speed in KINDS:
        velocity = speed * np.array([0.6, 0.8])
        fits, taken, ratios, moving = [], [], [], 0
        for n, still in enumerate(stills()):
            scene = Translation(still, (SCALE * velocity[0], SCALE * velocity[1]))
            made = simulate(scene, scale=SCALE, frames=frames, sensor=sensor, seed=n)
            fits.append(error(made, velocity, Global()))
            taken.append(error(made, velocity, None))
            truth, by = made.truth(frames // 2), {"scale": SCALE, "white_rate": sensor.white_rate}
            pictures = [reconstruct(made.spikes, velocity=v, **by).image for v in (None, velocity)]
            ratios.append([psnr(truth, picture, 4 * SCALE) for picture in pictures])
            rests = simulate(Static(still), scale=SCALE, frames=frames, sensor=sensor, seed=n)
            moving += error(rests, np.zeros(2), None) * frames / 2 > _MOVES
        one, chosen = (f"{np.median(each):.3f}, {max(each):.3f}" for each in (fits, taken))
        found, true = np.mean(ratios, axis=0)
        print(
            f"| {light} | {frames} | {speed:g} | {one} | {chosen} | {found:.2f} | {true:.2f} | {moving} of 6 |",
            flush=True,
        )


if __name__ == "__main__":
    main()
