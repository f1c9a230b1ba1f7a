"""`scsr cache` and `scsr warm`: compiled programs that are kept on disk."""

import os
from typing import Annotated

from cyclopts import Parameter

from scsr_opt.cli.options import Quiet, Whole, progress
from scsr_opt.errors import InputError


def cache(
    *,
    clear: Annotated[bool, Parameter(negative="", show_default=False, help="Delete all kept programs.")] = False,
) -> int:
    """Show the compiled programs that are kept on disk, or delete them.

    A program is compiled once for each size of sensor, scale and kind of scene, and read from this folder afterwards.
    Set JAX_ENABLE_COMPILATION_CACHE=0 to keep nothing, JAX_COMPILATION_CACHE_DIR to keep programs in another folder.
    """
    from scsr_opt._kernels.kept import MOST_BYTES, cache_folder, kept
    from scsr_opt._kernels.kept import clear as delete

    found = delete() if clear else kept()
    what = f"{found.programs} programs, {found.bytes / 1e6:.1f} MB"
    if clear:
        print(f"{cache_folder()}: deleted {what}.")
    else:
        print(f"{cache_folder()}: {what}; at most {MOST_BYTES / 1e6:.0f} MB are kept.")
    elsewhere = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if elsewhere:
        print(f"JAX_COMPILATION_CACHE_DIR is set: programs are kept in {elsewhere} now; this command leaves it alone.")
    return 0


def warm(
    *,
    size: Annotated[str, Parameter(help="WIDTHxHEIGHT of the sensor in pixels, such as 400x250.")],
    scale: Annotated[Whole, Parameter(help="Pixels of the picture per sensor pixel, along each axis.")] = 4,
    frames: Annotated[Whole | None, Parameter(help="Frames around the key frame. Default: those of `solve`.")] = None,
    quiet: Quiet = False,
) -> int:
    """Compile ahead what `solve` and the Python interface need for a size of sensor, and keep it on disk.

    Solves for simulated scenes of that size: one at rest, one that moves as a whole, one with a moving object.
    """
    import numpy as np

    from scsr_opt import reconstruct
    from scsr_opt._validation import picture_shape, whole
    from scsr_opt.camera import Recording, Sensor, simulate
    from scsr_opt.camera.flat import parse_size
    from scsr_opt.camera.recording import USUAL_FRAMES
    from scsr_opt.camera.scenes import MovingObject, Scene, Static, Translation

    width, height = parse_size(size)
    count = USUAL_FRAMES if frames is None else frames
    if count < 2:
        raise InputError(f"--frames is {count}; it must be a whole number, at least 2.")
    picture_shape((height, width), whole(scale, "--scale", 1))  # refuses what does not fit into memory
    # Squares of 3 pixels with random brightness: texture enough for every stage, at the sensor's own resolution.
    rng = np.random.default_rng(0)
    texture = np.kron(0.1 + 0.8 * rng.random((-(-height // 3), -(-width // 3))), np.ones((3, 3)))[:height, :width]
    side = max(1, min(height, width) // 3)
    scenes: dict[str, Scene] = {
        "at rest": Static(texture),
        "moving": Translation(texture, velocity=(0.1, 0.15)),
        "a moving object": MovingObject(texture, texture[:side, :side], (0.15, 0.2)),
    }
    meter = progress(quiet)
    meter.start(len(scenes), "Compiling")
    try:
        for scene in scenes.values():
            made = simulate(scene, scale=1, frames=count, sensor=Sensor(photons=1000.0), seed=0)
            reconstruct(Recording.from_array(made.spikes), scale=scale, frames=count)
            meter.advance(1)
    finally:
        meter.finish()
    if not quiet:
        from scsr_opt._kernels.kept import cache_folder, kept

        found = kept()
        print(f"{cache_folder()}: {found.programs} programs, {found.bytes / 1e6:.1f} MB.")
    return 0
