"""`scsr film`: a recording to a film of super-resolved pictures."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from scsr_opt._files import check_writable
from scsr_opt.cli.options import (
    File,
    Overwrite,
    Quiet,
    Reading,
    ShownWhite,
    Whole,
    check_new,
    check_outputs,
    moments,
    progress,
    say_failure,
    shown_white,
)
from scsr_opt.cli.solving import Solving
from scsr_opt.errors import InputError
from scsr_opt.progress import Progress

if TYPE_CHECKING:
    import scsr_opt
    import scsr_opt.camera

# Pictures of a film, about, where nothing else is said: each takes seconds.
_PICTURES = 25


def film(
    file: File,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], help="Film to write: .gif or .mp4.")],
    scale: Annotated[
        Whole, Parameter(help="Pixels of the pictures per sensor pixel, along each axis: 1, 2, 3, 4, …")
    ] = 4,
    start: Annotated[Whole, Parameter(help="First frame to show.")] = 0,
    stop: Annotated[Whole | None, Parameter(help="Frame before which the film ends. Default: the end.")] = None,
    step: Annotated[
        Whole | None, Parameter(help="Frames from one picture to the next. Default: about 25 pictures in all.")
    ] = None,
    frames: Annotated[
        Whole | None, Parameter(help="Use only this number of frames around each key frame. Default: 101.")
    ] = None,
    rate: Annotated[float, Parameter(help="Pictures per second.")] = 25.0,
    gamma: Annotated[float, Parameter(help="Store intensity^(1/gamma): 1 is linear, 2.2 is for looking at.")] = 1.0,
    white: ShownWhite = None,
    pictures: Annotated[
        Path | None,
        Parameter(help="A folder in which each picture is written as well: FRAME.tif, 32 bit, linear intensity."),
    ] = None,
    solving: Solving | None = None,
    reading: Reading | None = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Solve for the super-resolved pictures of many moments, each starting from what is known of the one before.

    Motion is carried on from picture to picture and estimated anew where the recording contradicts it. Each picture is
    solved for as by `scsr solve` with --key, along that motion.
    """
    from scsr_opt.report.pictures import check_film, write_film

    check_film(output, rate=rate, gamma=gamma, white=1.0 if white is None else white)
    check_outputs([file], overwrite, output=output)
    if pictures is not None:
        if not pictures.is_dir():
            raise InputError(f"--pictures {pictures} is no folder: make it first, or leave the option out.")
        check_writable(pictures / "0.tif")
    for name, value in (("scale", scale), ("frames", frames)):
        if value is not None and value < 1:
            raise InputError(f"--{name} is {value}, but it must be at least 1.")
    solving = solving or Solving()
    solving.check()
    recording, crop = (reading or Reading()).whole(file)
    keys = moments(recording, start, stop, step, about=_PICTURES)
    made = _Made(pictures, keys)
    for path in made.paths():
        check_new("pictures", path, overwrite)
    choices = (reading or Reading()).corrections() | solving.arguments(recording, scale, crop)

    from scsr_opt import reconstruct_sequence
    from scsr_opt.motion import Estimator

    if not isinstance(choices.get("motion"), Estimator | None):
        raise InputError(
            f"--motion {solving.motion} is the velocity at one moment, but a film has many: give auto, none, phase, "
            f"global, dense, ilk or tvl1."
        )
    if frames is not None:
        choices["frames"] = frames

    part = recording if crop is None else recording.crop(*crop)
    level = shown_white(part, white, keys[0], keys[-1], frames)
    begin = time.perf_counter()
    solutions = reconstruct_sequence(recording, keys, scale=scale, **choices)
    try:
        count = write_film(output, made.images(solutions, progress(quiet)), rate=rate, gamma=gamma, white=level.level)
    except _Failed as failed:
        say_failure(f"No film was written, because of frame {failed.key}", failed.sentence)
        return 1
    if not quiet:
        each = (time.perf_counter() - begin) / count
        shown = "1 picture" if count == 1 else f"{count} pictures"
        times = "once" if len(made.anew) == 1 else f"{len(made.anew)} times"
        print(
            f"{output}: {shown} of frames {keys[0]} to {keys[-1]}, every {keys.step}; {each:.2g} s each.\n"
            f"Motion was estimated {times}, at {_listed(made.anew)}, and carried on between.\n"
            f"{level.sentence}"
        )
    return 0


class _Failed(Exception):
    """A picture that could not be solved for."""

    def __init__(self, key: int, sentence: str):
        super().__init__(sentence)
        self.key, self.sentence = key, sentence


@dataclass
class _Made:
    """Pictures as they come, written to `folder` if there is one, and the frames at which motion was found `anew`."""

    folder: Path | None
    keys: range
    anew: list[int] = field(default_factory=list)

    def paths(self) -> list[Path]:
        """Where the pictures are written, one for each key; none without a folder."""
        if self.folder is None:
            return []
        digits = len(str(self.keys[-1]))
        return [self.folder / f"{key:0{digits}d}.tif" for key in self.keys]

    def images(self, solutions: Iterator["scsr_opt.Solution"], meter: Progress) -> Iterator[Any]:
        from scsr_opt.report.pictures import write_picture

        meter.start(len(self.keys), "Solving")
        paths = iter(self.paths())
        try:
            for key, solution in zip(self.keys, solutions, strict=True):
                if not solution.status.usable:
                    raise _Failed(key, solution.status.message)
                if not solution.diagnostics.motion_carried:
                    self.anew.append(key)
                if self.folder is not None:
                    write_picture(next(paths), solution.image, bits=32)
                yield solution.image
                meter.advance(1)
        finally:
            meter.finish()


def _listed(frames: list[int]) -> str:
    """The first few, in words."""
    few = ", ".join(str(frame) for frame in frames[:5])
    return f"frame{'s' if len(frames) > 1 else ''} {few}{', …' if len(frames) > 5 else ''}"
