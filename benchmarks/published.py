"""The models of `learned.zoo` at scale 1 on recordings of REDS video, beside published figures.

    python -m benchmarks.published FOLDER [--models fista-huber,ridge] [--json FILE]

FOLDER is as for `benchmarks.frames`. A row gives the PSNR and SSIM of each recording's key frame and their mean. The
picture is clipped to 0 … 1 after the one factor that brings it nearest to the truth, as files do not say what is white.

Published are the means of Spike-Zoo's table over all recordings of its set, by networks that were trained on videos of
REDS, with its own white; ours are of the recordings in FOLDER, by priors and networks that saw no video of REDS. So a
difference of a few tenths of a decibel says nothing, and SSIM (of 8-bit pictures there) even less.
"""

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from benchmarks.frames import recordings
from learned.zoo import model, names

PUBLISHED = {"bsf": 39.58, "spk2imgnet": 39.15, "wgse": 39.04, "base (0.18 M parameters)": 36.59}
"""PSNR, dB, by network: the table of github.com/chenkang455/Spike-Zoo."""


def fitted(image: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The picture times the number that brings it nearest to the truth, clipped to 0 … 1."""
    factor = np.vdot(image, truth) / max(float(np.vdot(image, image)), 1e-12)
    return np.clip(image * factor, 0, 1)


def rows(folder: Path, models: list[str]) -> Iterator[dict[str, Any]]:
    """A row for each model and recording."""
    for name in models:
        chosen = model(name, 1)
        for recording, spikes, key, truth in recordings(folder):
            began = time.perf_counter()
            image = fitted(chosen(spikes, scale=1, key=key).image, truth)
            yield {
                "model": name,
                "recording": recording,
                "psnr": float(peak_signal_noise_ratio(truth, image, data_range=1)),
                "ssim": float(np.asarray(structural_similarity(truth, image, data_range=1))),
                "seconds": time.perf_counter() - began,
            }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--models", help="names with commas between; all that work at scale 1 by default")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    models = names(1) if options.models is None else options.models.split(",")
    found = []
    seen = [name for name, *_ in recordings(options.folder)]
    print("| model | " + " | ".join(seen) + " | mean |")
    print("|---|" + "--:|" * (len(seen) + 1))
    for row in rows(options.folder, models):
        found.append(row)
        own = [one for one in found if one["model"] == row["model"]]
        if len(own) == len(seen):
            each = " | ".join(f"{one['psnr']:.2f} / {one['ssim']:.3f}" for one in own)
            means = [np.mean([one[of] for one in own]) for of in ("psnr", "ssim")]
            print(f"| `{row['model']}` | {each} | {means[0]:.2f} / {means[1]:.3f} |", flush=True)
    for name, psnr in PUBLISHED.items():
        print(f"| {name}, published | " + " | ".join("–" * len(seen)) + f" | {psnr:.2f} |")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
