"""Prediction of masked pixels of a real recording, which has no ground truth.

    python -m benchmarks.masked FILE [--size 400x250] [--scale 4] [--share 0.05] [--masks 1] [--page PAGE]

A part of the sensor's pixels, drawn at random, is declared bad, so that no method uses them. The picture at the key
frame, averaged down to the sensor, predicts what they saw, which the interval between spikes that holds the key frame
shows (`tfi`). The table gives the root-mean-square error for all masked pixels, and separately for those where the
scene moves (faster than a tenth of a sensor pixel in ten frames, by the estimate from all pixels) and where it is at
rest. The last column says by how much a method's mean square error is above that of `reconstruct`, pixel by pixel of
the same masks, with its standard error. `--page` writes it between the marks of a page, as docs/baselines.md.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import check_page, machine, made_by, write_page
from scsr_opt import reconstruct
from scsr_opt.baselines import BASELINES
from scsr_opt.camera import Recording, read_recording
from scsr_opt.camera.playback import tfi
from scsr_opt.errors import InputError
from scsr_opt.motion import estimate_motion

METHODS: dict[str, Callable[..., Any]] = {"reconstruct": reconstruct, **BASELINES}
_FRAMES_AROUND_KEY = 50
_MOVING = 0.01
"""Speed from which a pixel counts as moving, sensor pixels per frame."""


def lines(whole: Recording, scale: int, share: float, masks: int, methods: dict[str, Callable[..., Any]]) -> Iterator:
    """The table, line by line; the first method is the one that the others are compared with."""
    key = whole.frames // 2
    first = max(key - _FRAMES_AROUND_KEY, 0)
    spikes, key = whole.window(first, min(key + _FRAMES_AROUND_KEY + 1, whole.frames)), key - first
    seen = np.asarray(tfi(spikes, key, white_rate=whole.white_rate))
    moving = estimate_motion(spikes, key=key, white_rate=whole.white_rate).speed > _MOVING
    masked = np.stack([np.random.default_rng(seed).random(seen.shape) < share for seed in range(masks)])
    yield "| method | all | moving | at rest | mean square above |\n|---|---|---|---|---|"
    reference = None
    for name, method in methods.items():
        squares = np.zeros(masked.shape)
        for number, bad_pixels in enumerate(masked):
            recording = Recording.from_array(spikes, white_rate=whole.white_rate, bad_pixels=bad_pixels)
            result = method(recording, scale=scale, key=key, white_rate=whole.white_rate)
            image = np.asarray(getattr(result, "image", result))
            sensor = image.reshape(seen.shape[0], scale, seen.shape[1], scale).mean((1, 3))
            squares[number] = (sensor - seen) ** 2
        own = squares[masked]
        reference = own if reference is None else reference
        above, usual = own - reference, reference.mean()
        behind = f"{100 * above.mean() / usual:.1f} % ± {100 * above.std() / above.size**0.5 / usual:.1f} %"
        parts = (masked, masked & moving, masked & ~moving)
        roots = (f"{np.sqrt(squares[part].mean()):.4f}" if part.any() else "–" for part in parts)
        yield "| " + " | ".join([name, *roots, behind]) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file")
    parser.add_argument("--size", default="400x250", help="WIDTHxHEIGHT of a flat file")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--share", type=float, default=0.05, help="of the pixels that are masked")
    parser.add_argument("--masks", type=int, default=1, help="how many are drawn, one after the other")
    parser.add_argument("--page", type=Path, help="page whose table is to be written anew")
    options = parser.parse_args()
    try:
        if options.page is not None:
            check_page(options.page, "masked")
        recording, table = read_recording(options.file, size=options.size), []
        about, begin = machine(), time.perf_counter()
        for line in lines(recording, options.scale, options.share, options.masks, METHODS):
            table.append(line)
            print(line, flush=True)
        if options.page is not None:
            command = f"python -m benchmarks.masked {Path(options.file).name} --masks {options.masks}"
            about |= {"seconds": time.perf_counter() - begin}
            write_page(options.page, f"{made_by(command, about)}\n\n" + "\n".join(table), {}, "masked")
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
