"""Growth of time and memory with the number of frames and with the sensor, part by part of `reconstruct`."""

from collections.abc import Callable
from typing import Any

from benchmarks.bench.size import Size
from benchmarks.recordings import FRAMES, quality, recorded, recording_of
from benchmarks.timing import Peak, compiling_anew, memory_available
from scsr_opt import reconstruct

SCALE = 2
PARTS = ("reading", "motion", "samples", "strength", "solving")
# Of the usual speed: even 2,000 frames then move by 28 pixels only, and what is seen stays on the sensor.
_SPEED = 0.1
_ROUNDS = 3
# A sample takes about 100 bytes while it is made and placed, a pixel fires in at most 0.6 of the frames, and a picture
# has about 40 numbers for each of its pixels. Of what is free, this share is taken at most.
_BYTES_A_SPIKE, _NUMBERS_A_PIXEL, _SHARE = 100, 40, 0.5


def memory_needed(frames: int, side: int) -> int:
    """About how many bytes a reconstruction at `SCALE` takes, rather too many than too few."""
    pixels = side**2
    return int(_BYTES_A_SPIKE * 0.6 * frames * pixels + 4 * _NUMBERS_A_PIXEL * SCALE**2 * pixels)


def measure(size: Size, seed: int, advance: Callable[[int], None]) -> dict[str, list[dict[str, Any]]]:
    """`frames` and `sensor`: a row for each number of frames and for each side, ready for JSON, with `seconds` of the
    parts for each round and the `peak` of memory that a call adds (bytes). What would not fit is `skipped`."""
    cases = [("frames", frames, size.still) for frames in size.frames]
    cases += [("sensor", FRAMES, side) for side in size.sides]
    found: dict[str, list[dict[str, Any]]] = {"frames": [], "sensor": [], "skipped": []}
    for axis, frames, side in cases:
        free = memory_available()
        if free is not None and memory_needed(frames, side) > _SHARE * free:
            found["skipped"].append({"frames": frames, "side": side, "needed": memory_needed(frames, side)})
        else:
            found[axis].append(_row(frames, side, seed))
        advance(1)
    return found


def _row(frames: int, side: int, seed: int) -> dict[str, Any]:
    made = recorded("camera", scale=SCALE, sensor=side, frames=frames, speed=_SPEED, seed=seed)
    recording, peak, seconds, compiled = recording_of(made), Peak(), [], 0.0
    for number in range(_ROUNDS + 1):
        with compiling_anew():
            solution = reconstruct(recording, scale=SCALE, frames=frames)
        diagnostics = solution.diagnostics
        if number:
            seconds.append(diagnostics.seconds)
        else:
            compiled = sum(diagnostics.seconds.values())
    peak.reset()
    solution = reconstruct(recording, scale=SCALE, frames=frames)
    found, (ratio, likeness) = solution.diagnostics, quality(made.truth(frames // 2), solution.image, SCALE)
    return {
        "frames": frames, "side": side, "samples": found.samples, "iterations": found.iterations,
        "psnr": ratio, "ssim": likeness, "first_seconds": compiled, "seconds": seconds, "peak": peak.read(),
        "iteration_seconds": [one["solving"] / found.iterations for one in seconds],
    }  # fmt: skip
