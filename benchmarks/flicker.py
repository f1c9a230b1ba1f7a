"""Accuracy where lamps flicker: ten scenes that move, under light that swings by 0.1 to 0.5.

    python -m benchmarks.flicker FOLDER [--depths 0.1 0.2 0.5] [--lamps 1 2] [--scenes pan turn] [--scale 2]

FOLDER holds pictures (PNG), of which six are used. Each scene (pans, turns, objects; of texture and of stills) is
recorded for 400 frames under a lamp of 100 Hz, read out 40,000 times a second, at two phases; with two lamps, the other
one is a quarter of a cycle behind and lights the right half of the sensor. A row gives the speed that was found,
relative to the true one (median of the moving pixels, along the true direction), and the PSNR against the scene at the
mean light; the same of the scene without flicker, of as many photons; and what was found of the light.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_erosion, gaussian_filter

from scsr_opt import Solution, reconstruct
from scsr_opt.camera import Affine, MovingObject, Scene, Simulation, Translation, simulate
from scsr_opt.camera.recording import READOUT_RATE

_SIZE = (96, 128)
_FRAMES, _KEY, _CLIP = 400, 200, 101
_HERTZ = 100.0
_BORDER = 12
"""High-resolution pixels along the border that PSNR leaves out: what has come into view from there is seen for a part
of the clip only."""


class Lit(Scene):
    """A scene under light that changes: `depth` of its swing, and `phases` of one lamp, or of two for the halves."""

    def __init__(self, scene: Scene, depth: float, phases: tuple[float, ...]):
        self.scene, self.depth, self.phases = scene, depth, phases
        self.size, self.key, self.span = scene.size, scene.key, scene.span

    def light(self, t: float | int) -> Float[np.ndarray, "1 W"]:
        """Relative light of each column."""
        now = [1 + self.depth * np.sin(2 * np.pi * _HERTZ * t / READOUT_RATE + phase) for phase in self.phases]
        return np.repeat(now, self.size[1] // len(now))[None]

    def frame(self, t: float | int) -> Float[np.ndarray, "H W"]:
        return self.scene.frame(t) * self.light(t)

    def velocity(self, t: float | int) -> Float[np.ndarray, "2 H W"]:
        return self.scene.velocity(t)


class Dimmed(Scene):
    """The scene of a `Lit` one without flicker, under its mean light over the clip."""

    def __init__(self, lit: Lit):
        begin = _KEY - _CLIP // 2
        self.scene, self.mean = lit.scene, np.mean([lit.light(t) for t in range(begin, begin + _CLIP)], axis=0)
        self.size, self.key, self.span = lit.size, lit.key, lit.span

    def frame(self, t: float | int) -> Float[np.ndarray, "H W"]:
        return self.scene.frame(t) * self.mean

    def velocity(self, t: float | int) -> Float[np.ndarray, "2 H W"]:
        return self.scene.velocity(t)


def texture(size: tuple[int, int], seed: int, sigma: float = 3.0) -> Float[np.ndarray, "H W"]:
    """Gaussian noise smoothed by `sigma` pixels, of 0.2 to 0.8."""
    grey = gaussian_filter(np.random.default_rng(seed).standard_normal(size), sigma, mode="wrap")
    return 0.2 + 0.6 * (grey - grey.min()) / np.ptp(grey)


def scenes(folder: Path) -> dict[str, Scene]:
    """The ten scenes by name."""
    from skimage.io import imread

    files = sorted(folder.glob("*.png"))
    chosen = iter(files[:: max(1, len(files) // 7)])

    def still(size: tuple[int, int] = _SIZE) -> Float[np.ndarray, "H W"]:
        grey = imread(next(chosen)).astype(float) / 255
        grey = grey if grey.ndim == 2 else grey[..., :3].mean(-1)
        top, left = ((n - m) // 2 for n, m in zip(grey.shape, size, strict=True))
        return grey[top : top + size[0], left : left + size[1]]

    key = float(_KEY)
    return {
        "pan, texture": Translation(texture(_SIZE, 0), (0, 0.2), key=key),
        "pan, texture, fast": Translation(texture(_SIZE, 1), (0.28, -0.28), key=key),
        "pan, still": Translation(still(), (0.1, 0.3), key=key),
        "pan, still, fast": Translation(still(), (-0.4, 0.1), key=key),
        "turn, texture": Affine(texture(_SIZE, 2), rotation=0.002, key=key),
        "turn, still": Affine(still(), rotation=-0.0015, zoom=0.0006, drift=(0.1, 0), key=key),
        "turn, zoom, still": Affine(still(), rotation=0.0008, zoom=-0.001, drift=(0, 0.1), key=key),
        "object, texture": MovingObject(texture(_SIZE, 3), texture((56, 64), 4), (0.1, 0.3), key=key),
        "object, still": MovingObject(still(), texture((60, 70), 5), (-0.25, 0.2), key=key),
        "object, stills": MovingObject(still(), still((50, 50)), (0, -0.4), key=key),
    }


def measured(simulation: Simulation, scene: Scene, scale: int, white: Any = None) -> tuple[float, float, Solution]:
    """Speed relative to the true one, PSNR, and the solution; `white`: light of the scene's white, 1 if None."""
    solution = reconstruct(simulation.spikes, scale=scale, key=_KEY, frames=_CLIP)
    true = np.stack([of[scale // 2 :: scale, scale // 2 :: scale] for of in scene.velocity(_KEY)]) / scale
    square = (true**2).sum(0)
    moving = binary_erosion(square > 1e-4, iterations=3)
    assert solution.velocity is not None
    speed = float(np.median(((solution.velocity * true).sum(0) / np.maximum(square, 1e-9))[moving]))
    image = solution.image if white is None else solution.image / white
    error = (image - scene.frame(_KEY))[_BORDER:-_BORDER, _BORDER:-_BORDER]
    return speed, float(-10 * np.log10(np.mean(error**2))), solution


def lines(options: argparse.Namespace) -> Iterator[str]:
    """The table, line by line."""
    yield "| scene | lamps | swing | phase | speed | dB | steady: speed | dB | less by | light found |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    lost, off = [], []
    for name, scene in scenes(Path(options.folder)).items():
        if options.scenes and not any(name.startswith(one) for one in options.scenes):
            continue
        for lamps, depth, phase in [(n, a, p) for n in options.lamps for a in options.depths for p in options.phases]:
            lit = Lit(scene, depth, tuple(phase + k * np.pi / 2 for k in range(lamps)))
            steady = Dimmed(lit)
            speed, quality, solution = measured(
                simulate(lit, scale=options.scale, frames=_FRAMES, seed=1), scene, options.scale
            )
            reference = measured(
                simulate(steady, scale=options.scale, frames=_FRAMES, seed=1), scene, options.scale, steady.mean
            )
            numbers = solution.diagnostics
            found = "none" if solution.light is None else f"{numbers.light_depth:.2f}"
            found += "" if numbers.light_frequency is None else f", {numbers.light_frequency:.0f} Hz"
            found += "" if solution.light is None else f", {len(solution.light.course)}"
            lost.append(reference[1] - quality)
            off.append(abs(speed - 1))
            yield (
                f"| {name} | {lamps} | {depth:g} | {phase:.2f} | {speed:.3f} | {quality:.2f} | {reference[0]:.3f} | "
                f"{reference[1]:.2f} | {lost[-1]:.2f} | {found} |"
            )
    yield f"\nLess by {max(lost):.2f} dB at most, {np.mean(lost):.2f} in the mean; speed off by {100 * max(off):.1f} %."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder")
    parser.add_argument("--depths", type=float, nargs="+", default=[0.1, 0.2, 0.5])
    parser.add_argument("--phases", type=float, nargs="+", default=[0.0, 1.57])
    parser.add_argument("--lamps", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--scenes", nargs="+", default=[], help="beginnings of names")
    parser.add_argument("--scale", type=int, default=2)
    for line in lines(parser.parse_args()):
        print(line, flush=True)


if __name__ == "__main__":
    main()
