"""What each part of SpikeSR-Net is worth: the ablations of the paper's Table 2, at `small` size.

    python -m benchmarks.ablations [--scale 2] [--steps 1500] [--pictures FOLDER] [--out build/ablations]

The whole network and four from which a part is left out are trained on the same examples for as many steps, one after
the other, by the configuration small-x2 or small-x4. Each run can be killed and is gone on with. The table gives the
means over simulated recordings by day of pictures that none of them has seen (`learned.training.validation`, eight of
each kind), beside what the paper reports for its networks, on recordings of its own.
"""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from benchmarks.choosing_page import table
from learned.networks.spikesr import parameter_count
from learned.training.configs import TrainingConfig
from learned.training.loop import train
from learned.training.registry import trainable
from learned.training.validation import KINDS, playback, scores, validation_set
from scsr_opt.cli.options import progress
from scsr_opt.errors import InputError

# What is left out (`SpikeSRConfig`), and the PSNR in dB and structural similarity of the paper's Table 2 (REDS, ×2).
VARIANTS: dict[str, tuple[dict[str, bool], tuple[float, float]]] = {
    "all parts": ({}, (30.79, 0.8883)),
    "without pixel-adaptive spike encoder": ({"pase": False}, (29.48, 0.8585)),
    "without gradient descent module": ({"gradient": False}, (29.71, 0.8643)),
    "without motion alignment": ({"alignment": False}, (30.00, 0.8744)),
    "without proximal mapping module": ({"proximal": False}, (29.83, 0.8663)),
}
EACH = 8
"""Recordings of a kind that a network is judged by."""


def variant(name: str, scale: int, **changes: Any) -> TrainingConfig:
    """How the network of this name is trained."""
    config = TrainingConfig.read(f"small-x{scale}")
    return config.changed(network={**config.network, **VARIANTS[name][0]}, **changes)


def judged(config: TrainingConfig, model: Any) -> dict[str, float]:
    """Its scores."""
    task = trainable(config.model, config.scale, config.network)
    picture = eqx.filter_jit(task.picture)
    cases = validation_set(config.scale, config.frames, config.patch, each=EACH)
    images = [np.asarray(picture(model, jnp.asarray(case.spikes), jnp.asarray(case.white_rate))) for _, case in cases]
    return scores(cases, images, config.scale)


def line(name: str, found: dict[str, float], *more: str) -> list[str]:
    """A row of the table."""
    kinds = [f"{found[f'psnr_{kind}']:.2f}" for kind in KINDS]
    return [name, *more, f"{found['psnr']:.2f} / {found['ssim']:.4f}", *kinds]


def rows(configs: dict[str, TrainingConfig], out: Path) -> list[list[str]]:
    """Trains the networks, or goes on with that, and gives the lines of the table."""
    lines = []
    for name, config in configs.items():
        trained = train(config, out / name.replace(" ", "-"), progress=progress(False))
        if not trained.result.good:
            raise InputError(f"{name}: {trained.result.sentence}")
        psnr, ssim = VARIANTS[name][1]
        size = f"{parameter_count(trained.model):,}"
        lines.append(line(name, judged(config, trained.model), f"{psnr:.2f} / {ssim:.4f}", size))
        print(" | ".join(lines[-1]), flush=True)
    some = next(iter(configs.values()))
    cases = validation_set(some.scale, some.frames, some.patch, each=EACH)
    enlarged = scores(cases, [playback(case, some.scale) for _, case in cases], some.scale)
    return [*lines, line("playback, enlarged", enlarged, "–", "–")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=int, default=2, choices=(2, 4))
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--pictures", help="folder of pictures to train on; those of scikit-image if not given")
    parser.add_argument("--out", type=Path, default=Path("build/ablations"))
    chosen = parser.parse_args()
    try:
        make = partial(variant, scale=chosen.scale, steps=chosen.steps, pictures=chosen.pictures, save_every=50)
        lines = rows({name: make(name) for name in VARIANTS}, chosen.out)
    except InputError as error:
        parser.error(str(error))
    head = ["small", "paper, dB / SSIM", "parameters", "dB / SSIM", *KINDS]
    print("\n" + table(head, lines))


if __name__ == "__main__":
    main()
