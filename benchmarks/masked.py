"""How well pixels that were masked are predicted, on a recording without ground truth: `python -m benchmarks.masked`.

A part of the sensor's pixels, drawn at random, is declared bad, so that no method uses them. The picture at the key
frame, averaged down to the sensor, predicts what they saw; the interval between spikes that holds the key frame tells
(`tfi`). The error is given for all masked pixels, and apart for those where the scene moves (faster than a tenth of a
sensor pixel in ten frames, by the estimate from all pixels) and where it is at rest.
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
    """Prints a row for each method: root-mean-square error, all masked pixels, moving, at rest."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file")
    parser.add_argument("--size", default="400x250", help="WIDTHxHEIGHT of a flat file")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--share", type=float, default=0.05)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    width, height = (int(v) for v in chosen.size.split("x"))
    whole = read_recording(chosen.file, size=(width, height))
    key, half = whole.frames // 2, 50
    spikes = whole.window(key - half, key + half + 1)
    seen = np.asarray(tfi(spikes, half, white_rate=whole.white_rate))
    moving = estimate_motion(spikes, key=half, white_rate=whole.white_rate).speed > 0.01
    masked = np.random.default_rng(chosen.seed).random(seen.shape) < chosen.share
    recording = Recording.from_array(spikes, white_rate=whole.white_rate, bad_pixels=masked)
    methods = {"reconstruct": reconstruct, **BASELINES}
    print("| method | all | moving | at rest |\n|---|---|---|---|")
    for name, method in methods.items():
        result = method(recording, scale=chosen.scale, key=half, white_rate=whole.white_rate)
        image = np.asarray(getattr(result, "image", result))
        sensor = image.reshape(seen.shape[0], chosen.scale, seen.shape[1], chosen.scale).mean((1, 3))
        error = (sensor - seen) ** 2
        parts = (masked, masked & moving, masked & ~moving)
        print("| " + " | ".join([name, *(f"{np.sqrt(error[part].mean()):.4f}" for part in parts)]) + " |")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
