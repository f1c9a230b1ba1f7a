"""Pictures of a stream: those of the file, as many as the solve keeps up with, in memory that does not grow."""

import csv
import os
import threading
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scsr_opt import InputError, Recording, Solution, reconstruct
from scsr_opt.camera import read_recording, write_recording
from scsr_opt.camera.stream import open_stream
from scsr_opt.camera.white import White
from scsr_opt.motion import Global
from scsr_opt.report import read_picture
from scsr_opt.sequences import LatestPicture, LiveFolder, LiveSequence
from scsr_opt.sequences.live import _Moment, _Newest

HEIGHT, WIDTH = 8, 12  # of the recordings of the stand-in


class Camera:
    """A pipe, its end to read from in `descriptor`, and a thread that writes into it, `pause` before every 50 frames.

    `frames`: (T, bytes), written one after the other.
    """

    def __init__(self, frames: np.ndarray, pause: Callable[[int], None] = lambda _: None):
        self.descriptor, self._writing = os.pipe()
        self._thread = threading.Thread(target=self._write, args=(frames, pause))
        self._thread.start()

    def _write(self, frames: np.ndarray, pause: Callable[[int], None]) -> None:
        try:
            for start in range(0, len(frames), 50):
                pause(start)
                os.write(self._writing, frames[start : start + 50].tobytes())
        except BrokenPipeError:
            pass
        os.close(self._writing)

    def close(self) -> None:
        """Closes the end to read from, and waits for the thread."""
        os.close(self.descriptor)
        self._thread.join()


@pytest.fixture
def camera() -> Iterator[Callable[..., Camera]]:
    """Makes cameras, and closes them."""
    made: list[Camera] = []

    def make(*arguments) -> Camera:
        made.append(Camera(*arguments))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.fixture
def solves(monkeypatch, stand_in) -> list[tuple[Recording, int]]:
    """Puts the stand-in in the place of `reconstruct`; what it was called with."""
    calls: list[tuple[Recording, int]] = []

    def solve(recording, *, scale, key, options) -> Solution:
        calls.append((recording, key))
        (solution,) = stand_in(recording, [key], scale=scale, options=options)
        return replace(solution, white=White(0.5 + key))

    monkeypatch.setattr("scsr_opt.sequences.live.reconstruct", solve)
    return calls


def steady(frames: int) -> np.ndarray:
    """Packed frames, (T, 12), of pixels that fire as those of a camera do, each at a rate of its own."""
    rate = np.random.default_rng(1).uniform(0.1, 0.6, HEIGHT * WIDTH)
    spikes = np.diff(np.floor(np.arange(frames + 1)[:, None] * rate), axis=0).astype(np.uint8)
    return np.packbits(spikes, axis=1, bitorder="little")


def live(camera: Camera, output, **given) -> LiveSequence:
    stream = open_stream(camera.descriptor, size=(WIDTH, HEIGHT))
    return LiveSequence(stream, output, **{"scale": 2, "every": 100, **given})


@pytest.mark.filterwarnings("ignore:The solve does not keep up")
@pytest.mark.parametrize(
    ("frames", "given"),
    [
        (1500, {"every": 70}),
        (1500, {"every": 7, "start": 3, "frames": 31}),
        (1500, {"every": 70, "bad_pixels": None}),
        (1500, {"every": 70, "bad_pixels": None, "light": "constant"}),
        (1500, {"every": 70, "light": "constant", "frames": 501}),
        (300, {"every": 20}),
        (1500, {"every": 150, "stop": 1000}),
    ],
)
def test_a_key_frame_has_the_frames_that_it_has_in_the_file(tmp_path, camera, solves, frames, given):
    """All that are read for its picture: the clip, and those around by which bad pixels and light are found."""
    content = steady(frames)
    (tmp_path / "a.dat").write_bytes(content.tobytes())
    recording = read_recording(tmp_path / "a.dat", size=(WIDTH, HEIGHT))
    followed = live(camera(content), LiveFolder(tmp_path / "out"), **given)
    followed.run()
    last = (min(given.get("stop", frames), frames) - 1 - given.get("start", 0)) // given["every"] * given["every"]
    assert solves[-1][1] == last + given.get("start", 0)
    assert len(solves) + followed.dropped == last // given["every"] + 1
    clip = given.get("frames", 101)
    for held, key in solves:
        counts = [clip] if "bad_pixels" in given else [clip, 400]
        ranges = [recording.around(key, count) for count in counts]
        assert ranges == [held.around(key, count) for count in counts]
        if given.get("light") != "constant":
            start = ranges[0][0] + (clip - 801) // 2
            ranges.append((max(0, start), min(frames, ranges[0][0] + (clip + 801) // 2)))
        for start, stop in ranges:
            np.testing.assert_array_equal(held.window(start, stop), recording.window(start, stop))


@pytest.mark.filterwarnings("ignore:The solve does not keep up")
def test_pictures_equal_those_of_the_file(tmp_path, camera):
    """By real solves of a scene that moves, in which gains, strength and bad pixels are found."""
    from skimage import data

    from scsr_opt.camera import Sensor, simulate
    from scsr_opt.camera.scenes import Translation

    scene = Translation(data.camera()[60:156, 200:328], (0.05, 0.1), key=100)
    made = simulate(scene, scale=4, frames=1100, sensor=Sensor(white_rate=0.6, photons=1000))
    write_recording(tmp_path / "car.dat", Recording.from_array(made.spikes))
    recording = read_recording(tmp_path / "car.dat", size="32x24")
    content = np.fromfile(tmp_path / "car.dat", np.uint8).reshape(1100, -1)
    options = {"scale": 1, "frames": 41, "motion": Global(affine=False)}
    stream = open_stream(camera(content).descriptor, size="32x24")
    followed = LiveSequence(stream, LiveFolder(tmp_path / "out", bits=32), every=400, start=60, **options)
    followed.run()
    names = sorted(os.listdir(tmp_path / "out" / "images"))
    assert names[-1] == "0000000860.tif" and len(names) == followed.written
    for name in names:
        expected = reconstruct(recording, key=int(name[:-4]), **options)
        np.testing.assert_array_equal(read_picture(tmp_path / "out" / "images" / name), expected.image)


def wait_for(condition: Callable[[], bool]) -> None:
    for _ in range(4000):
        if condition():
            return
        threading.Event().wait(0.005)
    raise AssertionError("waited in vain")


def test_a_solve_that_does_not_keep_up_gets_the_newest_key_frame(tmp_path, camera, solves, monkeypatch):
    """The others are dropped and counted, with a warning once a picture was there. The first solve ends when 2,000
    frames have come, the second one when all have."""
    import scsr_opt.sequences.live as module

    solve, begun = module.reconstruct, []

    def slow(*given, **named):
        begun.append(given)
        if len(begun) == 1:
            wait_for(lambda: followed.stream.frames >= 2000)
        elif len(begun) == 2:
            wait_for(lambda: followed._newest._ended)
        return solve(*given, **named)

    def pause(start: int) -> None:
        number = {1000: 1, 2500: 2}.get(start, 0)
        wait_for(lambda: len(begun) >= number)

    monkeypatch.setattr(module, "reconstruct", slow)
    followed = live(camera(steady(4000), pause), LiveFolder(tmp_path / "out"))
    with pytest.warns(UserWarning, match="The solve does not keep up with the stream, and key frames are dropped"):
        followed.run()
    solved = [key for _, key in solves]
    assert len(solved) == 3 and solved == sorted(solved) and solved[-1] == 3900
    assert followed.written == 3 and followed.dropped == 40 - 3
    assert followed.first == solved[0] and followed.last == 3900
    with open(tmp_path / "out" / "times.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["key_frame"]) for row in rows] == solved
    assert [int(row["number"]) for row in rows] == [key // 100 for key in solved]
    assert [row["file"] for row in rows] == sorted(os.listdir(tmp_path / "out" / "images"))


def test_the_newest_is_handed_over(recording):
    newest = _Newest()
    moments = [_Moment(key, recording, 0.0) for key in range(4)]
    for moment in moments[:3]:
        newest.put(moment)
    iterator = iter(newest)
    assert next(iterator) is moments[2] and newest.dropped == 2
    newest.put(moments[3])
    newest.end()
    assert list(newest) == [moments[3]] and newest.dropped == 2


@pytest.mark.filterwarnings("ignore:The solve does not keep up")
def test_memory_does_not_grow_with_the_stream(tmp_path, camera, solves, stand_in, monkeypatch):
    """The long one has 430 kB more; the first one is for what is imported and kept."""
    import scsr_opt.sequences.live as module

    solve = module.reconstruct

    def forgetful(*given, **named):
        solution = solve(*given, **named)
        del solves[:], stand_in.solved[:]
        return solution

    def peak(frames: int, name: str) -> int:
        followed = live(camera(steady(frames)), LatestPicture(tmp_path / name))
        tracemalloc.start()
        followed.run()
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    monkeypatch.setattr(module, "reconstruct", forgetful)
    _, short, long = peak(2000, "first.png"), peak(4000, "short.png"), peak(40_000, "long.png")
    assert long < short + 100_000


@pytest.mark.filterwarnings("ignore:The solve does not keep up")
def test_the_latest_picture_is_whole_whenever_it_is_read(tmp_path, camera, solves, monkeypatch):
    import scsr_opt.sequences.live as module

    solve, seen = module.reconstruct, []

    def watched(*given, **named):
        if solves:
            seen.append(read_picture(tmp_path / "a.tif").mean())
        return solve(*given, **named)

    monkeypatch.setattr(module, "reconstruct", watched)
    followed = live(camera(steady(3000)), LatestPicture(tmp_path / "a.tif", bits=32), every=50)
    followed.run()
    assert os.listdir(tmp_path) == ["a.tif"] and seen == sorted(seen) and len(seen) == followed.written - 1
    assert read_picture(tmp_path / "a.tif").mean() == pytest.approx(0.1 + 29.5, abs=0.02)


@pytest.mark.filterwarnings("ignore:The solve does not keep up")
@pytest.mark.parametrize("white", [None, 0.8])
def test_pictures_of_a_stream_have_one_white(tmp_path, camera, solves, monkeypatch, white):
    """That of the first one, or as given."""
    saved = []
    save = Solution.save

    def watched(solution, *given, **named):
        saved.append(solution.white.level)
        save(solution, *given, **named)

    monkeypatch.setattr(Solution, "save", watched)
    followed = live(camera(steady(3000)), LiveFolder(tmp_path / "out"), every=50, white=white)
    followed.run()
    assert set(saved) == {0.5 + (followed.first or 0) if white is None else white} and len(saved) > 0


@pytest.mark.filterwarnings("ignore:The solve does not keep up")
def test_a_picture_that_fails_is_counted_and_has_a_row(tmp_path, camera, solves):
    """Key frame 44 is that of which the stand-in's solve fails."""
    followed = live(camera(steady(300)), LiveFolder(tmp_path / "out"), start=44, every=300)
    followed.run()
    assert (followed.failed, followed.written, followed.first) == (1, 0, None) and followed.white is None
    assert followed.failure is not None and followed.delay == 0
    assert (tmp_path / "out" / "times.csv").read_text().splitlines()[1] == "0,,44,0.0011,non_finite,44"
    assert os.listdir(tmp_path / "out" / "images") == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, InputError])
def test_an_interruption_leaves_what_is_there_and_no_thread(tmp_path, camera, solves, stand_in, error):
    stand_in.stop_after, stand_in.error = 1, error("full")
    going_on = threading.Event()

    def pause(start: int) -> None:
        while start == 1000 and not solves:
            going_on.wait(0.01)
        if start == 1500:  # while the stream says nothing
            going_on.wait(20)

    followed = live(camera(steady(5000), pause), LiveFolder(tmp_path / "out"), every=200)
    try:
        with pytest.raises(error):
            followed.run()
    finally:
        going_on.set()
    assert followed.written == 1 and followed.delay > 0 and followed.longest == followed.delay
    assert len(os.listdir(tmp_path / "out" / "images")) == 1
    assert not [thread for thread in threading.enumerate() if thread.name == "scsr-stream"]


def test_a_fault_of_the_reader_comes_out(tmp_path, camera, solves, monkeypatch):
    followed = live(camera(steady(1000)), LiveFolder(tmp_path / "out"))
    monkeypatch.setattr(followed.stream, "held", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        followed.run()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: LiveFolder(path / "a.zarr"), "nobody knows how long it gets: name a folder"),
        (lambda path: LiveFolder(path / "a.mp4"), "nobody knows how long it gets"),
        (lambda path: LiveFolder(path / "there"), "is a folder with a file .*, which is not of a sequence"),
        (lambda path: LiveFolder(path / "there", overwrite=True), "is a folder with a file "),
        (lambda path: LiveFolder(path / "before"), "is there already: give --overwrite"),
        (lambda path: LiveFolder(path / "none" / "out"), "does not exist"),
        (lambda path: LiveFolder(path / "out", bits=12), "bits is 12, but the pictures of a folder have 8, 16 or 32"),
        (lambda path: LatestPicture(path / "a.gif"), "its ending is '.gif', but pictures end in"),
        (lambda path: LatestPicture(path / "out"), "its ending is 'missing'"),
        (lambda path: LatestPicture(path / "a.png", bits=32), "32 bits per pixel cannot be stored in .png"),
        (lambda path: LatestPicture(path / "there.png"), "there.png is there already"),
        (lambda path: LatestPicture(path / "none" / "a.png"), "does not exist"),
    ],
)
def test_outputs_of_a_stream_are_refused(tmp_path, make, message):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "thesis.txt").touch()
    (tmp_path / "before" / "images").mkdir(parents=True)
    (tmp_path / "there.png").touch()
    with pytest.raises(InputError, match=message):
        make(tmp_path)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"every": 0}, "every is 0"),
        ({"start": -1}, "start is -1"),
        ({"start": 100, "stop": 100}, "stop is 100"),
        ({"scale": 0}, "scale is 0"),
        ({"white": -1}, "white is -1"),
        ({"frames": 0}, "frames is 0"),
        ({"strenght": 1}, "did you mean strength"),
    ],
)
def test_a_live_sequence_that_cannot_be_is_refused(tmp_path, camera, given, message):
    with pytest.raises(InputError, match=message):
        live(camera(steady(200)), LiveFolder(tmp_path / "out"), **given)
    assert not Path(tmp_path / "out").exists()


def test_overwrite_replaces_the_pictures_of_another_run(tmp_path, camera, solves):
    for key in (10, 60):
        one = camera(steady(200))
        live(one, LiveFolder(tmp_path / "out", overwrite=key == 60), start=key, every=200).run()
    assert os.listdir(tmp_path / "out" / "images") == ["0000000060.png"]
    assert len((tmp_path / "out" / "times.csv").read_text().splitlines()) == 2
