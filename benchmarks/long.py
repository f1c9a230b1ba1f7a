"""Memory of a sequence from a long recording: whether it stays the same from the first quarter to the last.

    python -m benchmarks.long FILE [FILE …] --size 400x250 [--frames 100000] [--every 500] [--scale 2]

FILEs are .dat recordings of one size, whose rows have no bits but their pixels. Their frames, one file after the other,
again and again, are written to a recording of so many frames; `scsr sequence` makes a store of it. Each quarter of the
recording holds the same frames, so that a difference between quarters is one of time and not of what is seen. Resident
memory of the process is read twice a second. The table has the pictures that were there at the end of each quarter, its
peak, and its seconds. Exit code 1 if the last quarter's peak is more than 5 % above the first one's, or a picture is
missing.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.memory import resident
from scsr_opt.camera import parse_size

_FLAT = 1.05  # the last quarter's peak over the first one's, at most


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--size", required=True)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--every", type=int, default=500)
    parser.add_argument("--scale", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="where recording and store are made; a temporary one if not given")
    chosen = parser.parse_args()
    width, height = parse_size(chosen.size)
    with tempfile.TemporaryDirectory(dir=chosen.folder) as temporary:
        folder = Path(temporary)
        recording = looped(chosen.files, folder / "long.dat", -(-width * height // 8), chosen.frames)
        command = [sys.executable, "-m", "scsr_opt.cli", "sequence", str(recording), "--size", chosen.size]
        command += ["--start", "0", "--stop", str(chosen.frames), "--every", str(chosen.every)]
        command += ["--scale", str(chosen.scale), "-o", str(folder / "long.zarr"), "--quiet"]
        seen = watched(subprocess.Popen(command), folder / "long.zarr")
    pictures = -(-chosen.frames // chosen.every)
    print(table(quarters(seen, pictures)))
    peaks = [peak for _, peak, _ in quarters(seen, pictures)]
    share = peaks[-1] / peaks[0]
    print(f"{seen[-1][1]} of {pictures} pictures; the last quarter's peak is {share:.3f} of the first one's.")
    return 0 if seen[-1][1] == pictures and share <= _FLAT else 1


def looped(files: list[Path], path: Path, frame_bytes: int, frames: int) -> Path:
    """Writes a recording of so many frames: those of the files, again and again, anew in each quarter."""
    parts = [file.read_bytes() for file in files]
    once = b"".join(part[: len(part) // frame_bytes * frame_bytes] for part in parts)
    ends = [frames * quarter // 4 * frame_bytes for quarter in range(5)]
    with path.open("wb") as stream:
        for begin, end in zip(ends, ends[1:], strict=False):
            left = end - begin
            while left > 0:
                left -= stream.write(once[:left])
    return path


def watched(process: "subprocess.Popen[bytes]", store: Path) -> list[tuple[float, int, int]]:
    """Seconds since its start, pictures that are there, and resident memory in MB, until the process ends."""
    began, seen = time.perf_counter(), [(0.0, 0, 0)]
    while process.poll() is None:
        there = len(list(store.glob("image/c/*")))
        seen.append((time.perf_counter() - began, there, resident(process.pid)))
        time.sleep(0.5)
    there = len(list(store.glob("image/c/*")))
    return [*seen, (time.perf_counter() - began, there, 0)]


def quarters(seen: list[tuple[float, int, int]], pictures: int) -> list[tuple[int, int, float]]:
    """A row for each quarter of the pictures: pictures that were there at its end, peak of resident memory in MB, and
    seconds that it took. `seen` is what `watched` returns."""
    found, before = [], 0.0
    for quarter in range(4):
        part = [one for one in seen if min(4 * one[1] // pictures, 3) == quarter]
        end = part[-1][0] if part else before
        found.append((part[-1][1] if part else 0, max((one[2] for one in part), default=0), end - before))
        before = end
    return found


def table(rows: list[tuple[int, int, float]]) -> str:
    """The rows of `quarters` as a table in Markdown."""
    lines = ["| quarter | pictures there | peak, MB | seconds |", "|---|--:|--:|--:|"]
    return "\n".join(
        lines + [f"| {n} | {there} | {peak} | {taken:.0f} |" for n, (there, peak, taken) in enumerate(rows, 1)]
    )


if __name__ == "__main__":
    sys.exit(main())
