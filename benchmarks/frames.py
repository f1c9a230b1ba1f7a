"""Accuracy by the number of frames that are used: more of them must not make a picture worse.

    python -m benchmarks.frames FOLDER [--frames 41 61 101 161 301] [--scale 1]

FOLDER holds recordings of video with the true picture of their key frame (`NAME_400x250_keyK.dat`, rows from the bottom
up, beside `NAME_keyK_groundtruth.png`). A row gives the PSNR of each number of frames against the true picture, whose
white is fitted: files of this kind do not say what it is.
"""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from skimage.io import imread

from scsr_opt import reconstruct
from scsr_opt.camera.formats import read_recording
from scsr_opt.camera.recording import Recording

_NAME = re.compile(r"(?P<name>.+)_\d+x\d+_key(?P<key>\d+)")


def recordings(folder: Path) -> Iterator[tuple[str, Recording, int, Float[np.ndarray, "h w"]]]:
    """Name, recording, key frame and true picture of each recording that has one."""
    for file in sorted(folder.glob("*.dat")):
        found = _NAME.fullmatch(file.stem)
        truth = None if found is None else folder / f"{found['name']}_key{found['key']}_groundtruth.png"
        if found is not None and truth is not None and truth.exists():
            yield found["name"], read_recording(file), int(found["key"]), imread(truth) / 255.0


def psnr_of_fit(image: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"]) -> float:
    """PSNR, dB, of the picture times the number that brings it nearest to the truth."""
    fitted = image * (np.vdot(image, truth) / max(float(np.vdot(image, image)), 1e-12))
    return float(-10 * np.log10(np.mean((fitted - truth) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, nargs="+", default=[41, 61, 101, 161, 301])
    options = parser.parse_args()
    print("| recording | " + " | ".join(map(str, options.frames)) + " |")
    print("|---|" + "--:|" * len(options.frames))
    for name, recording, key, truth in recordings(options.folder):
        found = [
            psnr_of_fit(reconstruct(recording, scale=1, key=key, frames=frames).image, truth)
            for frames in options.frames
        ]
        print(f"| {name} | " + " | ".join(f"{of:.2f}" for of in found) + " |", flush=True)


if __name__ == "__main__":
    main()
