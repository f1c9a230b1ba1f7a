"""A stream of frames as from a camera, to try `scsr sequence -` with: a recording again and again, at a steady rate.

    python -m benchmarks.stream FILE --size 400x250 [--rate 20000] [--seconds 10] | scsr sequence - --size 400x250 …

FILE is a .dat whose rows have no bits but their pixels. Frames go to standard output; how many were written, and by how
much the reader made them late, to standard error at the end.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import BinaryIO

from scsr_opt.camera import parse_size

# Frames that are written at once.
_AT_ONCE = 40


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--size", required=True)
    parser.add_argument("--rate", type=float, default=20_000.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    chosen = parser.parse_args()
    width, height = parse_size(chosen.size)
    content = chosen.file.read_bytes()
    total = round(chosen.rate * chosen.seconds)
    written, late = stream(content, -(-width * height // 8), sys.stdout.buffer, rate=chosen.rate, total=total)
    print(f"{written} of {total} frames were written, {late:.3g} s late at most.", file=sys.stderr)
    return 0


def stream(content: bytes, frame_bytes: int, output: BinaryIO, *, rate: float, total: int) -> tuple[int, float]:
    """Writes `total` frames of a recording, `rate` per second, from its beginning again and again.

    **Returns:** how many were written before the reader closed the pipe, and the most by which one was late, seconds.
    """
    frames = len(content) // frame_bytes
    twice = memoryview(content[: frames * frame_bytes] * 2)
    began, written, late = time.monotonic(), 0, 0.0
    while written < total:
        behind = time.monotonic() - began - written / rate
        late = max(late, behind)
        time.sleep(max(-behind, 0.0))
        count = min(_AT_ONCE, total - written, frames)
        first = written % frames
        try:
            output.write(twice[first * frame_bytes : (first + count) * frame_bytes])
            output.flush()
        except BrokenPipeError:
            break
        written += count
    return written, late


if __name__ == "__main__":
    sys.exit(main())
