"""Limits of the picture of a scene: strength, motion, occlusion and noise.

    python -m benchmarks.limits SCOREBOARD [--scenes …] [--scales …] [--images 6]

SCOREBOARD is the folder of the scoreboard's scripts, whose scenes know the truth. Each recording is solved several
times, each time knowing more that a real recording does not show:

- `reconstruct`: by its defaults.
- `strength`: the motion it found, and the best of several strengths.
- `motion`: every sample lies at its true place; what is hidden in the key frame takes part all the same.
- `occlusion`: samples that are hidden in the key frame are left out, and pixels that see two surfaces at once.
- `noise-free`: and every sample is the exact mean of the light over its exposure.

All but the first at the best of the strengths, found by the answer. Prints PSNR in dB, the mean over the stills.
"""

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from scsr_opt import reconstruct
from scsr_opt.camera import Intervals
from scsr_opt.motion import Motion, estimate_motion
from scsr_opt.motion.trajectory import SPACING, Trajectory
from scsr_opt.operators.sampling import PlacedSamples, place
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.pipeline.measurement import measure
from scsr_opt.pipeline.outer_loop import MajorizeMinimize
from scsr_opt.solvers import FISTA

# Times the strength that `reconstruct` chose.
FACTORS = (2.0, 1.4, 1.0, 0.7, 0.5, 0.35, 0.18, 0.09)
COLUMNS = ("reconstruct", "strength", "motion", "occlusion", "noise-free")


def solved(placed: PlacedSamples, image: jax.Array, strength: float, scale: int) -> np.ndarray:
    method = MajorizeMinimize(
        FISTA(), default_prior(scale), jnp.asarray(strength, jnp.float32), optics=None, robust=None
    )
    return np.asarray(method(placed, image).outcome.image)


def true_path(scene: Any, scale: int, frames: int, *, occlusion: bool) -> Trajectory:
    """Places in the key frame of what each pixel sees, by the scene itself."""
    moments = np.arange(0, frames - 1 + SPACING, SPACING)
    seen = [scene.seen(t, scale) for t in moments]
    position = np.stack([(p - (scale - 1) / 2) / scale for p, _ in seen]).astype(np.float32)
    visible = np.stack([v if occlusion else np.ones_like(v) for _, v in seen]).astype(np.float32)
    return Trajectory(jnp.float32(0), jnp.asarray(position), jnp.asarray(visible))


def true_motion(scene: Any, scale: int, key: int) -> Motion:
    """The velocity at the key frame, for what depends on speed: merging, and positions along an exposure."""
    before, after = (scene.seen(key + t, scale)[0] for t in (-1, 1))
    velocity = (before - after) / (2 * scale)
    velocity[:, np.hypot(*velocity) > 1] = 0  # a pixel that sees another surface than before
    return Motion.of_velocity(velocity.astype(np.float32))


def exact(recording: Any, samples: Any, scale: int) -> np.ndarray:
    """The mean of the light over each sample's exposure."""
    frames, height, width = recording.spikes.shape
    pictures = (recording.scene.frame(t).reshape(height, scale, width, scale).mean((1, 3)) for t in range(frames))
    total = np.concatenate([np.zeros((1, height, width)), np.cumsum(list(pictures), 0)])

    def until(time: np.ndarray) -> np.ndarray:
        at = np.clip(time + 0.5, 0, frames)
        before = np.minimum(at.astype(int), frames - 1)
        below, above = (total[before + k, samples.row, samples.column] for k in (0, 1))
        return below + (at - before) * (above - below)

    duration = np.maximum(samples.stop - samples.start, 1e-6)
    return ((until(samples.stop) - until(samples.start)) / duration).astype(np.float32)


def split(quality: Any, recording: Any, scale: int) -> list[float]:
    frames, key, rate = len(recording.spikes), recording.key, recording.light.white_rate
    shape = recording.truth.shape
    solution = reconstruct(recording.spikes, scale=scale, key=key, white_rate=rate)
    image, λ = jnp.asarray(solution.image), solution.diagnostics.strength or 0.0

    def best(placed: PlacedSamples) -> float:
        return max(quality(recording.truth, solved(placed, image, λ * factor, scale), scale)[0] for factor in FACTORS)

    clip = Clip(recording.spikes, key, rate, None)
    found = measure(
        clip, estimate_motion(recording.spikes, key=key, white_rate=rate), scale=scale, sampling=Intervals()
    )
    motion = true_motion(recording.scene, scale, key)
    taken = measure(clip, motion, scale=scale, sampling=Intervals())
    samples, positions, finest = jax.tree.map(jnp.asarray, taken.padded), taken.placed.positions, taken.placed.finest

    def at_truth(*, occlusion: bool) -> PlacedSamples:
        path = true_path(recording.scene, scale, frames, occlusion=occlusion)
        return place(samples, path, scale=scale, shape=shape, positions=positions, finest=finest)

    hidden = at_truth(occlusion=True)
    clean = eqx.tree_at(lambda p: p.value, hidden, jnp.asarray(exact(recording, taken.padded, scale)))
    variants = (found.placed, at_truth(occlusion=False), hidden, clean)
    return [quality(recording.truth, solution.image, scale)[0], *(best(placed) for placed in variants)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scoreboard", type=Path)
    parser.add_argument("--scenes", nargs="+", default=["static", "translate", "affine", "object", "fan"])
    parser.add_argument("--scales", nargs="+", type=int, default=[2, 4])
    parser.add_argument("--light", default="day")
    parser.add_argument("--images", type=int, default=6)
    chosen = parser.parse_args()
    sys.path.insert(0, str(chosen.scoreboard))
    scenes, quality = importlib.import_module("scenes"), importlib.import_module("score").quality
    stills = sorted((chosen.scoreboard.parent / "data" / "eval_stills").glob("*.png"))
    print(f"| {chosen.light} | " + " | ".join(COLUMNS) + " |\n|---|" + "---|" * len(COLUMNS))
    for scale in chosen.scales:
        for kind in chosen.scenes:
            rows = [
                split(quality, scenes.make(kind, path, other, scale, chosen.light, seed=7 + n), scale)
                for n, (path, other) in enumerate(zip(stills[: chosen.images], stills[5:] + stills[:5], strict=False))
            ]
            print(f"| ×{scale} {kind} | " + " | ".join(f"{v:.2f}" for v in np.mean(rows, 0)) + " |", flush=True)


if __name__ == "__main__":
    main()
