"""`benchmarks.stream`: the frames of a recording in order, again and again, not faster than asked for."""

import io
import time

import pytest

from benchmarks.stream import stream


@pytest.mark.parametrize("frames", [7, 50])
def test_stream_repeats_the_recording_at_the_rate(frames):
    content, output = bytes(range(2 * frames)), io.BytesIO()
    began = time.monotonic()
    written, _ = stream(content + b"!", 2, output, rate=1000.0, total=130)
    assert written == 130 and time.monotonic() - began >= 0.08
    assert output.getvalue() == (content * 20)[:260]


def test_stream_ends_with_its_reader():
    class Closed(io.BytesIO):
        def write(self, _):
            raise BrokenPipeError

    assert stream(bytes(20), 2, Closed(), rate=1000.0, total=130)[0] == 0
