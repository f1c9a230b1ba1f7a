"""`scsr solve`: a recording to a super-resolved picture."""

import time
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from scsr_opt.cli.options import File, Quiet, Reading, check_outputs, key_frame, progress, say_error
from scsr_opt.errors import InputError

if TYPE_CHECKING:
    import scsr_opt.camera

Prior = Literal["tv", "tv-anisotropic"]
Solver = Literal["fista", "ista", "jaxopt-fista", "jaxopt-ista"]

_SOLVING = Group("Solving", sort_key=1)
FIGURE_ENDINGS = (".png", ".pdf", ".svg")


def solve(
    file: File,
    /,
    *,
    output: Annotated[
        Path,
        Parameter(
            name=["--output", "-o"],
            help="Picture to write: .png (8 or 16 bit), .tif (8, 16, or 32 bit float) or .npz (float).",
        ),
    ],
    scale: Annotated[int, Parameter(help="Pixels of the picture per sensor pixel, along each axis: 1, 2, 3, 4, …")] = 4,
    key: Annotated[int | None, Parameter(help="Frame to show, from 0. Default: the middle one.")] = None,
    frames: Annotated[int | None, Parameter(help="Use only so many frames around the key frame. Default: 101.")] = None,
    motion: Annotated[
        str,
        Parameter(
            group=_SOLVING,
            allow_leading_hyphen=True,
            help="auto: the simplest that fits (none, global, or layers with occlusion); none: nothing moves; phase: "
            "one translation; global: one affine motion for all; dense, ilk, tvl1: a velocity for each pixel; "
            "DOWN,RIGHT: this velocity, sensor pixels per frame; FILE.npy: (2, height, width) of them.",
        ),
    ] = "auto",
    prior: Annotated[Prior, Parameter(group=_SOLVING, help="What the picture is taken to be like.")] = "tv",
    strength: Annotated[
        float | None, Parameter(group=_SOLVING, help="Of the prior (lambda). Default: set from the recording's noise.")
    ] = None,
    solver: Annotated[
        Solver, Parameter(group=_SOLVING, help="All find the same picture; fista is the fastest, ista plain Eq. 5.")
    ] = "fista",
    iterations: Annotated[
        int | None, Parameter(group=_SOLVING, help="Iterations at most, in each solve. Default: 200.")
    ] = None,
    bits: Annotated[int | None, Parameter(help="Bits per pixel: 8 or 16; 32 (float) for .tif.")] = None,
    gamma: Annotated[float, Parameter(help="Store intensity^(1/gamma): 1 is linear, 2.2 is for looking at.")] = 1.0,
    report: Annotated[Path | None, Parameter(help="Also write a report in numbers (.json).")] = None,
    figure: Annotated[
        Path | None,
        Parameter(help="Also write a figure: playback beside result, motion, convergence (.png, .pdf, .svg)."),
    ] = None,
    reading: Reading | None = None,
    quiet: Quiet = False,
) -> int:
    """Solve for the super-resolved picture of one moment.

    The picture has SCALE times the sensor's rows and columns. It is linear intensity, 1 = white, cut to 0..1 except in
    floating-point files; an .npz also holds the motion that was used. Frames before and after the key frame add detail
    through the motion between them.
    """
    from scsr_opt.report.pictures import PictureFormat

    PictureFormat.of(output, bits=bits, gamma=gamma)
    _check_ending("report", report, (".json",))
    _check_ending("figure", figure, FIGURE_ENDINGS)
    check_outputs([file], output=output, report=report, figure=figure)
    for name, value in (("scale", scale), ("frames", frames), ("iterations", iterations)):
        if value is not None and value < 1:
            raise InputError(f"--{name} is {value}, but it must be at least 1.")
    started = time.perf_counter()
    recording = (reading or Reading()).open(file)
    moment = key_frame(recording, key)
    choices = _choices(recording, motion, prior, strength, solver, iterations)

    from scsr_opt import reconstruct
    from scsr_opt.reconstruction import FRAMES
    from scsr_opt.report.summary import Report

    read = time.perf_counter()
    solution = reconstruct(
        recording,
        scale=scale,
        key=moment,
        frames=FRAMES if frames is None else frames,
        progress=progress(quiet),
        **choices,
    )
    seconds = {"read": read - started, "solve": time.perf_counter() - read}
    said = Report.of(recording, solution, scale=scale, key=moment, seconds=seconds)
    if report is not None:
        said.write(report)
    if not solution.result.good:
        say_error(f"{solution.result.sentence} No picture was written.")
        return 1
    _write(output, solution, bits=bits, gamma=gamma, scale=scale, key=moment)
    if figure is not None:
        _draw(figure, recording, solution, scale=scale, key=moment)
    if not quiet:
        print("\n".join([*said.lines(), *(str(path) for path in (output, report, figure) if path is not None)]))
    return 0


def _check_ending(option: str, path: Path | None, endings: tuple[str, ...]) -> None:
    if path is not None and path.suffix.lower() not in endings:
        raise InputError(f"--{option} {path} must end in {' or '.join(endings)}.")


def _choices(
    recording: "scsr_opt.camera.Recording",
    motion: str,
    prior: Prior,
    strength: float | None,
    solver: Solver,
    iterations: int | None,
) -> dict[str, Any]:
    """What the options ask for, as arguments of `reconstruct`; what was not asked for is left to its defaults."""
    from scsr_opt import solvers
    from scsr_opt.priors.total_variation import TotalVariation

    choices: dict[str, Any] = {}
    velocity = _velocity(recording, motion)
    if velocity is not None:
        choices["velocity"] = velocity
    if strength is not None:
        if not (strength > 0 and isfinite(strength)):
            raise InputError(f"--strength is {strength:g}, but it must be above 0 and finite.")
        choices["strength"] = strength
    if prior == "tv-anisotropic":
        choices["prior"] = TotalVariation(isotropic=False)
    if solver != "fista" or iterations is not None:
        method = {
            "fista": solvers.FISTA,
            "ista": solvers.ISTA,
            "jaxopt-fista": solvers.JaxoptFISTA,
            "jaxopt-ista": solvers.JaxoptISTA,
        }[solver]
        choices["solver"] = method() if iterations is None else method(iterations=iterations)
    return choices


def _velocity(recording: "scsr_opt.camera.Recording", motion: str) -> Any:
    """An estimator, or (2, h, w) float32 in sensor pixels per frame; None where `reconstruct` is to choose.

    **Raises:** `InputError` if `motion` is none of what the option allows.
    """
    import numpy as np

    from scsr_opt import motion as known

    named = {
        "none": known.Still,
        "phase": known.PhaseCorrelation,
        "global": known.Global,
        "dense": known.Dense,
        "ilk": known.ILK,
        "tvl1": known.TVL1,
    }
    if motion == "auto":
        return None
    if motion in named:
        return named[motion]()
    shape = (2, recording.height, recording.width)
    if motion.endswith(".npy"):
        try:
            field = np.load(motion, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"--motion {motion} cannot be read as a .npy file.") from error
        if field.shape != shape or field.dtype.kind not in "fiu" or not np.isfinite(field).all():
            raise InputError(
                f"--motion {motion} holds {field.dtype} of shape {field.shape}, but a velocity is {shape}, finite, in "
                f"sensor pixels per frame."
            )
        return field.astype(np.float32)
    try:
        down, right = (float(part) for part in motion.split(","))
    except ValueError:
        down = right = float("nan")
    if not np.isfinite([down, right]).all():
        raise InputError(
            f"--motion {motion} is not known: give auto, none, phase, global, dense, ilk, tvl1, DOWN,RIGHT in sensor "
            f"pixels per frame, or the name of a .npy file."
        )
    return np.broadcast_to(np.array([down, right], np.float32)[:, None, None], shape).copy()


def _write(output: Path, solution: Any, *, bits: int | None, gamma: float, scale: int, key: int) -> None:
    from scsr_opt.report.pictures import write_picture

    extras = {"velocity": solution.velocity, "confidence": solution.confidence, "scale": scale, "key": key}
    known = {name: value for name, value in extras.items() if value is not None}
    write_picture(output, solution.image, bits=bits, gamma=gamma, extras=known)


def _draw(path: Path, recording: "scsr_opt.camera.Recording", solution: Any, *, scale: int, key: int) -> None:
    from scsr_opt.report.figures import figure
    from scsr_opt.report.files import whole_file

    drawn = figure(recording, solution, scale=scale, key=key, title=recording.name)
    with whole_file(path) as temporary:
        drawn.savefig(temporary)
