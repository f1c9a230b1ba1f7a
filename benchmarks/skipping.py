"""Time that is saved by skipping work that a scene does not need, and the change of the picture.

    python -m benchmarks.skipping [FILE[:WIDTHxHEIGHT] …] [--scale 4] [--frames 101] [--rounds 3] [--page PAGE]

For each recording (five simulated scenes at ×2, then the files) `reconstruct` runs with and without shortcuts, in
turns. The table gives the medians of the seconds and their ratio; by how much the objective of the picture with
shortcuts is above that of the other one, in the problem that nothing was skipped in (Eq. 4 over two, every interval a
sample of its own, with the motion that the full computation found); the largest change of the mean of a tile of 16
sensor pixels, in 1/255 of white; and the peak signal-to-noise ratios where the truth is known. `--page` writes it
between the marks of a page, as docs/shortcuts.md.
"""

import argparse
import shlex
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from skimage import color, data

from benchmarks.command import check_page, machine, made_by, write_page
from benchmarks.recordings import SCENES
from benchmarks.timing import in_turns
from scsr_opt import Recording, Shortcuts, Solution, reconstruct
from scsr_opt.camera import Intervals, Sensor, read_recording, simulate
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.errors import InputError
from scsr_opt.motion import Automatic, Motion, estimate_motion
from scsr_opt.operators import Aperture
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.pipeline.measurement import measure
from scsr_opt.pipeline.settings import SceneSummarySettings


class Case(NamedTuple):
    """A recording, its scale, and the truth where it is known."""

    name: str
    recording: Recording
    scale: int
    frames: int
    truth: Float[np.ndarray, "H W"] | None


def simulated() -> Iterator[Case]:
    """Five scenes of 240×240 high-resolution pixels, 120×120 on the sensor."""
    still = color.rgb2gray(data.astronaut())[:240, 100:340]
    texture = data.brick()[:160, :160] / 255
    for name, scene in SCENES.items():
        made = simulate(scene(still, texture), scale=2, frames=101, sensor=Sensor(photons=1000.0), seed=4)
        yield Case(name, Recording.from_array(made.spikes), 2, 101, made.truth(50))


def given(files: list[str], scale: int, frames: int) -> Iterator[Case]:
    """Recordings in files."""
    for file in files:
        recording = opened(file)
        yield Case(recording.name, recording, scale, frames, None)


def opened(file: str) -> Recording:
    """The recording of `FILE` or, of a flat file, `FILE:WIDTHxHEIGHT`."""
    path, _, size = file.partition(":")
    return read_recording(path, size=size) if size else read_recording(path)


def excess(case: Case, full: Solution, other: Solution) -> float:
    """Relative objective of `other` above that of `full`, in the problem that nothing was skipped in."""
    clip = Clip.around(case.recording, frames=case.frames)
    motion = estimate_motion(
        clip.spikes, key=clip.key, white_rate=clip.white_rate, estimator=Automatic(simple_motion=False)
    )
    objective = unskipped(clip, motion, case.scale, full.diagnostics.strength or 0.0)
    return objective(other.image) / objective(full.image) - 1


def unskipped(
    clip: Clip, motion: Motion, scale: int, strength: float, gain: Float[np.ndarray, "h w"] | None = None
) -> Callable[[Float[np.ndarray, "H W"]], float]:
    """The objective, of pictures, that nothing was skipped in."""
    height, width = clip.shape
    placed = measure(clip, motion, scale=scale, sampling=Intervals(), gain=gain, merged_intervals=False).placed
    aperture, prior = Aperture((scale * height, scale * width), scale), default_prior(scale)

    def objective(image: Float[np.ndarray, "H W"]) -> float:
        missed = placed.read(aperture(jnp.asarray(image))) - placed.value
        data_part = 0.5 * jnp.sum(placed.weight * missed**2)
        return float(data_part + strength * prior.value(jnp.asarray(image)))

    return objective


def tile_change(first: Float[np.ndarray, "H W"], second: Float[np.ndarray, "H W"], scale: int) -> float:
    """The largest change of a tile's mean, in 1/255 of white."""
    side = SceneSummarySettings().tile_px * scale
    rows, columns = (range(0, length, side) for length in first.shape)
    change = (second - first) * 255
    return max(abs(float(change[r : r + side, c : c + side].mean())) for r in rows for c in columns)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--frames", type=int, default=101)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--page", type=Path, help="page whose table is to be written anew")
    arguments = parser.parse_args()
    lines = [
        "| recording | all work, s | with shortcuts, s | ratio | objective above | tile's mean, 1/255 | PSNR, dB |",
        "|---|--:|--:|--:|--:|--:|--:|",
    ]
    try:
        if arguments.page is not None:
            check_page(arguments.page, "skipping")
        about, begin = machine(), time.perf_counter()
        print("\n".join(lines), flush=True)
        for case in (*simulated(), *given(arguments.files, arguments.scale, arguments.frames)):
            lines.append(row(case, arguments.rounds))
            print(lines[-1], flush=True)
        if arguments.page is not None:
            shown = [Path(file).name for file in arguments.files]
            command = shlex.join(["python", "-m", "benchmarks.skipping", *shown])
            about |= {"seconds": time.perf_counter() - begin}
            write_page(arguments.page, f"{made_by(command, about)}\n\n" + "\n".join(lines), {}, "skipping")
    except InputError as error:
        parser.error(str(error))


def row(case: Case, rounds: int) -> str:
    """A line of the table."""

    def solved(shortcuts: Shortcuts) -> Solution:
        return reconstruct(case.recording, scale=case.scale, frames=case.frames, shortcuts=shortcuts)

    full, skipping = solved(Shortcuts.none()), solved(Shortcuts())  # compiles
    calls = {"full": lambda: solved(Shortcuts.none()).image, "skipping": lambda: solved(Shortcuts()).image}
    slow, fast = (median(taken) for taken in in_turns(calls, rounds).values())
    change = tile_change(full.image, skipping.image, case.scale)
    quality = "-"
    if case.truth is not None:
        quality = " → ".join(f"{psnr(case.truth, s.image, 4 * case.scale):.2f}" for s in (full, skipping))
    return (
        f"| {case.name} ×{case.scale} | {slow:.2f} | {fast:.2f} | {slow / fast:.2f} | "
        f"{100 * excess(case, full, skipping):.3f} % | {change:.3f} | {quality} |"
    )


if __name__ == "__main__":
    main()
