"""`scsr calibrate`: maps of bad pixels, gains and dark level of a camera, from its recordings."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from scsr_opt.cli.options import Overwrite, PathOrUrl, Quiet, Reading, check_outputs, progress
from scsr_opt.errors import InputError

if TYPE_CHECKING:
    import scsr_opt.calibration.maps


def calibrate(
    *scenes: Annotated[
        PathOrUrl, Parameter(help="Recordings of any scenes, best moving ones.", allow_leading_hyphen=False)
    ],
    output: Annotated[Path, Parameter(name=["--output", "-o"], help="Maps to write (.npz), for --calibration.")],
    flat: Annotated[
        tuple[PathOrUrl, ...],
        Parameter(negative="", show_default=False, help="Recordings of an evenly lit, still surface; may be repeated."),
    ] = (),
    dark: Annotated[
        tuple[PathOrUrl, ...],
        Parameter(negative="", show_default=False, help="Recordings with the lens covered; may be repeated."),
    ] = (),
    reading: Reading | None = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Make maps of a camera's bad pixels, gains and dark level, for --calibration of the other commands.

    Gains come from --flat, or else from scenes that move; dark levels from --dark alone; bad pixels from all of them.
    All recordings are of one sensor and read in the same way.
    """
    if output.suffix.lower() != ".npz":
        raise InputError(f"--output {output} must end in .npz.")
    files = [*scenes, *flat, *dark]
    check_outputs(files, overwrite, output=output)
    reading = reading or Reading()
    if reading.crop is not None or reading.calibration is not None:
        raise InputError("scsr calibrate takes the whole sensor as it is: leave --crop and --calibration out.")
    opened = [[reading.open(file) for file in group] for group in (scenes, flat, dark)]

    from scsr_opt.pipeline.camera_calibration import calibrate as measure

    maps = measure(opened[0], flat=opened[1], dark=opened[2], progress=progress(quiet))
    maps.save(output)
    if not quiet:
        print("\n".join([*_lines(maps), str(output)]))
    return 0


def _lines(maps: "scsr_opt.calibration.maps.Calibration") -> list[str]:
    good = ~maps.bad.mask
    kinds = ", ".join(f"{number:,} {kind}" for kind, number in maps.bad.numbers.items() if number)
    height, width = maps.shape
    lines = [f"{width}x{height} pixels, of which {maps.bad.mask.sum():,} are bad{': ' * bool(kinds)}{kinds}."]
    gain, dark = maps.gain[good], maps.dark[good]
    if (gain != 1).any():
        known = gain[gain != 1]
        lines.append(f"Gains spread by {100 * known.std():.2g} %, known of {100 * known.size / gain.size:.3g} %.")
    else:
        lines.append("Gains: not known.")
    lines.append(
        f"Dark level: {dark.mean():.2g} spikes per frame in the mean." if dark.any() else "Dark level: not known."
    )
    return lines
