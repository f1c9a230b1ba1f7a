"""How well pixels that were masked are predicted, on a recording without ground truth: `python -m benchmarks.masked`.

A part of the sensor's pixels, drawn at random, is declared bad, so that no method uses them. The picture at the key
frame, averaged down to the sensor, predicts what they saw; the interval between spikes that holds the key frame tells
(`tfi`). The error is given for all masked pixels, and apart for those where the scene moves (faster than a tenth of a
sensor pixel in ten frames, by the estimate from all pixels) and where it is at rest. The last column says by how much a
method's mean square error is above that of `reconstruct`, pixel by pixel of the same masks, with its standard error.
"""

import argparse
import sys

import numpy as np

from scsr_opt import reconstruct
from scsr_opt.baselines import BASELINES
from scsr_opt.camera import Recording, read_recording
from scsr_opt.camera.playback import tfi
from scsr_opt.motion import estimate_motion


def main(arguments: list[str] | None = None) -> None:
    """Prints a row for each method: root-mean-square error, all masked pixels, moving, at rest, and how far behind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file")
    parser.add_argument("--size", default="400x250", help="WIDTHxHEIGHT of a flat file")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--share", type=float, default=0.05)
    parser.add_argument("--masks", type=int, default=1, help="so many, drawn one after the other")
    chosen = parser.parse_args(arguments)
    width, height = (int(v) for v in chosen.size.split("x"))
    whole = read_recording(chosen.file, size=(width, height))
    key, half = whole.frames // 2, 50
    spikes = whole.window(key - half, key + half + 1)
    seen = np.asarray(tfi(spikes, half, white_rate=whole.white_rate))
    moving = estimate_motion(spikes, key=half, white_rate=whole.white_rate).speed > 0.01
    masks = [np.random.default_rng(seed).random(seen.shape) < chosen.share for seed in range(chosen.masks)]
    methods = {"reconstruct": reconstruct, **BASELINES}
    print("| method | all | moving | at rest | mean square above |\n|---|---|---|---|---|")
    ours = None
    for name, method in methods.items():
        squares = []
        for masked in masks:
            recording = Recording.from_array(spikes, white_rate=whole.white_rate, bad_pixels=masked)
            result = method(recording, scale=chosen.scale, key=half, white_rate=whole.white_rate)
            image = np.asarray(getattr(result, "image", result))
            sensor = image.reshape(seen.shape[0], chosen.scale, seen.shape[1], chosen.scale).mean((1, 3))
            squares.append((sensor - seen) ** 2)

        def over(part: np.ndarray, squares: list[np.ndarray] = squares) -> np.ndarray:
            """The squares of the masked pixels in a part of the picture."""
            return np.concatenate([square[mask & part] for square, mask in zip(squares, masks, strict=True)])

        everywhere = over(np.ones_like(moving))
        ours = everywhere if ours is None else ours
        above = everywhere - ours
        behind = (
            f"{100 * above.mean() / ours.mean():.1f} % ± {100 * above.std() / len(above) ** 0.5 / ours.mean():.1f} %"
        )
        roots = (f"{np.sqrt(part.mean()):.4f}" for part in (everywhere, over(moving), over(~moving)))
        print("| " + " | ".join([name, *roots, behind]) + " |")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
