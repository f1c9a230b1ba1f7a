"""Recordings in files: bytes written by hand, round trips, laziness, and what is refused."""

import pickle
import time
import tracemalloc
import warnings

import h5py
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from skimage.io import imread

from scsr_opt.camera import sources, writing
from scsr_opt.camera.flat import parse_size
from scsr_opt.camera.formats import read_recording, write_recording
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.sources import SpikeSource
from scsr_opt.errors import InputError

ENDINGS = (".dat", ".npy", ".npz", ".h5", ".hdf5")

UNCERTAIN = pytest.mark.filterwarnings("ignore:.* they may follow each other without:UserWarning")
"""A few small frames may be packed with or without bits that fill them up: they are read, with a warning."""


def some_spikes(frames=12, height=5, width=7, seed=0, rate=0.5):
    return (np.random.default_rng(seed).random((frames, height, width)) < rate).astype(np.uint8)


# Flat files, by hand ------------------------------------------------------------------------------------------------


def test_the_least_significant_bit_is_the_leftmost_pixel_and_the_bottom_row_comes_first(tmp_path):
    # Two frames of 8 columns and 2 rows, one byte a row.
    (tmp_path / "hand.dat").write_bytes(bytes([0b0000_0001, 0b1100_0000, 0b0000_0110, 0b0000_0000]))
    lower, upper = [1, 0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 1, 1]
    recording = read_recording(tmp_path / "hand.dat", size="8x2")
    assert recording.flipped
    assert recording.window(0, 1).tolist() == [[upper, lower]]
    assert recording.window(1, 2).tolist() == [[[0] * 8, [0, 1, 1, 0, 0, 0, 0, 0]]]
    upright = read_recording(tmp_path / "hand.dat", size="8x2", flip=False)
    assert not upright.flipped
    assert upright.window(0, 1).tolist() == [[lower, upper]]


def test_bits_run_on_from_row_to_row(tmp_path):
    # 4 columns, 2 rows: the second row begins in the middle of the byte.
    (tmp_path / "hand.dat").write_bytes(bytes([0b1000_0011]))
    assert read_recording(tmp_path / "hand.dat", size=(4, 2), flip=False).spikes.tolist() == [
        [[1, 1, 0, 0], [0, 0, 0, 1]]
    ]


@UNCERTAIN
def test_a_frame_that_is_no_whole_number_of_bytes_is_filled_up(tmp_path):
    # 3x3 = 9 bits: each frame begins on a byte of its own.
    (tmp_path / "hand.dat").write_bytes(bytes([0b0000_0111, 0b0000_0001, 0b0011_1000, 0b0000_0000]))
    recording = read_recording(tmp_path / "hand.dat", size="3x3", flip=False)
    assert recording.spikes.tolist() == [[[1, 1, 1], [0, 0, 0], [0, 0, 1]], [[0, 0, 0], [1, 1, 1], [0, 0, 0]]]


def test_writing_gives_the_same_bytes(tmp_path):
    spikes = np.array([[[0, 0, 0, 0, 0, 0, 1, 1], [1, 0, 0, 0, 0, 0, 0, 0]]])
    assert write_recording(tmp_path / "a.dat", spikes).read_bytes() == bytes([0b0000_0001, 0b1100_0000])
    assert write_recording(tmp_path / "b.dat", spikes, flip=False).read_bytes() == bytes([0b1100_0000, 0b0000_0001])
    padded = write_recording(tmp_path / "c.dat", spikes, flip=False, row_bits=16).read_bytes()
    assert padded == bytes([0b1100_0000, 0, 0b0000_0001, 0])


# Round trips --------------------------------------------------------------------------------------------------------

BINARY = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=3, max_dims=3, max_side=9), elements=st.integers(0, 1))


@UNCERTAIN
@pytest.mark.parametrize("ending", ENDINGS)
@settings(deadline=None, max_examples=30)
@given(data=st.data(), spikes=BINARY)
def test_what_was_written_is_read_back(tmp_path_factory, ending, data, spikes):
    # Of a cube not even the size tells the axis of time: where the content does not either, it is asked for.
    assume(len(set(spikes.shape)) > 1)
    path = tmp_path_factory.mktemp("trip") / f"recording{ending}"
    _, height, width = spikes.shape
    mask = data.draw(st.one_of(st.none(), hnp.arrays(bool, (height, width))))
    rates = data.draw(st.tuples(st.floats(0.01, 2), st.floats(1, 1e6)))
    written = Recording.from_array(spikes, bad_pixels=mask, white_rate=rates[0], readout_rate=rates[1])
    write_recording(path, written)
    read = read_recording(path, size=(width, height))
    np.testing.assert_array_equal(read.spikes, spikes)
    start = data.draw(st.integers(0, len(spikes) - 1))
    stop = data.draw(st.integers(start + 1, len(spikes)))
    np.testing.assert_array_equal(read.window(start, stop), spikes[start:stop])
    if ending in (".npz", ".h5", ".hdf5"):
        assert (read.white_rate, read.readout_rate) == rates
        assert (read.bad_pixels is None) == (mask is None)
        if mask is not None:
            np.testing.assert_array_equal(read.bad_pixels, mask)


@UNCERTAIN
@settings(deadline=None, max_examples=30)
@given(spikes=BINARY, flip=st.booleans(), extra=st.integers(0, 20))
def test_flat_files_of_every_layout_are_read_back(tmp_path_factory, spikes, flip, extra):
    path = tmp_path_factory.mktemp("trip") / "recording.dat"
    _, height, width = spikes.shape
    write_recording(path, spikes, flip=flip, row_bits=width + extra)
    read = read_recording(path, size=(width, height), flip=flip, row_bits=width + extra)
    np.testing.assert_array_equal(read.spikes, spikes)


@pytest.mark.parametrize("ending", ENDINGS)
def test_long_recordings_are_written_by_chunks(tmp_path, monkeypatch, ending):
    monkeypatch.setattr(writing, "_CHUNK_BYTES", 100)  # two frames of 5x7, the last chunk one
    spikes = some_spikes(frames=11)
    path = write_recording(tmp_path / f"r{ending}", spikes)
    np.testing.assert_array_equal(read_recording(path, size="7x5").spikes, spikes)


@pytest.mark.parametrize("ending", ENDINGS)
def test_flip_turns_the_picture_upside_down_in_every_format(tmp_path, ending):
    spikes = some_spikes()
    path = write_recording(tmp_path / f"r{ending}", spikes)
    default = read_recording(path, size="7x5")
    assert default.flipped == (ending == ".dat")
    other = read_recording(path, size="7x5", flip=not default.flipped)
    np.testing.assert_array_equal(other.spikes, spikes[:, ::-1])


def test_rates_and_mask_given_outweigh_the_files(tmp_path):
    path = write_recording(tmp_path / "r.npz", some_spikes(), white_rate=0.4, bad_pixels=np.zeros((5, 7), bool))
    mask = np.eye(5, 7, dtype=bool)
    np.save(tmp_path / "mask.npy", mask)
    read = read_recording(path, white_rate=0.5, readout_rate=1000, bad_pixels=tmp_path / "mask.npy")
    assert (read.white_rate, read.readout_rate) == (0.5, 1000)
    assert read.bad_pixels is not None
    np.testing.assert_array_equal(read.bad_pixels, mask)


def test_files_are_a_fraction_of_the_spikes(tmp_path):
    spikes = some_spikes(frames=100, height=64, width=64, rate=0.2)
    for ending, most in ((".dat", 1 / 8), (".npz", 0.25), (".h5", 0.25)):
        assert write_recording(tmp_path / f"r{ending}", spikes).stat().st_size <= most * spikes.size


# Other people's files -----------------------------------------------------------------------------------------------


def test_the_three_conventions_of_npz(tmp_path):
    spikes = some_spikes()
    np.savez(tmp_path / "tfirst.npz", spk=spikes, label=3)
    np.savez(tmp_path / "tlast.npz", np.moveaxis(spikes, 0, -1))
    np.savez(tmp_path / "ours.npz", spikes=spikes.astype(bool), arr_0=np.zeros(3))
    np.savez(tmp_path / "other.npz", frames=spikes)
    for name, size in (("tfirst", None), ("tlast", "7x5"), ("ours", None)):
        np.testing.assert_array_equal(read_recording(tmp_path / f"{name}.npz", size=size).spikes, spikes)
    np.testing.assert_array_equal(read_recording(tmp_path / "other.npz", key="frames").spikes, spikes)


def test_the_size_tells_the_order_of_arr_0(tmp_path):
    spikes = some_spikes()
    np.savez(tmp_path / "tfirst.npz", spikes)
    np.savez(tmp_path / "tlast.npz", np.moveaxis(spikes, 0, -1))
    for name in ("tfirst", "tlast"):
        np.testing.assert_array_equal(read_recording(tmp_path / f"{name}.npz", size="7x5").spikes, spikes)


def test_arr_0_that_the_size_fits_both_ways_is_asked_about(tmp_path):
    np.savez(tmp_path / "cube.npz", some_spikes(5, 5, 5))
    with pytest.raises(InputError, match=r"5 frames of 5x5 .* or 5 frames of 5x5 .*: save it as .* 'spikes'"):
        read_recording(tmp_path / "cube.npz", size="5x5")


def test_hdf5_as_others_write_it(tmp_path):
    spikes = some_spikes()
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["raw_spike"] = spikes
        file["group/more"] = spikes[::-1]
    np.testing.assert_array_equal(read_recording(tmp_path / "r.h5").window(2, 5), spikes[2:5])
    np.testing.assert_array_equal(read_recording(tmp_path / "r.h5", key="/group/more").spikes, spikes[::-1])


def test_npy_of_any_memory_order(tmp_path):
    spikes = some_spikes()
    np.save(tmp_path / "r.npy", np.asfortranarray(spikes.astype(np.int32)))
    np.testing.assert_array_equal(read_recording(tmp_path / "r.npy").window(2, 5), spikes[2:5])


# The size of flat files ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["400x250", " 400 X 250 ", "400×250", (400, 250), [400, 250], np.array([400, 250])])
def test_sizes_as_people_write_them(text):
    assert parse_size(text) == (400, 250)


@pytest.mark.parametrize(
    "text", ["400", "400x", "x250", "0x250", "400x250x3", "4e2x250", (400,), (400.0, 250), -1, (4, -1)]
)
def test_a_size_that_is_none(text):
    with pytest.raises(InputError, match="cannot be read: give it as WIDTHxHEIGHT"):
        parse_size(text)


def test_the_size_is_found_in_the_name(tmp_path):
    spikes = some_spikes(height=12, width=16)
    path = write_recording(tmp_path / "car_2x4_16x12_key3.dat", spikes)
    np.testing.assert_array_equal(read_recording(path).spikes, spikes)


@pytest.mark.parametrize("folder", [".", "classA"])
def test_the_size_is_found_in_a_config_of_spikecv(tmp_path, folder):
    (tmp_path / folder).mkdir(exist_ok=True)
    spikes = some_spikes(height=12, width=16)
    path = write_recording(tmp_path / folder / "car.dat", spikes)
    (tmp_path / "config.yaml").write_text(
        "filename: mine\nspike_w: 16\nspike_h: 12   # rows\nis_labeled: false\nlabeled_data_type: [0]\n"
    )
    np.testing.assert_array_equal(read_recording(path).spikes, spikes)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_find_size_config_with_a_byte_order_mark_is_read(tmp_path, encoding):
    path = write_recording(tmp_path / "r.dat", some_spikes(height=12, width=16))
    (tmp_path / "config.yaml").write_text("spike_w: 16\nspike_h: 12\n", encoding=encoding)
    assert read_recording(path).shape == (12, 12, 16)


def test_find_size_name_against_config_is_asked_about(tmp_path):
    path = write_recording(tmp_path / "r_16x12.dat", some_spikes(height=12, width=16))
    (tmp_path / "config.yaml").write_text("spike_w: 99\nspike_h: 99\n")
    with pytest.raises(InputError, match=r"The name with the config\.yaml of .* holds 2 sizes \(16x12, 99x99\)"):
        read_recording(path)
    assert read_recording(path, size="16x12").shape == (12, 12, 16)
    with pytest.raises(InputError, match="would be read back as frames of 16x12 or 99x99"):
        write_recording(path, some_spikes(height=12, width=16))


@pytest.mark.parametrize("size", ["32x12", "8x12", "16x6", "12x16", "16x24", "24x8", "48x4", "64x3", "4x4", "2x2"])
def test_read_recording_size_against_the_name_is_warned_of(tmp_path, size):
    path = write_recording(tmp_path / "r_16x12.dat", np.zeros((12, 12, 16), np.uint8))
    with pytest.warns(UserWarning, match=f"size {size} was given and is taken, but its name says 16x12"):
        read_recording(path, size=size)


def test_a_size_the_other_way_round_is_remarked_on(tmp_path):
    path = write_recording(tmp_path / "r_16x12.dat", some_spikes(height=12, width=16))
    with pytest.warns(UserWarning, match=r"size 12x16 was given.*but.*says 16x12; the size is WIDTHxHEIGHT"):
        assert read_recording(path, size="12x16").shape == (12, 16, 12)


@pytest.mark.parametrize("frames", [3, 25, 26])
def test_rows_of_416_bits_are_found_by_length(tmp_path, frames):
    # 26 frames of 400 columns are as long as 25 of 416: length alone tells 3 frames but neither 25 padded nor 26 plain.
    spikes = some_spikes(frames=frames, height=250, width=400, rate=0.02)
    padded = write_recording(tmp_path / "padded_400x250.dat", spikes, row_bits=416)
    assert padded.stat().st_size == frames * 13_000
    np.testing.assert_array_equal(read_recording(padded).spikes, spikes)
    plain = write_recording(tmp_path / "plain_400x250.dat", spikes)
    np.testing.assert_array_equal(read_recording(plain).spikes, spikes)


def test_rows_of_416_bits_are_found_in_a_file_cut_short(tmp_path):
    spikes = some_spikes(frames=4, height=250, width=400, rate=0.02)
    for bits in (400, 416):
        path = write_recording(tmp_path / f"rows{bits}_400x250.dat", spikes, row_bits=bits)
        path.write_bytes(path.read_bytes()[:-77])
        with pytest.warns(UserWarning, match="not a whole frame"):
            np.testing.assert_array_equal(read_recording(path).spikes, spikes[:3])


def test_a_part_of_a_frame_at_the_end_is_dropped_with_a_warning(tmp_path):
    spikes = some_spikes(height=12, width=16)
    path = write_recording(tmp_path / "r_16x12.dat", spikes)
    path.write_bytes(path.read_bytes() + b"\xff" * 5)
    with pytest.warns(UserWarning, match=r"r_16x12.dat: the last 5 bytes are not a whole frame of 16x12 \(24 bytes\)"):
        read = read_recording(path)
    np.testing.assert_array_equal(read.spikes, spikes)


# Laziness -----------------------------------------------------------------------------------------------------------


def test_a_window_reads_its_bytes_only(tmp_path, monkeypatch):
    path = write_recording(tmp_path / "r_16x12.dat", some_spikes(frames=50, height=12, width=16))
    mapped = []

    def counting(*arguments, offset, shape, **keywords):
        mapped.append((offset, int(np.prod(shape))))
        return original(*arguments, offset=offset, shape=shape, **keywords)

    original = np.memmap
    monkeypatch.setattr(sources.np, "memmap", counting)
    recording = read_recording(path)
    mapped.clear()  # what opening looks at
    recording.window(7, 10)
    assert mapped == [(7 * 24, 3 * 24)]


@pytest.mark.parametrize("ending", [".dat", ".npy"])
def test_a_recording_of_gigabytes_opens_in_an_instant(tmp_path, ending):
    path, frames = tmp_path / f"long_400x250{ending}", 340_000
    frame, offset = 12_500, 0
    with path.open("wb") as file:
        if ending == ".npy":
            frames, frame = 43_000, 100_000
            header = {"descr": "|u1", "fortran_order": False, "shape": (frames, 250, 400)}
            np.lib.format.write_array_header_1_0(file, header)
            offset = file.tell()
        file.seek(offset + (frames - 4) * frame)
        file.write(b"\x01")
        file.truncate(offset + frames * frame)
    assert path.stat().st_size > 4e9
    tracemalloc.start()
    begun = time.perf_counter()
    window = read_recording(path, flip=False).window(frames - 10, frames)
    seconds, (_, peak) = time.perf_counter() - begun, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.argwhere(window).tolist() == [[6, 0, 0]]
    assert peak < 5 * window.nbytes
    assert seconds < 2


@pytest.mark.parametrize("ending", [".npy", ".h5"])
def test_values_far_into_a_file_are_checked_when_they_are_read(tmp_path, ending):
    spikes = some_spikes()
    spikes[9, 2, 2] = 7
    if ending == ".npy":
        np.save(tmp_path / "r.npy", spikes)
    else:
        with h5py.File(tmp_path / "r.h5", "w") as file:
            file["raw_spike"] = spikes
    recording = read_recording(tmp_path / f"r{ending}")
    np.testing.assert_array_equal(recording.window(0, 9), spikes[:9])
    with pytest.raises(InputError, match=r"frames 8 to 10, holds values from 0 to 7"):
        recording.window(8, 11)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_recording_on_disk_can_be_sent_to_another_process(tmp_path, ending):
    path = write_recording(tmp_path / f"r{ending}", some_spikes())
    copy = pickle.loads(pickle.dumps(read_recording(path, size="7x5")))
    np.testing.assert_array_equal(copy.window(3, 6), some_spikes()[3:6])


@pytest.mark.parametrize("ending", [".dat", ".npy", ".h5"])
def test_a_file_that_vanishes_is_an_error_not_a_crash(tmp_path, ending):
    path = write_recording(tmp_path / f"r{ending}", some_spikes())
    recording = read_recording(path, size="7x5")
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(InputError, match="cannot be read.*cut short or replaced since it was opened"):
        recording.window(8, 12)


# Nothing half-written -----------------------------------------------------------------------------------------------


class FailingSource(SpikeSource):
    """Frames until number 6, then a fault, as a full disk or a bad sector would give."""

    shape = (12, 5, 7)

    def read(self, start, stop):
        if stop > 6:
            raise OSError("the disk is gone")
        return some_spikes()[start:stop]


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_fault_while_writing_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, ending):
    monkeypatch.setattr(writing, "_CHUNK_BYTES", 100)
    path = tmp_path / f"r{ending}"
    write_recording(path, some_spikes(seed=1))
    before = path.read_bytes()
    with pytest.raises(OSError, match="the disk is gone"):
        write_recording(path, Recording(FailingSource()))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_who_has_the_old_file_open_goes_on_reading_it(tmp_path):
    path = write_recording(tmp_path / "r.dat", some_spikes(seed=1))
    before = path.read_bytes()
    with path.open("rb") as old:
        write_recording(path, some_spikes(seed=2))
        assert old.read() == before
    assert path.read_bytes() != before


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_recording_may_be_written_over_itself(tmp_path, ending):
    path = write_recording(tmp_path / f"r{ending}", some_spikes())
    write_recording(path, read_recording(path, size="7x5"), white_rate=0.3)
    np.testing.assert_array_equal(read_recording(path, size="7x5").spikes, some_spikes())


# Real recordings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "shape", "lowest", "highest"),
    [
        ("real_car_400x250.dat", (200, 250, 400), 0.1, 0.4),
        ("real_roadside_static.npz", (500, 250, 400), 0.1, 0.4),
        ("real_lowlight_helicopter.npz", (200, 250, 250), 0.02, 0.05),
        ("reds_200_part1_400x250_key150.dat", (301, 250, 400), 0.1, 0.4),
        ("reds_203_part1_400x250_key150.dat", (301, 250, 400), 0.1, 0.4),
    ],
)
def test_the_real_recordings_are_read(shared_data, name, shape, lowest, highest):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = read_recording(shared_data / "recordings" / name)
    assert recording.shape == shape
    assert recording.flipped == name.endswith(".dat")
    assert lowest < recording.window(50, 150).mean() < highest


@pytest.mark.parametrize("number", [200, 203])
def test_reds_shows_its_ground_truth_upright(shared_data, number):
    path = shared_data / "recordings" / f"reds_{number}_part1_400x250_key150.dat"
    truth = imread(shared_data / "recordings" / f"reds_{number}_part1_key150_groundtruth.png").astype(float)
    upright, wrong = (
        np.corrcoef(read_recording(path, flip=flip).window(130, 171).mean(0).ravel(), truth.ravel())[0, 1]
        for flip in (None, False)
    )
    assert upright > 0.9
    assert wrong < 0.7


def test_the_two_views_of_the_roadside_agree(shared_data):
    # The car's file is stored bottom-up, the static one upright: both show the same fence and verge where no car is.
    car = read_recording(shared_data / "recordings" / "real_car_400x250.dat").spikes.mean(0)
    static = read_recording(shared_data / "recordings" / "real_roadside_static.npz").window(0, 200).mean(0)
    assert np.corrcoef(car[:60].ravel(), static[:60].ravel())[0, 1] > 0.9
    assert np.corrcoef(car[::-1][:60].ravel(), static[:60].ravel())[0, 1] < 0.5
