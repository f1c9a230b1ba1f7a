"""`scsr batch`: a super-resolved picture of each of many recordings."""

import glob
import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from cyclopts import Parameter

from scsr_opt._files import as_path, is_url, refuse_url
from scsr_opt.cli.options import (
    Overwrite,
    Quiet,
    Reading,
    ShownWhite,
    Whole,
    check_outputs,
    progress,
    say_error,
    white_of_picture,
)
from scsr_opt.cli.solve import solved
from scsr_opt.cli.solving import Solving
from scsr_opt.cli.wording import sentence, signal_behind
from scsr_opt.errors import InputError
from scsr_opt.progress import Progress


def batch(
    *files: Annotated[
        str,
        Parameter(
            name="FILE",
            help="Recordings, or patterns of their names, such as 'recordings/*.dat' (** for folders in folders).",
            allow_leading_hyphen=False,
        ),
    ],
    output: Annotated[
        Path,
        Parameter(
            name=["--output", "-o"],
            help="Folder for the pictures and their reports (.json), which are named after the recordings. The folder "
            "is made if it is not there.",
        ),
    ],
    format: Annotated[
        Literal["png", "tif", "npz"], Parameter(help="Format of the pictures: png (8 bit), tif (16 bit), npz (float).")
    ] = "png",
    scale: Annotated[
        Whole, Parameter(help="Pixels of the pictures per sensor pixel, along each axis: 1, 2, 3, 4, …")
    ] = 4,
    key: Annotated[Whole | None, Parameter(help="Frame to show, from 0. Default: the middle one of each.")] = None,
    frames: Annotated[
        Whole | None, Parameter(help="Use only this number of frames around the key frame. Default: 101.")
    ] = None,
    white: ShownWhite = None,
    solving: Solving | None = None,
    reading: Reading | None = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Solve for the super-resolved picture of one moment of each of many recordings.

    Each recording is solved for as by scsr solve, all with the same options. A recording that cannot be read or solved
    for does not stop the others. A table of all recordings is printed at the end; the exit code is 1 if any failed, and
    2 if no solve could be begun. Recordings of several folders get folders of their own.
    """
    white_of_picture(Path(f"a.{format}"), None, white)
    for name, value in (("scale", scale), ("frames", frames)):
        if value is not None and value < 1:
            raise InputError(f"--{name} is {value}, but it must be at least 1.")
    (solving := solving or Solving()).check()
    picked = {"scale": scale, "key": key, "frames": frames, "white": white}
    refuse_url(as_path(output))
    if output.exists() and not output.is_dir():
        raise InputError(f"--output {output} is a file, but pictures go into a folder: give another name.")
    places = _places(files, output, format)
    rows: list[_Row] = []

    def check(picture: Path, report: Path) -> None:
        check_outputs(list(places), overwrite, output=picture, report=report)

    try:
        for number, (source, picture) in enumerate(places.items(), 1):
            if not quiet:
                print(f"scsr: {number} of {len(places)}: {source}", file=sys.stderr, flush=True)
            rows.append(_solve(source, picture, solving, reading or Reading(), picked, check, progress(quiet)))
            if rows[-1].picture is None:
                say_error(f"{source}: {rows[-1].result}")
    finally:
        if rows and not quiet:
            print("\n".join(_table(rows, len(places))), flush=True)
    if all(row.picture is not None for row in rows):
        return 0
    return 1 if any(row.begun for row in rows) else 2


class _Row(NamedTuple):
    """A row of the table: the recording `source`; its `picture`, None where none was written; the `result` in words;
    whether the solve was `begun`; `seconds` from the first read to the last write."""

    source: Path
    picture: Path | None
    result: str
    begun: bool
    seconds: float


def _places(patterns: tuple[str, ...], folder: Path, ending: str) -> dict[Path, Path]:
    """Recording → picture. A name that is that of a file stands for it, whatever is in it; a pattern that matches
    nothing stands for itself, and is refused as a file that is not there.

    **Raises:** `InputError` if there is none, or two would have the same picture.
    """
    if not patterns:
        raise InputError("scsr batch needs FILE, which is missing: recordings, or patterns such as 'recordings/*.dat'.")
    sources: list[Path] = []
    for pattern in patterns:
        if is_url(pattern):
            raise InputError(f"{pattern} is a URL, but scsr batch reads files of this machine: take scsr solve for it.")
        found = [] if os.path.exists(pattern) else sorted(glob.glob(pattern, recursive=True))
        sources += [Path(name) for name in found or [pattern]]
    present = {source for source in sources if source.is_file()} or set(sources)
    top = os.path.commonpath([os.path.abspath(source.parent) for source in present])
    places = {}
    for source in dict.fromkeys(sources):
        below = os.path.relpath(os.path.abspath(source.parent), top) if source in present else "."
        places[source] = folder / below / f"{source.stem}.{ending}"
    picture, times = Counter(places[source] for source in places if source in present).most_common(1)[0]
    if times > 1:
        both = " and ".join(str(source) for source, place in places.items() if place == picture)
        raise InputError(f"{both} would have the same picture, {picture}: give them in two runs.")
    return places


def _solve(
    source: Path,
    picture: Path,
    solving: Solving,
    reading: Reading,
    picked: dict[str, Any],
    check: Callable[[Path, Path], None],
    meter: Progress,
) -> _Row:
    """Solves for a recording and writes its picture and report; whatever fails becomes the result.

    **Arguments:** `picked`: further arguments of `solved`; `check`: raises an error if the picture or the report cannot
    be written.
    """
    began, begun, written, report = time.perf_counter(), False, None, picture.with_suffix(".json")
    made = [folder for folder in (picture.parent, *picture.parent.parents) if not folder.exists()]
    try:
        if source.is_file():  # or there is nothing to make a folder for
            picture.parent.mkdir(parents=True, exist_ok=True)
            check(picture, report)
        solution, numbers = solved(source, solving, reading, **picked, meter=meter)
        begun = True
        numbers.write(report)
        result = solution.status.clause
        if solution.status.usable:
            solution.save(picture)
            written = picture
    except Exception as error:
        if os.environ.get("SCSR_TRACEBACK") or signal_behind(error) is not None:
            raise
        result = sentence(error).rstrip(".")
    finally:
        with suppress(OSError):  # something is in it, or it was not made
            for folder in made:
                folder.rmdir()
    return _Row(source, written, result, begun, time.perf_counter() - began)


def _table(rows: list[_Row], asked: int) -> list[str]:
    """Lines of the table, and a sentence."""
    head = ("recording", "picture", "seconds", "result")
    cells = [(str(row.source), str(row.picture or "–"), f"{row.seconds:.1f}", row.result) for row in rows]
    wide = [max(len(line[column]) for line in (head, *cells)) for column in range(3)]
    written = sum(row.picture is not None for row in rows)
    lines = [
        f"{name:{wide[0]}}  {picture:{wide[1]}}  {seconds:>{wide[2]}}  {result}"
        for name, picture, seconds, result in (head, *cells)
    ]
    return [*lines, f"{written} of {asked} {'picture' if asked == 1 else 'pictures'} written."]
