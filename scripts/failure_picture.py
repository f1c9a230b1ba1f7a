"""Makes the picture of a failure in the README: python scripts/failure_picture.py docs/failure.png

Half of the light is a reflection, as in a window, that moves the other way. One motion at each place is what `Motion`
has, so no motion explains both halves.
"""

import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float

from comparison import write_comparison
from scsr_opt import reconstruct
from scsr_opt.camera import Recording, Sensor, simulate, tfp
from scsr_opt.camera.scenes import Scene, Translation
from scsr_opt.report import bicubic

SCALE, FRAMES, KEY = 4, 101, 50


class Reflection(Scene):
    """The mean of two scenes: what lies behind a window, and what it reflects."""

    def __init__(self, behind: Scene, reflected: Scene):
        self.behind, self.reflected = behind, reflected
        self.size, self.key = behind.size, behind.key

    def frame(self, t: float | int) -> Float[np.ndarray, "H W"]:
        return (self.behind.frame(t) + self.reflected.frame(t)) / 2

    def velocity(self, t: float | int) -> Float[np.ndarray, "2 H W"]:
        return self.behind.velocity(t)


def main(target: Path) -> None:
    from skimage import data

    street = Translation(data.camera()[64:320, 100:420], (0.12, 0.56), key=KEY)
    room = Translation(data.coffee()[60:316, 140:460], (-0.24, -0.6), key=KEY)
    scene = Reflection(street, room)
    made = simulate(scene, scale=SCALE, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=1)
    recording = Recording.from_array(made.spikes, white_rate=made.white_rate, name="reflection")
    solution = reconstruct(recording, scale=SCALE, key=KEY)
    truth = made.truth(float(KEY))
    columns = {"Playback, enlarged": bicubic(tfp(recording, KEY), SCALE), "Reconstruction": solution.image}
    write_comparison(target, columns, truth, scale=SCALE)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
