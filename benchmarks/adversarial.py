"""`quality="best"` on recordings that no network of pictures was trained for: it must not invent.

    python -m benchmarks.adversarial [--number 200] [--scales 2 4]

Recordings of noise, text, checkerboards, gratings, flat, saturated and dark scenes, with rows of dead pixels, and with
a wrong white rate; at rest and moving. A row gives, for a kind of recording, by how much "best" is better than "fast"
(PSNR against the true picture, dB: the least and the mean), and the misfit of its samples, f(X), over that of the
solution that the network restored: what the samples contradict would raise it above 1.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from scsr_opt import Solution, reconstruct
from scsr_opt.camera import Recording, Sensor, Static, Translation, simulate
from scsr_opt.camera.scenes import Scene

SHAPE, FRAMES = (40, 48), 101
KINDS = ("noise", "text", "checkerboard", "grating", "flat", "saturated", "dark", "dead rows", "wrong white", "photo")


class Case(NamedTuple):
    """A recording of a `kind`, and its true picture (H, W); None where spikes are noise and there is none."""

    kind: str
    recording: Recording
    truth: Float[np.ndarray, "H W"] | None


class Finding(NamedTuple):
    """`gain`: PSNR of "best" less that of "fast", dB, NaN without a truth; `misfit`: f(X) of the picture over that of
    the solution that the network restored."""

    kind: str
    gain: float
    misfit: float


def cases(number: int, scale: int, seed: int = 0) -> Iterator[Case]:
    """`number` recordings, all kinds in turn."""
    for k in range(number):
        yield case(KINDS[k % len(KINDS)], scale, np.random.default_rng([seed, scale, k]))


def case(kind: str, scale: int, rng: np.random.Generator) -> Case:
    """A recording of a kind of `KINDS`, drawn by chance."""
    if kind == "noise":
        spikes = rng.random((FRAMES, *SHAPE)) < rng.uniform(0.02, 0.7)
        return Case(kind, Recording.from_array(spikes.astype(np.uint8), white_rate=0.6), None)
    picture = _picture(kind, scale, rng)
    scene: Scene = Static(picture, key=FRAMES // 2)
    if rng.random() < 0.7:
        angle, speed = rng.uniform(0, 2 * np.pi), rng.uniform(0.02, 0.25) * scale
        scene = Translation(picture, (speed * np.sin(angle), speed * np.cos(angle)), key=FRAMES // 2)
    # At intensity 1 a saturated pixel fires in every frame.
    sensor = Sensor(1.0 if kind == "saturated" else 0.6, 25.0 if kind == "dark" else 1000.0)
    recorded = simulate(scene, scale=scale, frames=FRAMES, sensor=sensor, seed=int(rng.integers(2**31)))
    spikes, truth, white_rate = recorded.spikes, recorded.truth(FRAMES // 2), recorded.white_rate
    if kind == "dead rows":
        spikes = _with_dead_rows(spikes, rng)
    if kind == "wrong white":  # the scene is what it is; the user's word for its white is not
        factor = rng.choice([0.5, 0.7, 1.5])
        white_rate, truth = white_rate * factor, truth / factor
    return Case(kind, Recording.from_array(spikes, white_rate=white_rate), truth)


def _picture(kind: str, scale: int, rng: np.random.Generator) -> Float[np.ndarray, "H W"]:
    height, width = (scale * n for n in SHAPE)
    row, column = np.mgrid[:height, :width]
    low, high = sorted(rng.uniform(0.05, 0.95, 2))
    if kind == "text":
        letters = rng.random((height // (2 * scale), width // scale)) < 0.4
        strokes = letters.repeat(2 * scale, 0).repeat(scale, 1)
        return np.where(np.pad(strokes, [(0, height - len(strokes)), (0, width - strokes.shape[1])]), low, high)
    if kind == "checkerboard":
        side = int(rng.integers(1, 4 * scale))
        return np.where((row // side + column // side) % 2, low, high)
    if kind == "grating":
        period, angle = rng.uniform(1.5, 6) * scale, rng.uniform(0, np.pi)
        along = row * np.sin(angle) + column * np.cos(angle)
        return (low + high) / 2 + (high - low) / 2 * np.sin(2 * np.pi * along / period)
    if kind == "flat":
        return np.full((height, width), rng.uniform(0, 1))
    from skimage import data

    grey = data.camera() / 255.0
    top, left = (int(rng.integers(n - most)) for n, most in zip(grey.shape, (height, width), strict=True))
    part = grey[top : top + height, left : left + width]
    return {"saturated": np.clip(2.5 * part, 0, 1), "dark": 0.08 * part}.get(kind, part)


def _with_dead_rows(spikes: UInt8[np.ndarray, "T h w"], rng: np.random.Generator) -> UInt8[np.ndarray, "T h w"]:
    dead = spikes.copy()
    dead[:, rng.choice(SHAPE[0], 3, replace=False)] = 0
    return dead


def compared(one: Case, scale: int) -> Finding:
    """Both qualities on a recording."""
    fast = reconstruct(one.recording, scale=scale)
    best = reconstruct(one.recording, scale=scale, quality="best")
    gain = float("nan") if one.truth is None else _psnr(best, one.truth) - _psnr(fast, one.truth)
    return Finding(one.kind, gain, 1.0 if best.diagnostics.misfit_ratio is None else best.diagnostics.misfit_ratio)


def _psnr(found: Solution, truth: Float[np.ndarray, "H W"]) -> float:
    """PSNR, dB, two sensor pixels of the border left out."""
    border = 2 * found.scale
    inner = slice(border, -border)
    return float(-10 * np.log10(np.mean((found.image - truth)[inner, inner] ** 2) + 1e-8))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=200, help="recordings at each scale")
    parser.add_argument("--scales", type=int, nargs="+", default=[2, 4])
    options = parser.parse_args()
    print("| scale | recordings | number | gain, dB: least | mean | misfit: mean | most |")
    print("|---|---|--:|--:|--:|--:|--:|")
    for scale in options.scales:
        found: dict[str, list[Finding]] = defaultdict(list)
        for one in cases(options.number, scale):
            found[one.kind].append(compared(one, scale))
        for kind, several in found.items():
            gains, misfits = (np.array([getattr(each, name) for each in several]) for name in ("gain", "misfit"))
            print(
                f"| {scale} | {kind} | {len(several)} | {gains.min():+.2f} | {gains.mean():+.2f} | "
                f"{misfits.mean():.3f} | {misfits.max():.3f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
