"""`benchmarks.long`: its recording, and what its table says of a run that was watched."""

from benchmarks.long import looped, quarters


def test_looped_recording_repeats_whole_frames_in_each_quarter(tmp_path):
    for name, content in (("a", b"\1\2\3\4!"), ("b", b"\5\6")):
        (tmp_path / name).write_bytes(content)
    made = looped([tmp_path / "a", tmp_path / "b"], tmp_path / "made", 2, 16)
    assert made.read_bytes() == 4 * b"\1\2\3\4\5\6\1\2"


def test_quarters_have_their_own_peaks():
    seen = [
        (0.0, 0, 0),
        (1.0, 0, 50),
        (2.0, 2, 70),
        (3.0, 2, 90),
        (5.0, 5, 60),
        (6.0, 7, 40),
        (8.0, 8, 30),
        (9.0, 8, 0),
    ]
    assert quarters(seen, 8) == [(0, 50, 1.0), (2, 90, 2.0), (5, 60, 2.0), (8, 40, 4.0)]


def test_quarters_of_a_run_that_ended_too_early():
    assert quarters([(0.0, 0, 0), (1.0, 1, 50), (2.0, 1, 0)], 8) == [
        (1, 50, 2.0),
        (0, 0, 0.0),
        (0, 0, 0.0),
        (0, 0, 0.0),
    ]
