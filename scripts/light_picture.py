"""Makes the picture of flickering lamps in docs/light.md: python scripts/light_picture.py docs/light.png

Two lamps of 100 Hz, a quarter of a cycle apart, each light half of what the camera sees, while the scene passes.
"""

import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float

from comparison import write_comparison
from scsr_opt import reconstruct
from scsr_opt.camera import Recording, Sensor, simulate
from scsr_opt.camera.recording import READOUT_RATE
from scsr_opt.camera.scenes import Scene, Translation

SCALE, FRAMES, KEY = 2, 401, 200
HERTZ, SWING = 100, 0.5


class TwoLamps(Scene):
    """A scene under a lamp to the left and one to the right."""

    def __init__(self, scene: Scene):
        self.scene = scene
        self.size, self.key, self.span = scene.size, scene.key, scene.span

    def frame(self, t: float | int) -> Float[np.ndarray, "H W"]:
        phases = 2 * np.pi * HERTZ * t / READOUT_RATE + np.array([0, np.pi / 2])
        return self.scene.frame(t) * np.repeat(1 + SWING * np.sin(phases), self.size[1] // 2)

    def velocity(self, t: float | int) -> Float[np.ndarray, "2 H W"]:
        return self.scene.velocity(t)


def main(target: Path) -> None:
    from skimage import data

    street = Translation(0.6 * data.camera()[80:272, 150:406] / 255, (0.05, 0.2), key=KEY)
    made = simulate(TwoLamps(street), scale=SCALE, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=1)
    recording = Recording.from_array(made.spikes, white_rate=made.white_rate, name="lamps")
    columns = {
        f'light="{light}"': reconstruct(recording, scale=SCALE, key=KEY, light=light).image
        for light in ("constant", "mean")
    }
    truth = street.frame(KEY)
    write_comparison(target, columns, truth, scale=SCALE)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
