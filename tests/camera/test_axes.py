"""Which axis is time: found by content, or asked for; never chosen on the quiet."""

import functools
import warnings
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from scsr_opt.camera.formats import read_recording, write_recording
from scsr_opt.camera.plausibility import axis_regularity, contradiction
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.errors import InputError


def _picture(kind: str, height: int, width: int) -> np.ndarray:
    rng = np.random.default_rng(7)
    rows, columns = np.mgrid[:height, :width]
    if kind == "smooth":
        smooth = gaussian_filter(rng.standard_normal((height, width)), 2)
        return 0.05 + 0.9 * (smooth - smooth.min()) / np.ptp(smooth)
    return {
        "noise": rng.random((height, width)),
        "checkerboard": 0.05 + 0.9 * ((rows + columns) % 2),
        "stripes": 0.95 * (columns % 2),
        "flat": np.full((height, width), 0.5),
        "bright": 0.7 + 0.3 * rng.random((height, width)),
    }[kind]


@functools.cache
def _spikes(
    shape: tuple[int, int, int], kind: str = "smooth", velocity: Any = None, sensor: Sensor | None = None
) -> np.ndarray:
    frames, height, width = shape
    picture = _picture(kind, height, width)
    scene = Static(picture) if velocity is None else Translation(picture, velocity)
    spikes = simulate(scene, scale=1, frames=frames, sensor=sensor or Sensor()).spikes
    spikes.flags.writeable = False
    return spikes


def _noise(shape: tuple[int, int, int]) -> np.ndarray:
    return (np.random.default_rng(0).random(shape) < 0.3).astype(np.uint8)


SHAPES = [
    (101, 64, 64),
    (101, 26, 34),
    (101, 260, 346),
    (2905, 64, 64),
    (20, 250, 250),
    (40, 24, 32),
    (64, 64, 64),
    (5, 64, 64),
]


@pytest.mark.parametrize("shape", SHAPES)
def test_arr_0_of_either_order_is_told_by_its_content(tmp_path, shape):
    spikes = _spikes(shape)
    for array in (spikes, np.moveaxis(spikes, 0, -1)):
        np.savez(tmp_path / "x.npz", array)
        np.testing.assert_array_equal(read_recording(tmp_path / "x.npz").spikes, spikes)


@pytest.mark.parametrize("velocity", [None, (0.1, 0.4)])
@pytest.mark.parametrize("sensor", [Sensor(), Sensor(photons=20.0, fixed_pattern=0.06), Sensor(dead=0.02, hot=0.02)])
@pytest.mark.parametrize("kind", ["smooth", "noise", "checkerboard", "stripes", "flat", "bright"])
def test_arr_0_of_any_scene_is_told_by_its_content(tmp_path, kind, sensor, velocity):
    spikes = _spikes((60, 40, 48), kind, velocity, sensor)
    for array in (spikes, np.moveaxis(spikes, 0, -1)):
        np.savez(tmp_path / "x.npz", array)
        np.testing.assert_array_equal(read_recording(tmp_path / "x.npz").spikes, spikes)


@pytest.mark.parametrize("shape", [(101, 64, 64), (12, 5, 7), (3, 4, 5), (40, 24, 32), (1, 64, 64)])
def test_arr_0_whose_content_does_not_tell_is_asked_for(tmp_path, shape):
    frames, height, width = shape
    array = _noise(shape) if frames > 1 else np.zeros(shape, np.uint8)
    np.savez(tmp_path / "x.npz", array)
    message = (
        rf"{frames} frames of {width}x{height} \(frames, rows, columns\) or {width} frames of {height}x{frames} "
        rf"\(rows, columns, frames\), .*: pass size='{width}x{height}' or size='{height}x{frames}'"
    )
    with pytest.raises(InputError, match=message):
        read_recording(tmp_path / "x.npz")
    assert read_recording(tmp_path / "x.npz", size=(width, height)).shape == shape
    assert read_recording(tmp_path / "x.npz", size=(height, frames)).shape == (width, frames, height)


def _saved(folder, name: str, array: np.ndarray):
    path = folder / name
    if path.suffix == ".npy":
        np.save(path, array)
    elif path.suffix == ".npz":
        np.savez(path, **{path.stem: array})  # pyright: ignore[reportArgumentType]
    else:
        with h5py.File(path, "w") as file:
            file["raw_spike"] = array
    return path


NAMES = ["x.npy", "spikes.npz", "spk.npz", "raw_spike.npz", "x.h5"]


@pytest.mark.parametrize("name", NAMES)
def test_time_last_of_a_known_camera_is_read_as_such(tmp_path, name):
    spikes = _spikes((60, 250, 400))
    recording = read_recording(_saved(tmp_path, name, np.moveaxis(spikes, 0, -1)))
    np.testing.assert_array_equal(recording.spikes, spikes)
    np.testing.assert_array_equal(recording.window(7, 9), spikes[7:9])


@pytest.mark.parametrize("name", NAMES)
def test_time_last_of_another_camera_is_asked_for(tmp_path, name):
    spikes = _spikes((60, 40, 48))
    path = _saved(tmp_path, name, np.moveaxis(spikes, 0, -1))
    message = r"40 frames of 60x48 .* or 60 frames of 48x40 .* axis 2 were time: pass size='60x48' or size='48x40'"
    with pytest.raises(InputError, match=message):
        read_recording(path)
    recording = read_recording(path, size="48x40")
    np.testing.assert_array_equal(recording.spikes, spikes)
    np.testing.assert_array_equal(recording.window(7, 9), spikes[7:9])
    np.testing.assert_array_equal(read_recording(path, size="48x40", flip=True).spikes, spikes[:, ::-1])
    with pytest.warns(UserWarning, match=r"as the given size says, but its content looks as if axis 2 of .* were time"):
        assert read_recording(path, size="60x48").shape == (40, 48, 60)


@pytest.mark.parametrize("name", NAMES)
def test_time_in_the_middle_is_asked_for(tmp_path, name):
    path = _saved(tmp_path, name, np.moveaxis(_spikes((60, 40, 48)), 0, 1))
    with pytest.raises(InputError, match=r"its content looks as if axis 1 were time"):
        read_recording(path)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("shape", [(101, 64, 64), (60, 40, 48), (3, 5, 7), (1, 64, 64), (250, 40, 30)])
def test_time_first_is_read_without_a_question(tmp_path, name, shape):
    """Spikes and bits drawn at random, where nothing speaks against the convention."""
    for spikes in (_spikes(shape), _noise(shape)):
        np.testing.assert_array_equal(read_recording(_saved(tmp_path, name, spikes)).spikes, spikes)


def _few_spikes(shape: tuple[int, int, int]) -> list[np.ndarray]:
    """Arrays without a spike, without a gap, and with 50 spikes at random."""
    few = np.zeros(shape, np.uint8)
    few.reshape(-1)[np.random.default_rng(0).choice(few.size, min(50, few.size // 2), replace=False)] = 1
    return [np.zeros(shape, np.uint8), np.ones(shape, np.uint8), few]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "shape", [(3, 5, 7), (1, 64, 64), (7, 64, 64), (250, 40, 30), (2905, 64, 64), (20, 250, 250), (12, 9, 7)]
)
def test_too_few_spikes_are_read_time_first_where_the_other_reading_is_of_no_sensor(tmp_path, name, shape):
    for spikes in _few_spikes(shape):
        np.testing.assert_array_equal(read_recording(_saved(tmp_path, name, spikes)).spikes, spikes)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("shape", [(101, 64, 64), (60, 40, 48), (48, 60, 40), (64, 64, 101), (8, 9, 10), (101, 26, 34)])
def test_too_few_spikes_are_asked_for_where_both_readings_are_of_a_sensor(tmp_path, name, shape):
    frames, height, width = shape
    for spikes in _few_spikes(shape):
        path = _saved(tmp_path, name, spikes)
        with pytest.raises(InputError, match=rf"tell which: pass size='{width}x{height}' or size='{height}x{frames}'"):
            read_recording(path)
        np.testing.assert_array_equal(read_recording(path, size=(width, height)).spikes, spikes)
        np.testing.assert_array_equal(read_recording(path, size=(height, frames)).spikes, np.moveaxis(spikes, -1, 0))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("white_rate", [0.002, 0.005, 0.01, 0.02])
@pytest.mark.parametrize("shape", [(101, 30, 24), (41, 64, 64), (64, 48, 48), (12, 40, 40)])
def test_small_dark_time_last_is_never_read_time_first(tmp_path, name, shape, white_rate):
    spikes = _spikes(shape, sensor=Sensor(white_rate=white_rate))
    with pytest.raises(InputError, match="pass size="):
        read_recording(_saved(tmp_path, name, np.moveaxis(spikes, 0, -1)))


@pytest.mark.parametrize("ending", [".npz", ".h5"])
def test_too_few_spikes_that_write_recording_wrote_are_read_back(tmp_path, ending):
    for spikes in _few_spikes((60, 40, 48)):
        np.testing.assert_array_equal(read_recording(write_recording(tmp_path / f"r{ending}", spikes)).spikes, spikes)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("white_rate", [0.04, 0.06, 0.1])
@pytest.mark.parametrize("kind", ["smooth", "noise", "flat"])
def test_time_last_in_the_dark_is_asked_for_and_time_first_is_not(tmp_path, name, kind, white_rate):
    """A pixel fires once in 20 to 60 frames: there is nothing to be counted along time, but along the other axes."""
    spikes = _spikes((101, 160, 150), kind, sensor=Sensor(white_rate=white_rate, photons=20.0))
    np.testing.assert_array_equal(read_recording(_saved(tmp_path, name, spikes)).spikes, spikes)
    with pytest.raises(InputError, match="its content looks as if axis 2 were time: pass size='101x150' or"):
        read_recording(_saved(tmp_path, name, np.moveaxis(spikes, 0, -1)))


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("velocity", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("width", [1, 3, 10])
def test_time_first_of_bright_lines_that_pass_is_not_asked_for(width, velocity, upright):
    """Along the lines chance makes few coincidences as well, and along time they fire without regard to the last."""
    rows, columns = np.mgrid[:64, :64]
    along, drift = (columns, (0.0, velocity)) if upright else (rows, (velocity, 0.0))
    for period, dark in ((20, 0.1), (60, 0.01)):
        scene = Translation(dark + 0.85 * (along % period < width), drift)
        spikes = simulate(scene, scale=1, frames=101, sensor=Sensor(white_rate=0.85)).spikes
        assert contradiction(axis_regularity(spikes), 0) is None


@pytest.mark.parametrize("name", NAMES)
def test_a_known_camera_against_the_convention_is_asked_for_where_the_content_does_not_tell(tmp_path, name):
    with pytest.raises(InputError, match=r"pass size='3x400' or size='400x250'"):
        read_recording(_saved(tmp_path, name, np.zeros((250, 400, 3), np.uint8)))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("factor", [2, 255, -1])
def test_values_that_are_no_spikes_are_refused_before_the_axis_is_asked_for(tmp_path, name, factor):
    array = np.full((60, 40, 48), factor, np.int16)
    with pytest.raises(
        InputError, match=rf"holds values from {factor} to {factor}, but a spike frame has only 0 and 1"
    ):
        read_recording(_saved(tmp_path, name, array))


@pytest.mark.parametrize("axis", [1, 2])
def test_from_array_with_time_elsewhere_is_warned_of(axis):
    spikes = _spikes((60, 40, 48))
    with pytest.warns(UserWarning, match=rf"as if axis {axis} were time: pass np.moveaxis\(array, {axis}, 0\)"):
        Recording.from_array(np.moveaxis(spikes, 0, axis))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Recording.from_array(spikes)


@pytest.mark.parametrize(
    "name", ["real_car_400x250.dat", "real_roadside_static.npz", "real_lowlight_helicopter.npz",
             "reds_200_part1_400x250_key150.dat", "reds_203_part1_400x250_key150.dat"],
)  # fmt: skip
def test_axis_regularity_of_real_recordings_has_wide_margins(shared_data, name):
    recording = read_recording(shared_data / "recordings" / name)
    time, rows, columns = axis_regularity(recording.window(0, min(200, recording.frames)))
    assert time.regular and time.ratio < 0.3
    assert rows.irregular and columns.irregular and min(rows.ratio, columns.ratio) > 0.95


@pytest.mark.parametrize("ending", [".npy", ".npz", ".h5"])
def test_write_recording_of_spikes_of_any_scene_is_read_back(tmp_path, ending):
    for kind in ("smooth", "noise", "checkerboard", "stripes", "flat", "bright"):
        spikes = _spikes((40, 24, 32), kind)
        np.testing.assert_array_equal(read_recording(write_recording(tmp_path / f"r{ending}", spikes)).spikes, spikes)


# Packed along time --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["big", "little"])
@pytest.mark.parametrize("frames", [101, 40, 41, 47, 160])
def test_seq_packed_along_time_is_read(tmp_path, order, frames):
    spikes = _spikes((frames, 40, 48))
    np.savez(tmp_path / "x.npz", seq=np.packbits(spikes, axis=0, bitorder=order), length=frames, white_rate=0.5)
    recording = read_recording(tmp_path / "x.npz")
    np.testing.assert_array_equal(recording.spikes, spikes)
    assert recording.white_rate == 0.5


def test_seq_whose_order_of_bits_is_not_clear_is_warned_of(tmp_path):
    spikes = _noise((40, 24, 32))
    np.savez(tmp_path / "x.npz", seq=np.packbits(spikes, axis=0), length=40)
    with pytest.warns(UserWarning, match="packed along time, and its content does not tell in which order"):
        np.testing.assert_array_equal(read_recording(tmp_path / "x.npz").spikes, spikes)


def test_seq_that_is_not_packed_is_read_as_it_is(tmp_path):
    spikes = _spikes((40, 24, 32))
    np.savez(tmp_path / "x.npz", seq=spikes, length=40)
    np.testing.assert_array_equal(read_recording(tmp_path / "x.npz").spikes, spikes)


@pytest.mark.parametrize("length", [0, -1, 32, 41, 400, 39.5, [40, 40], "forty"])
def test_seq_against_its_length_is_refused(tmp_path, length):
    np.savez(tmp_path / "x.npz", seq=np.packbits(_spikes((40, 24, 32)), axis=0), length=length)
    with pytest.raises(InputError, match=r"is not 'length' = .* frames packed eight to a byte"):
        read_recording(tmp_path / "x.npz")


def test_seq_without_length_is_asked_for(tmp_path):
    np.savez(tmp_path / "x.npz", seq=np.packbits(_spikes((40, 24, 32)), axis=0))
    with pytest.raises(InputError, match=r"no array 'spikes' .*, but seq"):
        read_recording(tmp_path / "x.npz")
