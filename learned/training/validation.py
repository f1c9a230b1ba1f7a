"""Quality of a network while it trains: fixed recordings of pictures it does not train on, curves, samples.

The scenes are of the kinds that reconstructions are judged on, in daylight (white rate 0.6, 1000 photons): standing
still, translation, affine motion, an object and a turning disc before a background. They are the same for every run of
a scale and a patch size, so that runs compare.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from learned.training.data import HELD_OUT_SAMPLES, Example, Examples, Pictures
from scsr_opt._files import whole_file
from scsr_opt.camera.playback import tfp
from scsr_opt.report.figures import bicubic
from scsr_opt.report.pictures import write_picture

KINDS = ("static", "translation", "affine", "object", "disc")
BORDER = 8
"""Sensor pixels at each side that PSNR and SSIM leave out: there the scene has left the sensor for a time."""


def validation_set(
    scale: int, frames: int, patch: int, *, each: int = 2, seed: int = 2023
) -> list[tuple[str, Example]]:
    """(kind, example) of every recording, `each` of a kind. The seed is not one that training runs use."""
    pictures = Pictures.samples(HELD_OUT_SAMPLES)
    sets = {
        kind: Examples(scale, frames, patch, seed, scenes=(kind,), lights=("day",), pictures=pictures, varied=False)
        for kind in KINDS
    }
    return [(kind, examples[n]) for kind, examples in sets.items() for n in range(each)]


def border_of(side: int, scale: int) -> int:
    """Pixels of a picture that scores leave out at each side, a quarter of a sensor of `side` pixels at most."""
    return min(BORDER, side // 4) * scale


def quality(truth: Float[Any, "H W"], image: Float[Any, "H W"], border: int) -> tuple[float, float]:
    """PSNR in dB and structural similarity of intensities cut to 0..1, `border` pixels left out on each side."""
    likeness: Any = structural_similarity(_inner(truth, border), _inner(image, border), data_range=1.0)
    return psnr(truth, image, border), float(likeness)


def psnr(truth: Float[Any, "H W"], image: Float[Any, "H W"], border: int) -> float:
    """The first of `quality` alone, which takes a fraction of the time."""
    with np.errstate(divide="ignore"):  # that of a picture that is the truth is infinite
        return float(peak_signal_noise_ratio(_inner(truth, border), _inner(image, border), data_range=1.0))


def _inner(image: Float[Any, "H W"], border: int) -> Float[np.ndarray, "h w"]:
    inner = slice(border, -border or None)
    return np.clip(np.asarray(image, np.float64)[inner, inner], 0, 1)


def playback(example: Example, scale: int) -> Float[np.ndarray, "H W"]:
    """Reference to compare with: TFP over 21 frames, enlarged by bicubic interpolation."""
    spikes = np.asarray(example.spikes)
    key = spikes.shape[0] // 2
    return bicubic(tfp(spikes, key, white_rate=float(example.white_rate)), scale)


def scores(cases: Sequence[tuple[str, Example]], images: Sequence[Float[Any, "H W"]], scale: int) -> dict[str, float]:
    """Means over the recordings of each kind and over all: `psnr`, `ssim`, `psnr_static`, ….

    A border is left out (`border_of`).
    """
    border = border_of(np.asarray(cases[0][1].spikes).shape[1], scale)
    measured = [quality(case.truth, image, border) for (_, case), image in zip(cases, images, strict=True)]
    answer = {
        "psnr": float(np.mean([psnr for psnr, _ in measured])),
        "ssim": float(np.mean([ssim for _, ssim in measured])),
    }
    for kind in dict.fromkeys(kind for kind, _ in cases):
        mine = [psnr for (other, _), (psnr, _) in zip(cases, measured, strict=True) if other == kind]
        answer[f"psnr_{kind}"] = float(np.mean(mine))
    return answer


def write_samples(
    path: Path, cases: Sequence[tuple[str, Example]], images: Sequence[Float[Any, "H W"]], scale: int
) -> None:
    """One picture: a row per kind of scene (its first recording); playback, the network's picture, the truth."""
    shown = {kind: n for n, (kind, _) in reversed(list(enumerate(cases)))}
    gap = 4
    rows = []
    for kind in KINDS:
        if kind in shown:
            case, image = cases[shown[kind]][1], np.asarray(images[shown[kind]], np.float32)
            tiles = (playback(case, scale), image, np.asarray(case.truth))
            rows.append(np.concatenate([np.pad(tile, gap // 2, constant_values=1.0) for tile in tiles], axis=1))
    # A network that has gone astray is shown as well: black where its picture has no value.
    write_picture(path, np.nan_to_num(np.concatenate(rows), posinf=1.0, neginf=0.0), gamma=2.2)


def write_table(path: Path, columns: Sequence[str], rows: Sequence[Sequence[float | int]]) -> None:
    """A CSV file."""
    with whole_file(path) as temporary:
        lines = [",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def draw_curves(path: Path, losses: Float[np.ndarray, " n"], validated: Sequence[dict[str, Any]], base: float) -> None:
    """The loss of every step with its running median, and the PSNR on the validation set against that of playback."""
    drawn = Figure(figsize=(10, 3.6), dpi=120, layout="constrained")
    left, right = drawn.subplots(1, 2)
    steps = np.arange(1, losses.size + 1)
    left.plot(steps, losses, color="#cccccc", linewidth=0.6)
    width = max(1, losses.size // 50)
    middles = [(n + (width + 1) / 2, losses[n : n + width]) for n in range(0, losses.size, width)]
    seen = [(n, float(np.median(part[np.isfinite(part)]))) for n, part in middles if np.isfinite(part).any()]
    left.plot(*_columns(seen), color="#222222", linewidth=1.2)
    if seen and min(loss for _, loss in seen) > 0:  # the logarithm of an error is a loss, too
        left.set_yscale("log")
    left.set(xlabel="step", ylabel="loss")
    right.axhline(base, color="#777777", linewidth=0.8, linestyle="--", label="playback, bicubic")
    right.plot(
        *_columns([(row["step"], row["psnr"]) for row in validated]), color="#c8102e", marker=".", label="network"
    )
    right.set(xlabel="step", ylabel="PSNR, dB")
    right.legend(frameon=False)
    with whole_file(path) as temporary:
        drawn.savefig(temporary)


def _columns(pairs: Sequence[tuple[float | int, float]]) -> tuple[list[float | int], list[float]]:
    return [x for x, _ in pairs], [y for _, y in pairs]
