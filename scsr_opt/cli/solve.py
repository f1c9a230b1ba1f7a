"""`scsr solve`: a recording to a super-resolved picture."""

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from scsr_opt.cli.options import (
    File,
    Overwrite,
    Quiet,
    Reading,
    ShownWhite,
    Whole,
    check_outputs,
    key_frame,
    progress,
    say_failure,
    white_of_picture,
)
from scsr_opt.cli.solving import Solving
from scsr_opt.errors import InputError
from scsr_opt.progress import Progress

if TYPE_CHECKING:
    from scsr_opt.pipeline.solution import Solution
    from scsr_opt.report.summary import Report

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
    scale: Annotated[
        Whole, Parameter(help="Pixels of the picture per sensor pixel, along each axis: 1, 2, 3, 4, …")
    ] = 4,
    key: Annotated[Whole | None, Parameter(help="Frame to show, from 0. Default: the middle one.")] = None,
    frames: Annotated[
        Whole | None, Parameter(help="Use only this number of frames around the key frame. Default: 101.")
    ] = None,
    bits: Annotated[Whole | None, Parameter(help="Bits per pixel: 8 or 16; 32 (float) for .tif.")] = None,
    gamma: Annotated[
        float, Parameter(help="Store intensity^(1/gamma): 1 is linear; 2.2 is what viewers expect.")
    ] = 1.0,
    white: ShownWhite = None,
    report: Annotated[Path | None, Parameter(help="Also write a report in numbers (.json).")] = None,
    figure: Annotated[
        Path | None,
        Parameter(help="Also write a figure: playback beside result, motion, convergence (.png, .pdf, .svg)."),
    ] = None,
    explain: Annotated[
        bool, Parameter(negative="", help="Say what each part of the scene needed; the figure then shows where.")
    ] = False,
    solving: Solving | None = None,
    reading: Reading | None = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Solve for the super-resolved picture of one moment.

    The picture has SCALE times the sensor's rows and columns. Frames before and after the key frame add detail through
    the motion between them. An 8-bit .png shows a value near the brightest light of the recording as white (see
    --white). Other files hold intensity as it is, 1 = white; all but floating-point files are cut to 0..1. An .npz also
    holds the motion that was used.
    """
    from scsr_opt.report.pictures import PictureFormat

    absolute = PictureFormat.of(output, bits=bits, gamma=gamma).absolute
    white_of_picture(output, bits, white, also_for=figure)
    _check_ending("report", report, (".json",))
    _check_ending("figure", figure, FIGURE_ENDINGS)
    check_outputs([file], overwrite, output=output, report=report, figure=figure)
    for name, value in (("scale", scale), ("frames", frames)):
        if value is not None and value < 1:
            raise InputError(f"--{name} is {value}, but it must be at least 1.")
    solving = solving or Solving()
    solving.check()
    meter = progress(quiet)
    solution, said = solved(file, solving, reading or Reading(), scale, key, frames, white, meter)
    if report is not None:
        said.write(report)
    if not solution.status.usable:
        if explain and not quiet:
            print("\n".join(_explained(solution)))
        say_failure("No picture was written", solution.status.message)
        return 1
    solution.save(output, bits=bits, gamma=gamma)
    if figure is not None:
        _draw(figure, solution, explain=explain)
    if not quiet:
        print(
            "\n".join(
                [
                    *said.lines(),
                    *_camera_lines(solution.diagnostics),
                    *([] if absolute and figure is None else [solution.white.sentence]),
                    *(_explained(solution) if explain else []),
                    *(str(path) for path in (output, report, figure) if path is not None),
                ]
            )
        )
    return 0


def solved(
    file: Path | str,
    solving: Solving,
    reading: Reading,
    scale: int,
    key: int | None,
    frames: int | None,
    white: float | None,
    meter: Progress,
) -> "tuple[Solution, Report]":
    """The picture of one moment of a recording by options of the command line, and its numbers.

    **Raises:** `InputError` for what cannot be read, or does not go with the recording.
    """
    started = time.perf_counter()
    recording, crop = reading.whole(file)
    moment = key_frame(recording, key)
    choices = reading.corrections() | solving.arguments(recording, scale, crop)
    if frames is not None:
        choices["frames"] = frames

    from scsr_opt import reconstruct
    from scsr_opt.camera.white import White
    from scsr_opt.report.summary import Report

    read = time.perf_counter()
    solution = reconstruct(recording, scale=scale, key=moment, progress=meter, **choices)
    seconds = {"read": read - started, "solve": time.perf_counter() - read}
    if white is not None:
        solution = replace(solution, white=White.given(white))
    return solution, Report.of(solution, seconds=seconds)


def _camera_lines(found: Any) -> list[str]:
    """Sentences on the gains and the lens, where they were estimated."""
    lines = []
    if found.optics_sigma is not None:
        lines.append(f"Lens: blurs by a standard deviation of {found.optics_sigma:.2g} sensor pixels.")
    if (found.gain_spread or 0) >= 5e-4:  # less is none
        lines.append(f"Fixed pattern: gains spread by {100 * found.gain_spread:.2g} %.")
    if found.gain_spread_at_rest:
        percent = 100 * found.gain_spread_at_rest
        lines.append(f"Fixed pattern: where nothing moves, gains seem to spread by {percent:.2g} %.")
    return lines


def _explained(solution: Any) -> list[str]:
    if solution.scene is None:
        return ["No work was left out."]
    parts = ", ".join(f"{name} {seconds:.2f}" for name, seconds in solution.diagnostics.seconds.items())
    left = [_left(solution.status, stage.residual, solution.diagnostics.positions) for stage in solution.stages[-1:]]
    if solution.diagnostics.solver == "DataProximal":
        left.insert(0, "Solver: data-proximal, which is faster where nothing moves.")
    if solution.tiles is not None:
        left.extend(solution.tiles.lines())
    return [*solution.scene.lines(), *left, f"Seconds: {parts}."]


def _left(result: Any, residual: float, positions: int) -> str:
    """Sentence on how far the last iteration of the whole picture, or one more, changes it."""
    from scsr_opt.solvers import Status

    if result is not Status.converged:
        return f"The last iteration of the whole picture changed it by {100 * residual:.1g} %."
    # A quadratic stands in for what exposures have seen move (`scsr_opt.pipeline.outer_loop`).
    held = ", with the motion blur held fixed," if positions > 1 else ""
    return f"One more iteration{held} would change the picture by {100 * residual:.1g} % at most."


def _check_ending(option: str, path: Path | None, endings: tuple[str, ...]) -> None:
    if path is not None and path.suffix.lower() not in endings:
        raise InputError(f"--{option} {path} must end in {' or '.join(endings)}.")


def _draw(path: Path, solution: Any, *, explain: bool) -> None:
    from scsr_opt._files import whole_file
    from scsr_opt.report.figures import scene_figure

    title = solution.recording.name
    drawn = (
        scene_figure(solution, title=title) if explain and solution.scene is not None else solution.plot(title=title)
    )
    with whole_file(path) as temporary:
        drawn.savefig(temporary)
