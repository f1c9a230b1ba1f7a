"""How often gains are found where nothing moves, with and without a fixed pattern, and what that does to a picture.

    python -m benchmarks.gains_at_rest --pictures ../shared/data/train [--parts 2] [--solve 12]

Parts of pictures that the network was not trained on (those that `learned.training.gain` keeps from this folder, and
scikit-image's own as well) are recorded at rest by sensors of 60×60 and 120×120 pixels, at ×1, ×2 and ×4, by day and in
dim light, with gains that spread by nothing, 2 % and 5 %. A line a scale: in how many parts gains were found, and how
much of the variance of ln g was left, over all parts (1 if none were found); without a pattern, the largest spread that
was found. For up to so many of the parts of 60×60 pixels by day in which some were found: dB gained by
`reconstruct(gain="auto")` over `gain=None`, mean and least.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from skimage import color, data

from learned.training.gain import kept_out
from learned.training.ridge import pictures
from scsr_opt import reconstruct
from scsr_opt.calibration import gain_at_rest
from scsr_opt.camera import Sensor, Simulation, simulate
from scsr_opt.camera.scenes import Static
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.errors import InputError

SIZES, SCALES, SPREADS = (60, 120), (1, 2, 4), (0.0, 0.02, 0.05)
LIGHTS = ((0.6, 1000.0), (0.1, 25.0))
"""Spikes per frame of white, and photons per spike."""
_STILLS = (
    "astronaut", "brick", "camera", "chelsea", "clock", "coffee", "coins", "grass", "gravel", "immunohistochemistry",
    "moon", "page", "rocket", "text",
)  # fmt: skip
_LIT = 0.05


class Part(NamedTuple):
    """A recording at rest, the gains found in it, and its sensor pixels that show a gain."""

    made: Simulation
    found: Float[np.ndarray, "h w"]
    size: int
    by_day: bool

    @property
    def errors(self) -> tuple[float, float]:
        """Variance of ln g, and of what is left of it, where it is light enough."""
        lit = self.made.spikes.mean(0) > _LIT * self.made.sensor.white_rate
        if not lit.any():
            return 0.0, 0.0
        truth = np.log(self.made.gain[lit])
        return float(truth.var()), float((truth - np.log(self.found[lit])).var())


def stills() -> Iterator[Float[np.ndarray, "H W"]]:
    """scikit-image's own pictures, grey, white 1."""
    for name in _STILLS:
        picture = getattr(data, name)()
        picture = color.rgb2gray(picture) if picture.ndim == 3 else picture / 255
        yield picture


def parts(found: list[np.ndarray], scale: int, spread: float, number: int, seed: int) -> Iterator[Part]:
    """So many random parts of each picture that is large enough, for each size and light."""
    generator = np.random.default_rng(seed)
    for picture in found:
        for size in SIZES:
            side = size * scale
            if min(picture.shape) < side:
                continue
            for _ in range(number):
                row, column = (generator.integers(length - side + 1) for length in picture.shape)
                scene = Static(picture[row : row + side, column : column + side])
                for white_rate, photons in LIGHTS:
                    sensor = Sensor(white_rate, photons, fixed_pattern=spread)
                    made = simulate(scene, scale=scale, sensor=sensor, seed=int(generator.integers(2**31)))
                    gains = gain_at_rest(made.spikes, white_rate=white_rate)
                    yield Part(made, gains, size, white_rate == LIGHTS[0][0])


def gained(part: Part, scale: int) -> float:
    """dB by which the default is better than `gain=None`."""
    truth = part.made.truth(50.0)
    both = (reconstruct(part.made.spikes, scale=scale, key=50, gain=gain) for gain in (None, "auto"))
    without, default = (psnr(truth, solution.image, 4 * scale) for solution in both)
    return default - without


def row(found: list[np.ndarray], scale: int, spread: float, number: int, solve: int) -> str:
    """A line of the table."""
    all_parts = list(parts(found, scale, spread, number, seed=scale))
    hit = [part for part in all_parts if part.found.std() > 0]
    variance, left = np.sum([part.errors for part in all_parts], axis=0)
    share = f"{left / variance:.2f}" if spread else "–"
    largest = "–" if spread else f"{max((part.found.std() for part in hit), default=0):.3f}"
    solved = [gained(part, scale) for part in hit if part.size == SIZES[0] and part.by_day][:solve]
    change = f"{np.mean(solved):+.2f} ({min(solved):+.2f}; {len(solved)})" if solved else "–"
    return f"| ×{scale}, {100 * spread:.0f} % | {len(hit)} of {len(all_parts)} | {share} | {largest} | {change} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, required=True)
    parser.add_argument("--parts", type=int, default=2, help="of each picture, size and light")
    parser.add_argument("--solve", type=int, default=12, help="pictures solved for in each line")
    given = parser.parse_args()
    try:
        found = [*kept_out(pictures(given.pictures))[1], *stills()]
    except InputError as error:
        parser.error(str(error))
    print("| scale, gains spread by | found in | variance left | most found | dB gained (least; number) |")
    print("|---|--:|--:|--:|--:|")
    for spread in SPREADS:
        for scale in SCALES:
            print(row(found, scale, spread, given.parts, given.solve), flush=True)


if __name__ == "__main__":
    main()
