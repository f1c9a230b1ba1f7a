"""Flat files: layouts found by length and bits, and remarks where bits do not look like spikes of that size."""

import itertools
import math
import warnings
import zlib
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from scsr_opt.camera.formats import read_recording, write_recording
from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.errors import InputError

RECORDINGS = ["real_car_400x250.dat", "reds_200_part1_400x250_key150.dat", "reds_203_part1_400x250_key150.dat"]


def _smooth(height: int, width: int, sigma: float = 2.0, seed: int = 5) -> np.ndarray:
    smooth = gaussian_filter(np.random.default_rng(seed).standard_normal((height, width)), sigma)
    return 0.05 + 0.9 * (smooth - smooth.min()) / np.ptp(smooth)


def _spikes(frames: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    return simulate(Static(_smooth(height, width)), scale=1, frames=frames, seed=seed).spikes


def _fast(frames: int, height: int, width: int) -> np.ndarray:
    """Spikes of a still picture by counting whole thresholds, over again after 32 frames: for large sensors."""
    if frames > 32:
        return np.concatenate([_fast(32, height, width)] * (frames // 32 + 1))[:frames]
    rate, phase = 0.6 * _smooth(height, width), np.random.default_rng(1).random((height, width))
    count = [np.floor(phase + rate * time) for time in range(frames + 1)]
    return np.diff(np.stack(count), axis=0).astype(np.uint8)


def _quiet(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_recording(path, **options)


# Rows of 1,024 bits -------------------------------------------------------------------------------------------------


def _markers(kind: str, frames: int) -> np.ndarray:
    """(frames, 1000, 2, 12) marker bits: line and channel as the camera's own reader takes them apart, or others."""
    line = np.arange(1000) % 500 + 1
    value = {
        "line and channel": np.stack([line | half << 10 | (np.arange(1000) // 500) << 11 for half in (0, 1)], axis=-1),
        "constant": np.full((1000, 2), 0xA5B),
        "zeros": np.zeros((1000, 2), int),
        "ones": np.full((1000, 2), 0xFFF),
        "row number": np.stack([np.arange(1000)] * 2, axis=-1),
    }[kind]
    return np.broadcast_to((value[..., None] >> np.arange(12)) & 1, (frames, 1000, 2, 12)).astype(np.uint8)


def _with_markers(spikes: np.ndarray, kind: str) -> bytes:
    markers = _markers(kind, len(spikes))
    halves = [np.concatenate([spikes[:, :, 500 * n : 500 * n + 500], markers[:, :, n]], axis=2) for n in (0, 1)]
    rows = np.concatenate(halves, axis=2)
    assert rows.shape[2] == 1024
    return np.packbits(rows.reshape(len(rows), -1), axis=1, bitorder="little").tobytes()


@pytest.mark.parametrize(
    ("kind", "frames"),
    [("line and channel", 1), ("line and channel", 10), ("constant", 25), ("zeros", 2), ("ones", 3), ("row number", 4)],
)
def test_rows_of_1024_bits_are_found_by_the_length(tmp_path, kind, frames):
    spikes, path = _fast(frames, 1000, 1000), tmp_path / "r_1000x1000.dat"
    path.write_bytes(_with_markers(spikes, kind))
    assert path.stat().st_size == 128_000 * frames
    for options in ({}, {"row_bits": 1024}):
        np.testing.assert_array_equal(_quiet(path, flip=False, **options).spikes, spikes)


@pytest.mark.parametrize("kind", ["line and channel", "constant"])
def test_rows_of_1024_bits_are_found_by_the_markers(tmp_path, kind):
    """125 frames with markers are as long as 128 without."""
    spikes, path = _fast(125, 1000, 1000), tmp_path / "r_1000x1000.dat"
    path.write_bytes(_with_markers(spikes, kind))
    recording = _quiet(path, flip=False)
    assert recording.shape == (125, 1000, 1000)
    for frame in (0, 60, 124):
        np.testing.assert_array_equal(recording.window(frame, frame + 1)[0], spikes[frame])


def test_rows_of_1024_bits_cut_short_are_found_by_the_markers(tmp_path):
    spikes, path = _fast(11, 1000, 1000), tmp_path / "r_1000x1000.dat"
    path.write_bytes(_with_markers(spikes, "line and channel")[:-77])
    with pytest.warns(UserWarning, match=r"the last 127,923 bytes are not a whole frame"):
        np.testing.assert_array_equal(read_recording(path, flip=False).spikes, spikes[:10])


@pytest.mark.parametrize("frames", [1, 10, 128])
def test_rows_of_1000_bits_stay_what_they_are(tmp_path, frames):
    spikes = _fast(frames, 1000, 1000)
    recording = _quiet(write_recording(tmp_path / "r_1000x1000.dat", spikes))
    assert recording.shape == spikes.shape
    np.testing.assert_array_equal(recording.window(frames - 1, frames), spikes[-1:])


@pytest.mark.parametrize(("width", "row_bits"), [(400, 416), (1000, 1024), (1000, 1008), (40, 48), (7, 9)])
def test_write_recording_of_padded_rows_is_read_back(tmp_path, width, row_bits):
    spikes = _spikes(9, 16, width)
    path = write_recording(tmp_path / "r.dat", spikes, row_bits=row_bits)
    np.testing.assert_array_equal(read_recording(path, size=(width, 16), row_bits=row_bits).spikes, spikes)


# Frames that do not begin on whole bytes ----------------------------------------------------------------------------

ODD = [(25, 13), (13, 25), (7, 7), (33, 17), (3, 3), (15, 5), (50, 33), (101, 3), (9, 121), (31, 31)]


@pytest.mark.parametrize("flip", [True, False])
@pytest.mark.parametrize(("width", "height"), ODD)
def test_frames_packed_without_padding_are_read(tmp_path, width, height, flip):
    spikes, path = _spikes(101, height, width), tmp_path / "r.dat"
    stored = spikes[:, ::-1] if flip else spikes
    path.write_bytes(np.packbits(stored.reshape(-1), bitorder="little").tobytes())
    recording = read_recording(path, size=(width, height), flip=flip)
    np.testing.assert_array_equal(recording.spikes, spikes)
    np.testing.assert_array_equal(recording.window(50, 53), spikes[50:53])


@pytest.mark.parametrize(("width", "height"), ODD)
def test_frames_packed_with_padding_stay_what_they_are(tmp_path, width, height):
    spikes = _spikes(101, height, width)
    path = write_recording(tmp_path / "r.dat", spikes)
    np.testing.assert_array_equal(_quiet(path, size=(width, height)).spikes, spikes)


@pytest.mark.parametrize(("width", "height"), [(33, 31), (31, 33), (15, 9), (9, 7), (63, 33), (101, 3)])
def test_a_short_file_of_either_packing_is_never_misread_without_a_word(tmp_path, width, height):
    """Up to seven frames are as long in both packings, and the bits that would fill them up may be zero by chance."""
    path, told = tmp_path / "r.dat", 0
    for seed, frames in itertools.product(range(2), range(2, 8)):
        spikes = simulate(Static(_smooth(height, width, seed=seed)), scale=1, frames=frames, seed=seed).spikes
        for content in (spikes.reshape(-1), spikes.reshape(frames, -1)):
            path.write_bytes(np.packbits(content, axis=-1, bitorder="little").tobytes())
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                recording = read_recording(path, size=(width, height), flip=False)
            if not caught:
                np.testing.assert_array_equal(recording.spikes, spikes)
                told += 1
            else:
                assert "may follow each other without, and the content does not tell" in str(caught[0].message)
    assert told > 6


@pytest.mark.parametrize("frames", [9, 12, 30, 61])
@pytest.mark.parametrize(("width", "height"), [(25, 13), (13, 25), (33, 17), (15, 5)])
def test_dark_frames_packed_without_padding_are_read_where_only_they_fit(tmp_path, width, height, frames):
    """In the dark the bits that would fill up a frame are zero by chance, and the length alone decides."""
    spikes = (np.random.default_rng(frames).random((frames, height, width)) < 0.01).astype(np.uint8)
    np.packbits(spikes.reshape(-1), bitorder="little").tofile(tmp_path / "r.dat")
    recording = _quiet(tmp_path / "r.dat", size=(width, height), flip=False)
    np.testing.assert_array_equal(recording.spikes, spikes)


def test_frames_of_neither_packing_are_refused(tmp_path):
    (tmp_path / "r.dat").write_bytes(np.random.default_rng(0).bytes(41 * 300 + 7))
    with pytest.raises(InputError, match="holds set bits where a frame of 25x13, .* is filled up with zeros"):
        read_recording(tmp_path / "r.dat", size="25x13")


# Bits that are no spikes of that size -------------------------------------------------------------------------------


def _garbage(kind: str) -> bytes:
    rng = np.random.default_rng(2)
    events = np.stack([np.cumsum(rng.integers(0, 30, 50_000)), rng.integers(0, 1 << 28, 50_000)], axis=1)
    return {
        "random": rng.bytes(300_000),
        "compressed": zlib.compress(rng.integers(0, 50, 500_000, np.uint8).tobytes())[2:],
        "events": events.astype(np.uint32).tobytes(),
        "picture": (255 * _smooth(600, 600, 5)).astype(np.uint8).tobytes(),
        "float": _smooth(300, 300).astype(np.float32).tobytes(),
        "spikes of a byte each": (rng.random(2_000_000) < 0.2).astype(np.uint8).tobytes(),
        "bytes from 1 to 9": rng.integers(1, 10, 300_000, np.uint8).tobytes(),
        "bits drawn at random": np.packbits(rng.random(2_400_000) < 0.1).tobytes(),
    }[kind]


@pytest.mark.parametrize("size", ["64x64", "400x250"])
@pytest.mark.parametrize(
    "kind",
    [
        "random",
        "compressed",
        "events",
        "picture",
        "float",
        "spikes of a byte each",
        "bytes from 1 to 9",
        "bits drawn at random",
    ],
)
def test_read_recording_of_no_spikes_is_warned_of(tmp_path, kind, size):
    width, height = map(int, size.split("x"))
    content = _garbage(kind)
    path = tmp_path / "r.dat"
    path.write_bytes(content[: len(content) // (width * height // 8) * (width * height // 8)])
    why = "(a pixel fires without regard|it consists of records of 8 bytes)"
    with pytest.warns(UserWarning, match=rf"r\.dat does not look like spikes of {size}: {why}"):
        read_recording(path, size=size)


@pytest.mark.parametrize("constant", [0.1, 0.25, 0.5, 0.75])
@pytest.mark.parametrize("length", [7, 9, 11, 13, 14, 18, 21, 26, 28, 33, 36, 60])
@pytest.mark.parametrize("size", [(64, 48), (400, 250)])
def test_read_recording_of_records_is_warned_of(tmp_path, size, length, constant):
    """Constant fields that drift over the sensor by their length are what a moving pattern would be."""
    rng = np.random.default_rng(length)
    records = rng.integers(0, 256, (400_000 // length, length), np.uint8)
    fields = math.ceil(constant * length)
    records[:, :fields] = rng.integers(1, 256, fields, np.uint8)
    width, height = size
    content, frame = records.tobytes(), width * height // 8
    path = tmp_path / "r.dat"
    path.write_bytes(content[: len(content) // frame * frame])
    with pytest.warns(UserWarning, match=rf"of {width}x{height}: it consists of records of {length} bytes"):
        read_recording(path, size=size)


@pytest.mark.parametrize("period", [2, 3, 6, 8, 12, 16])
@pytest.mark.parametrize("shape", [(60, 40, 48), (60, 41, 24), (60, 13, 26)])
def test_read_recording_of_saturated_columns_are_no_records(tmp_path, shape, period):
    """Columns that are always set make the bytes repeat, too: as rows and frames do."""
    spikes = _spikes(*shape)
    spikes[:, :, ::period] = 1
    path = write_recording(tmp_path / "r.dat", spikes)
    np.testing.assert_array_equal(_quiet(path, size=shape[:0:-1]).spikes, spikes)


WRONG_SIZES = [(250, 400), (500, 200), (200, 500), (1000, 100), (400, 125), (200, 125), (800, 125), (2000, 50)]


# Each size of one recording, and two kinds of them, rows and frames of another length, of the others.
@pytest.mark.parametrize(
    ("name", "wrong"), [(name, wrong) for name in RECORDINGS for wrong in WRONG_SIZES[:: 1 if "car" in name else 4]]
)
def test_a_wrong_size_of_a_real_recording_is_warned_of_with_the_right_one(tmp_path, shared_data, name, wrong):
    path = tmp_path / "r.dat"
    path.symlink_to(shared_data / "recordings" / name)
    for flip in (True, False):
        with pytest.warns(UserWarning, match=r"does not look like spikes of .*; size 400x250 looks right"):
            read_recording(path, size=wrong, flip=flip)


@pytest.mark.parametrize("name", RECORDINGS)
def test_bytes_of_a_real_recording_in_the_other_order_are_warned_of(tmp_path, shared_data, name):
    stored = np.fromfile(shared_data / "recordings" / name, np.uint8)
    path = tmp_path / "r_400x250.dat"
    path.write_bytes(np.packbits(np.unpackbits(stored, bitorder="little")).tobytes())
    with pytest.warns(
        UserWarning, match=r"the first of eight pixels seems to be in the highest bit.*bitorder='little'"
    ):
        read_recording(path)


@pytest.mark.parametrize(("width", "height"), [(64, 48), (48, 64), (80, 40), (96, 60), (400, 64)])
def test_bytes_in_the_other_order_are_warned_of(tmp_path, width, height):
    path = tmp_path / "r.dat"
    path.write_bytes(np.packbits(_spikes(40, height, width)).tobytes())
    with pytest.warns(UserWarning, match="the first of eight pixels seems to be in the highest bit"):
        read_recording(path, size=(width, height))


def test_frames_of_twice_the_height_are_warned_of(tmp_path, shared_data):
    path = tmp_path / "r.dat"
    path.symlink_to(shared_data / "recordings" / RECORDINGS[0])
    with pytest.warns(UserWarning, match=r"each frame holds two, one above the other; size 400x250 looks right"):
        read_recording(path, size="400x500")


@pytest.mark.parametrize(
    ("width", "height"),
    [(80, 50), (50, 80), (64, 48), (48, 64), (120, 40), (96, 64), (64, 96), (100, 60), (128, 32), (72, 56)],
)
def test_a_size_the_other_way_round_is_warned_of_by_the_rows(tmp_path, width, height):
    path = write_recording(tmp_path / "r.dat", _spikes(64, height, width))
    _quiet(path, size=(width, height))
    with pytest.warns(UserWarning, match=rf"its rows do not agree .*; size {width}x{height} \S* ?looks right"):
        read_recording(path, size=(height, width))


@pytest.mark.parametrize("beside", [2, 4])
@pytest.mark.parametrize(("width", "height"), [(64, 48), (48, 64), (80, 40), (96, 60)])
def test_rows_beside_each_other_are_warned_of(tmp_path, width, height, beside):
    path = write_recording(tmp_path / "r.dat", _spikes(40, height, width))
    with pytest.warns(UserWarning, match=rf"its rows do not agree .*; size {width}x{height} \S* ?looks right"):
        read_recording(path, size=(beside * width, height // beside))


@pytest.mark.parametrize("columns", [2, 4])
@pytest.mark.parametrize("sigma", [1.0, 2.0])
@pytest.mark.parametrize(("width", "height"), [(64, 48), (48, 64), (80, 40), (96, 60)])
def test_a_picture_that_repeats_along_its_rows_is_not_remarked_on(tmp_path, width, height, sigma, columns):
    picture = np.tile(_smooth(height, width // columns, sigma), (1, columns))
    spikes = simulate(Static(picture), scale=1, frames=40).spikes
    _quiet(write_recording(tmp_path / "r.dat", spikes), size=(width, height))


def _scenes(height: int, width: int):
    rows, columns = np.mgrid[:height, :width]
    rng = np.random.default_rng(3)
    yield "smooth", _smooth(height, width)
    yield "noise", rng.random((height, width))
    yield "rows of noise", np.repeat(rng.random((height, 1)), width, axis=1)
    yield "columns of noise", np.repeat(rng.random((1, width)), height, axis=0)
    yield "flat", np.full((height, width), 0.5)
    yield "dark", 0.05 * _smooth(height, width)
    yield "bright", 0.8 + 0.2 * _smooth(height, width)
    yield "sky and ground", np.where(rows < height / 2, 0.95, 0.02)
    yield "two alike", np.tile(_smooth(height // 2, width), (2, 1))
    for period in (1, 2, 3, 5, 7):
        yield f"checkerboard {period}", 0.05 + 0.9 * ((rows // period + columns // period) % 2)
        yield f"diagonal {period + 1}", 0.5 + 0.45 * np.cos(2 * np.pi * (rows + columns) / (period + 1))
        yield f"grating {period + 1}", 0.5 + 0.45 * np.cos(2 * np.pi * rows / (period + 1))


SENSORS: dict[str, Any] = {
    "ideal": Sensor(),
    "noisy": Sensor(photons=20.0, dark_rate=0.01, fixed_pattern=0.06, dead=0.01, hot=0.01),
    "saturated": Sensor(white_rate=1.2),
}


# Fine patterns that pass in light that saturates are taken for no spikes (docs/formats.md).
@pytest.mark.parametrize(
    ("sensor", "velocity"), [("ideal", None), ("ideal", (0.1, 0.3)), ("noisy", (1.0, 0.5)), ("saturated", None)]
)
@pytest.mark.parametrize("shape", [(40, 48, 64), pytest.param((12, 64, 48), marks=pytest.mark.slow)])
def test_read_recording_of_simulated_scenes_is_not_remarked_on(tmp_path, shape, velocity, sensor):
    frames, height, width = shape
    for _, picture in _scenes(height, width):
        scene = Static(picture) if velocity is None else Translation(picture, velocity)
        spikes = simulate(scene, scale=1, frames=frames, sensor=SENSORS[sensor]).spikes
        path = write_recording(tmp_path / "r.dat", spikes)
        np.testing.assert_array_equal(_quiet(path, size=(width, height)).spikes, spikes)


@pytest.mark.parametrize("name", RECORDINGS)
def test_crops_of_real_recordings_are_not_remarked_on(tmp_path, shared_data, name):
    recording = _quiet(shared_data / "recordings" / name)
    for top, left, frames in itertools.product((0, 180), (0, 150, 300), (8, 60)):
        crop = recording.crop(top, left, 70, 100).window(20, 20 + frames)
        _quiet(write_recording(tmp_path / "r.dat", crop), size="100x70")
