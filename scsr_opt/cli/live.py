"""`scsr sequence -`: pictures of a stream that comes through standard input."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scsr_opt.cli.options import Reading, progress, say_error, say_failure
from scsr_opt.cli.solving import Solving
from scsr_opt.errors import InputError

if TYPE_CHECKING:
    from scsr_opt.sequences.live import LiveOutput, LiveSequence

STDIN = 0
"""Descriptor of standard input. Not `sys.stdin`: a thread that waits in its reader would hold a lock that Python wants
when it ends."""


def live_output(path: Path, *, latest: bool, bits: int | None, gamma: float | None, overwrite: bool) -> "LiveOutput":
    """Where the pictures of a stream go. **Raises:** `InputError` if they cannot be written there."""
    from scsr_opt.sequences.live import LatestPicture, LiveFolder

    if latest:
        return LatestPicture(path, bits=bits, gamma=1.0 if gamma is None else gamma, overwrite=overwrite)
    return LiveFolder(path, bits=bits, gamma=gamma, overwrite=overwrite)


def follow(path: Path, output: "LiveOutput", reading: Reading, solving: Solving, *, quiet: bool, **picked: Any) -> int:
    """Writes pictures until the stream ends, or the process is interrupted, and says what came of it in either case.

    **Arguments:** `path`: of the output, for people; `picked`: further arguments of `LiveSequence`.

    **Returns:** the exit code.
    """
    from scsr_opt.sequences.live import LiveSequence

    stream, crop = reading.stream(_descriptor())
    choices = reading.corrections() | solving.several(stream.recording, picked["scale"], crop)
    live = LiveSequence(stream, output, **picked, **choices)
    try:
        live.run(progress(quiet))
    finally:
        if not quiet and live.written + live.failed:
            print("\n".join(_lines(path, live)), flush=True)
    if live.failed:
        what = f"{live.failed} of {live.failed + live.written} pictures could not be solved for, the last one"
        say_failure(what, live.failure or "")
        return 1
    if stream.fault is not None:
        say_error(f"The stream could not be read any further: {(stream.fault.strerror or str(stream.fault)).lower()}.")
        return 2
    return 0


def _descriptor() -> int:
    try:
        os.fstat(STDIN)
    except OSError:
        raise InputError("Standard input is closed: pipe the frames of a camera into scsr sequence -.") from None
    if os.isatty(STDIN):
        raise InputError("Standard input is a terminal: pipe the frames of a camera into scsr sequence -.")
    return STDIN


def _lines(path: Path, live: "LiveSequence") -> list[str]:
    """The sentences that are printed at the end."""
    stream, written = live.stream, live.written
    few = {0: "no picture", 1: f"1 picture of frame {live.first}"}
    count = few.get(written, f"{written} pictures of frames {live.first} to {live.last}")
    lines = [f"{path}: {count} written; {stream.frames} frames were read."]
    if live.dropped:
        before = f", {live.dropped_before} of them before the first picture" if live.dropped_before else ""
        keys = "1 key frame was" if live.dropped == 1 else f"{live.dropped} key frames were"
        lines.append(f"{keys} dropped{before}, as the solve did not keep up with the stream.")
    else:
        lines.append("No key frame was dropped.")
    if written:
        lines.append(
            f"Delay from the arrival of a key frame to its picture: {live.delay:.2g} s (median), {live.longest:.2g} s "
            f"at most."
        )
    if stream.cut:
        lines.append(f"The stream ended inside a frame: its last {stream.cut:,} bytes were not used.")
    return lines if live.white is None else [*lines, live.white.sentence]
