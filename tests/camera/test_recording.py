"""The `Recording`: shapes, windows, crops, and what it refuses."""

import dataclasses
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scsr_opt.camera.recording import Recording, _index, checked_white_rate
from scsr_opt.errors import InputError


def some_spikes(frames=12, height=5, width=7, seed=0):
    return np.random.default_rng(seed).integers(0, 2, (frames, height, width), dtype=np.uint8)


def test_what_it_says_of_itself():
    mask = np.zeros((5, 7), bool)
    mask[1, 2] = True
    recording = Recording.from_array(some_spikes(), readout_rate=20_000, bad_pixels=mask, name="lab")
    assert recording.shape == (12, 5, 7)
    assert (recording.frames, recording.height, recording.width) == (12, 5, 7)
    assert recording.duration == pytest.approx(12 / 20_000)
    assert (recording.white_rate, recording.name, recording.flipped) == (0.6, "lab", False)
    assert repr(recording) == (
        "Recording('lab', 12 frames of 7x5, 0.6 ms at 20000 Hz, white_rate=0.6, bad pixels: 1, stored upright)"
    )


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int8, np.int64, np.uint16])
def test_an_array_of_any_integer_type_is_handed_out_as_bytes(dtype):
    spikes = some_spikes()
    recording = Recording.from_array(spikes.astype(dtype))
    assert recording.spikes.dtype == np.uint8
    np.testing.assert_array_equal(recording.spikes, spikes)
    np.testing.assert_array_equal(np.asarray(recording), spikes)
    assert np.asarray(recording, dtype=np.float32).dtype == np.float32


@given(bounds=st.tuples(st.integers(0, 11), st.integers(1, 12)).filter(lambda pair: pair[0] < pair[1]))
def test_a_window_is_the_slice(bounds):
    spikes = some_spikes()
    window = Recording.from_array(spikes).window(*bounds)
    np.testing.assert_array_equal(window, spikes[slice(*bounds)])


def test_what_is_handed_out_can_be_changed_without_changing_the_recording():
    spikes = some_spikes()
    recording = Recording.from_array(spikes)
    recording.window(0, 3)[:] = 1
    recording.spikes[:] = 1
    np.testing.assert_array_equal(recording.spikes, some_spikes())


def in_order(spikes: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(spikes)


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int64])
@pytest.mark.parametrize("laid_out", [in_order, np.asfortranarray, lambda spikes: in_order(spikes.T).T])
def test_from_array_overwritten_afterwards_stays_what_it_was(dtype, laid_out):
    """Pictures that are made later are those of the spikes as they were given."""
    spikes, bad = laid_out(some_spikes().astype(dtype)), np.eye(5, 7, dtype=bool)
    recording = Recording.from_array(spikes, bad_pixels=bad)
    spikes[:], bad[:] = 1, True
    np.testing.assert_array_equal(recording.spikes, some_spikes())
    np.testing.assert_array_equal(recording.window(2, 4), some_spikes()[2:4])
    np.testing.assert_array_equal(recording.bad_pixels, np.eye(5, 7, dtype=bool))


def test_it_is_frozen_and_can_be_sent_to_another_process():
    recording = Recording.from_array(some_spikes(), bad_pixels=np.eye(5, 7, dtype=bool))
    with pytest.raises(dataclasses.FrozenInstanceError):
        recording.white_rate = 1.0  # pyright: ignore[reportAttributeAccessIssue]
    copy = pickle.loads(pickle.dumps(recording))
    np.testing.assert_array_equal(copy.spikes, recording.spikes)
    np.testing.assert_array_equal(copy.bad_pixels, recording.bad_pixels)


@given(
    key=st.one_of(st.none(), st.integers(0, 11)),
    frames=st.one_of(st.none(), st.integers(1, 30)),
)
def test_the_window_around_a_key_frame_holds_it_and_as_many_frames_as_there_are(key, frames):
    recording = Recording.from_array(some_spikes())
    start, stop = recording.around(key, frames)
    assert 0 <= start <= (6 if key is None else key) < stop <= 12
    assert stop - start == (12 if frames is None else min(frames, 12))


def test_the_window_around_a_key_frame_is_centred_where_it_can_be():
    recording = Recording.from_array(some_spikes(frames=100))
    assert recording.around(50, 41) == (30, 71)
    assert recording.around(3, 41) == (0, 41)
    assert recording.around(99, 41) == (59, 100)


def test_a_crop_is_the_rectangle_with_its_bad_pixels():
    spikes, mask = some_spikes(), np.zeros((5, 7), bool)
    mask[2, 3] = True
    crop = Recording.from_array(spikes, bad_pixels=mask, white_rate=0.3).crop(1, 2, 3, 4)
    np.testing.assert_array_equal(crop.spikes, spikes[:, 1:4, 2:6])
    np.testing.assert_array_equal(crop.window(4, 6), spikes[4:6, 1:4, 2:6])
    assert crop.bad_pixels is not None
    np.testing.assert_array_equal(crop.bad_pixels, mask[1:4, 2:6])
    assert (crop.shape, crop.white_rate) == ((12, 3, 4), 0.3)


def test_a_mask_of_zeros_and_ones_is_taken():
    recording = Recording.from_array(some_spikes(), bad_pixels=np.eye(5, 7, dtype=np.uint8))
    assert recording.bad_pixels is not None and recording.bad_pixels.dtype == bool
    assert recording.bad_pixels.sum() == 5


RECORDING = Recording.from_array(some_spikes())

MISTAKES = {
    "two dimensions": (lambda: Recording.from_array(some_spikes()[0]), r"2 dimensions \(5, 7\).*array\[None\]"),
    "nothing in it": (
        lambda: Recording.from_array(np.zeros((0, 5, 7), bool)),
        r"empty.*\(0, 5, 7\).*at least one frame",
    ),
    "grey levels": (lambda: Recording.from_array(some_spikes() * 255), r"values from 0 to 255.*only 0 and 1"),
    "negative": (lambda: Recording.from_array(-some_spikes().astype(int)), r"values from -1 to 0.*only 0 and 1"),
    "a short row": (lambda: Recording.from_array([[[1, 0], [1]]]), "a list whose parts differ in length"),
    "floats": (lambda: Recording.from_array(some_spikes().astype(float)), r"type float64.*bool or integer.*array > 0"),
    "mask of another shape": (
        lambda: Recording.from_array(some_spikes(), bad_pixels=np.zeros((7, 5), bool)),
        r"shape \(7, 5\).*5 rows and 7 columns.*shape \(5, 7\)",
    ),
    "mask of gains": (
        lambda: Recording.from_array(some_spikes(), bad_pixels=np.full((5, 7), 0.5)),
        r"values of type float64; give a bool mask.*map > limit",
    ),
    "mask of counts": (
        lambda: Recording.from_array(some_spikes(), bad_pixels=np.full((5, 7), 3)),
        r"bad_pixels holds values from 3 to 3; give a bool mask",
    ),
    "mask with a short row": (
        lambda: Recording.from_array(some_spikes(), bad_pixels=[[1], [1, 0]]),
        r"bad_pixels is a list whose parts differ in length",
    ),
    "white rate 0": (
        lambda: Recording.from_array(some_spikes(), white_rate=0),
        r"white_rate is 0, .*from 1e-06 to 1000.*per frame",
    ),
    "readout rate nan": (
        lambda: Recording.from_array(some_spikes(), readout_rate=float("nan")),
        r"readout_rate is nan.*from 0.001 to 1e\+12.*per second",
    ),
    "window past the end": (lambda: RECORDING.window(5, 13), r"frames 5 to 13.*frames 0 to 11.*stop <= 12"),
    "window from the end": (lambda: RECORDING.window(-3, 12), r"frames -3 to 12.*0 <= start"),
    "empty window": (lambda: RECORDING.window(4, 4), r"frames 4 to 4.*start < stop"),
    "a time for a frame": (lambda: _index(0.5, "start"), r"start is 0.5.*whole numbers"),
    "words for a rate": (
        lambda: checked_white_rate("bright"),
        r"white_rate is 'bright', .*from 1e-06 to 1000, in spikes per frame",
    ),
    "key frame outside": (lambda: RECORDING.around(12), r"Key frame 12 is not in.*12 frames.*0 to 11"),
    "no frames around": (lambda: RECORDING.around(3, 0), r"0 frames holds nothing.*at least 1"),
    "crop outside": (lambda: RECORDING.crop(2, 0, 4, 7), r"4 rows from 2.*has 5 rows and 7 columns"),
    "empty crop": (lambda: RECORDING.crop(2, 0, 0, 7), r"0 rows from 2.*has 5 rows"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_said_in_one_sentence(mistake):
    call, message = MISTAKES[mistake]
    with pytest.raises(InputError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")


def test_an_array_without_a_copy_cannot_be_had():
    with pytest.raises(ValueError, match="without a copy"):
        np.asarray(RECORDING, copy=False)
