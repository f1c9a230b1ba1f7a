"""`scsr sequence`: a recording to super-resolved pictures of many moments. `scsr export`: those in another format."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from scsr_opt.cli.live import follow, live_output
from scsr_opt.cli.options import (
    Overwrite,
    PathOrUrl,
    Quiet,
    Rate,
    Reading,
    ShownWhite,
    Whole,
    moments,
    progress,
    say_failure,
)
from scsr_opt.cli.solving import Solving
from scsr_opt.errors import InputError

if TYPE_CHECKING:
    import scsr_opt.sequences

# Pictures of a sequence, about, where nothing else is said: each takes seconds.
_PICTURES = 25

_OUTPUT = (
    ".zarr: a store, with which an interrupted run can continue; a name without an ending: a folder with numbered "
    "pictures in images/ and times.csv; .npz, .npy: arrays (T, H, W), float; .mp4, .gif: a film."
)
Bits = Annotated[
    Whole | None,
    Parameter(help="Bits per pixel of the pictures of a folder: 8 or 16 (.png), 32 (.tif, float). Default: 8."),
]
Gamma = Annotated[
    float | None,
    Parameter(help="For films and .png: store intensity^(1/gamma). Default: 1, linear; 2.2 is what viewers expect."),
]


def sequence(
    file: Annotated[
        PathOrUrl,
        Parameter(
            help="The recording: .dat (flat, packed), .npz, .npy, .h5 or .hdf5; or its URL, such as "
            "s3://bucket/car.dat, which each machine that solves copies to a temporary file. -: a stream of frames as "
            "in a .dat, from standard input.",
            allow_leading_hyphen=True,
        ),
    ],
    /,
    *,
    output: Annotated[
        Path,
        Parameter(
            name=["--output", "-o"],
            help=f"What to write. {_OUTPUT} For a stream: a folder, or with --latest a .png, .tif or .npz.",
        ),
    ],
    scale: Annotated[
        Whole, Parameter(help="Pixels of the pictures per sensor pixel, along each axis: 1, 2, 3, 4, …")
    ] = 4,
    start: Annotated[Whole, Parameter(help="First frame to show.")] = 0,
    stop: Annotated[Whole | None, Parameter(help="Frame before which the sequence ends. Default: the end.")] = None,
    every: Annotated[
        Whole | None,
        Parameter(
            help="Frames from one picture to the next. Default: about 25 pictures in all; a stream needs a number."
        ),
    ] = None,
    latest: Annotated[
        bool,
        Parameter(
            negative="",
            show_default=False,
            help="For a stream: write the newest picture alone, to the file OUTPUT, which each new picture replaces.",
        ),
    ] = False,
    frames: Annotated[
        Whole | None, Parameter(help="Use only this number of frames around each key frame. Default: 101.")
    ] = None,
    group: Annotated[
        Whole | None,
        Parameter(
            help="Pictures in a group. The pictures of a group are solved for one after the other, each from the one "
            "before; the first starts from nothing. An interruption costs one group at most; a worker gets one group "
            "at a time. Default: 10."
        ),
    ] = None,
    workers: Annotated[
        Whole | None, Parameter(help="Solve in this number of processes; the pictures are the same. Default: in one.")
    ] = None,
    scheduler: Annotated[
        str | None,
        Parameter(
            help="Solve by the workers of this Dask scheduler, tcp://HOST:PORT. They need the output, and FILE unless "
            "it is a URL, under the same paths."
        ),
    ] = None,
    bits: Bits = None,
    gamma: Gamma = None,
    rate: Rate = None,
    white: ShownWhite = None,
    solving: Solving | None = None,
    reading: Reading | None = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Solve for the super-resolved pictures of many moments, each starting from the one before.

    Within a group the motion is carried on for a few frames, unless the recording contradicts it. A run that was
    interrupted continues when the same command is given again, and its pictures are the same, bit for bit, as those
    of an undisturbed run. Unless the output is a .zarr, pictures are kept in OUTPUT.unfinished.zarr until all of them
    are solved for.

    From a stream (FILE is -), each picture is solved for alone, while the stream goes on. Of the key frames that come
    meanwhile, all but the newest one are dropped, and counted.
    """
    solving, reading = solving or Solving(), reading or Reading()
    for name, value in (("scale", scale), ("frames", frames), ("group", group), ("workers", workers)):
        if value is not None and value < 1:
            raise InputError(f"--{name} is {value}, but it must be at least 1.")
    solving.check()
    choices: dict[str, Any] = {} if frames is None else {"frames": frames}
    if str(file) == "-":
        _refuse_for_streams(every, group=group, workers=workers, scheduler=scheduler, rate=rate)
        place = live_output(output, latest=latest, bits=bits, gamma=gamma, overwrite=overwrite)
        picked = {"scale": scale, "every": every, "start": start, "stop": stop, "white": white, **choices}
        return follow(output, place, reading, solving, quiet=quiet, **picked)
    if str(file).startswith("-") and not Path(file).exists():
        raise InputError(f"Unknown option: {file}; a file of that name is ./{file}.")
    if latest:
        raise InputError("--latest is for a stream, whose FILE is -: leave it out, or take scsr solve for one picture.")

    from scsr_opt.sequences.outputs import SequenceFormat, real_time

    chosen = SequenceFormat.of(output, bits=bits, gamma=gamma, rate=rate, white=white)
    chosen.check(overwrite)
    if not chosen.is_store and isinstance(file, Path) and file.is_file() and output.is_file() and output.samefile(file):
        raise InputError(f"--output {output} is the file that is read: give the output another name.")
    if workers is not None and scheduler is not None:
        raise InputError("--workers starts workers here, --scheduler uses those of a cluster: give one of the two.")
    recording, crop = reading.whole(file)
    keys = moments(recording, start, stop, every, about=_PICTURES, option="every")
    choices |= reading.corrections() | solving.several(recording, scale, crop)

    from scsr_opt.sequences.cluster import Workers
    from scsr_opt.sequences.plan import Plan
    from scsr_opt.sequences.run import write_sequence

    def started(dashboard: str) -> None:
        if not quiet:
            print(f"scsr: dashboard of the workers: {dashboard}", file=sys.stderr, flush=True)

    many = None if workers is None and scheduler is None else Workers(workers, scheduler, started)
    if group is not None:
        choices["group"] = group
    plan = Plan.of(recording, keys, scale=scale, white=white, **choices)
    begin = time.perf_counter()
    done = write_sequence(plan, chosen, workers=many, overwrite=overwrite, progress=progress(quiet))
    seconds = time.perf_counter() - begin
    if len(done.failed) == len(keys):
        return _failures(done.failed, len(keys))
    if not quiet:
        print("\n".join(_lines(output, done, keys, seconds, solving.motion != "none")))
        if chosen.is_film:
            print(real_time(recording.readout_rate, keys.step, chosen.film_rate(len(keys))))
    return _failures(done.failed, len(keys))


def _refuse_for_streams(every: int | None, **others: Any) -> None:
    """**Raises:** `InputError` for `others` that were given, or without `every`."""
    for name, value in others.items():
        if value is not None:
            raise InputError(f"--{name} is not for a stream, whose pictures are solved for one by one: leave it out.")
    if every is None:
        raise InputError("A stream needs --every N, frames from one picture to the next, as its length is not known.")


def export(
    store: Annotated[Path, Parameter(help="A store that scsr sequence made.", allow_leading_hyphen=False)],
    /,
    *,
    output: Annotated[
        Path, Parameter(name=["--output", "-o"], help=f"What to write. {_OUTPUT.partition('; ')[2].capitalize()}")
    ],
    bits: Bits = None,
    gamma: Gamma = None,
    rate: Rate = None,
    white: Annotated[
        float | None,
        Parameter(help="Intensity that is white in films and 8-bit .png. Default: that of the store."),
    ] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Write the pictures of a store of scsr sequence as a folder, arrays or a film."""
    from scsr_opt.sequences.outputs import SequenceFormat, real_time
    from scsr_opt.sequences.outputs import export as write
    from scsr_opt.sequences.store import SequenceStore

    chosen = SequenceFormat.of(output, bits=bits, gamma=gamma, rate=rate, white=white)
    source = SequenceStore.open(store)
    pictures = write(source, chosen, overwrite=overwrite, progress=progress(quiet))
    failed = [one for one in pictures if one.status is None or not one.status.usable]
    if not quiet:
        print(f"{output}: {_counted(len(pictures))} of {store}.")
        if chosen.is_film:
            print(real_time(source.readout_rate, source.keys.step, chosen.film_rate(len(source.keys))))
    return _failures(failed, len(pictures))


def _lines(output: Path, done: "scsr_opt.sequences.Written", keys: range, seconds: float, moving: bool) -> list[str]:
    """The sentences that `scsr sequence` prints at the end; `moving`: whether motion was to be estimated."""
    asked, new = len(keys), len(keys) - done.there
    written = asked - len(done.failed)
    frames = f"frames {keys[0]} to {keys[-1]}, every {keys.step}" if asked > 1 else f"frame {keys[0]}"
    has = f"{written} of {_counted(asked)}" if written < asked else _counted(asked)
    lines = [f"{output} has {has}, of {frames}."]
    if new:
        lines.append(f"{_counted(new).capitalize()} solved for, {seconds / new:.2g} s each.")
    if done.there:
        lines.append(f"{_counted(done.there).capitalize()} had been there before.")
    if moving:
        anew = done.estimated
        times = "once" if len(anew) == 1 else f"{len(anew)} times"
        between = ", and carried on between" if len(anew) < asked else ""
        lines.append(f"Motion was estimated {times}, at {_listed(anew)}{between}.")
    return [*lines, done.white]


def _failures(failed: list[Any], asked: int) -> int:
    """The exit code, after saying which pictures failed."""
    if not failed:
        return 0
    why = failed[0].status.message
    which = _listed([one.key for one in failed])
    say_failure(f"{len(failed)} of {_counted(asked)} could not be solved for, at {which}", why)
    return 1


def _counted(pictures: int) -> str:
    return "1 picture" if pictures == 1 else f"{pictures} pictures"


def _listed(frames: list[int]) -> str:
    """The first few, in words."""
    few = ", ".join(str(frame) for frame in frames[:5])
    return f"frame{'s' if len(frames) > 1 else ''} {few}{', …' if len(frames) > 5 else ''}"
