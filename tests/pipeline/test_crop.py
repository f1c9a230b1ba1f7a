"""`Options.crop`: the part of the sensor that is solved for, and the arrays that are given along with it."""

import dataclasses

import numpy as np
import pytest

import scsr_opt._validation
from scsr_opt import InputError, Options, Recording, reconstruct, reconstruct_sequence
from scsr_opt.motion import Motion
from scsr_opt.pipeline.task import task_of

FRAMES, HEIGHT, WIDTH = 21, 12, 18
CROP = (3, 5, 6, 7)
CUT = (..., slice(3, 9), slice(5, 12))

SPIKES = (np.random.default_rng(0).random((FRAMES, HEIGHT, WIDTH)) < 0.3).astype(np.uint8)
BAD = np.random.default_rng(1).random((HEIGHT, WIDTH)) < 0.1
GAIN = np.random.default_rng(2).uniform(0.9, 1.1, (HEIGHT, WIDTH)).astype(np.float32)


@pytest.mark.parametrize("whole", [True, False])
def test_task_of_a_crop_has_the_arrays_of_its_pixels(whole):
    cut = (...,) if whole else CUT
    recording = Recording.from_array(SPIKES, bad_pixels=BAD, name="street")
    task = task_of(recording, 2, None, Options(crop=CROP, bad_pixels=BAD[cut], gain=GAIN[cut]))
    np.testing.assert_array_equal(task.clip.spikes, SPIKES[CUT] * ~BAD[CUT])
    np.testing.assert_array_equal(task.clip.bad_pixels, BAD[CUT])
    np.testing.assert_array_equal(task.options.known_gain, GAIN[CUT])
    assert task.shape == (12, 14) and task.recording is recording


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gain": np.ones((WIDTH, HEIGHT))}, r"it must be 'auto', 'blind' or one gain for each pixel, \(6, 7\)"),
        ({"bad_pixels": np.ones((3, 3), bool)}, "bad_pixels has shape"),
        ({"motion": Motion.none(HEIGHT, WIDTH)}, r"for this recording it must be \(2, 6, 7\)"),
    ],
)
def test_task_of_a_crop_with_an_array_of_another_size_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        task_of(SPIKES, 2, None, Options(crop=CROP, **options))


@pytest.mark.parametrize("crop", [(11, 17, 1, 1), (0, 0, 12, 18), [3, 5, 6, 7], np.array([3, 5, 6, 7])])
def test_task_of_a_crop_is_that_of_the_array(crop):
    task = task_of(SPIKES, 2, None, Options(crop=crop))
    top, left, height, width = crop
    np.testing.assert_array_equal(task.clip.spikes, SPIKES[:, top : top + height, left : left + width])
    assert task.options.crop == tuple(crop) and {type(number) for number in task.options.crop or ()} == {int}


SIZE = r"which has 12 rows and 18 columns: choose .*top \+ height of at most 12 and left \+ width of at most 18\.$"


@pytest.mark.parametrize(
    ("crop", "message"),
    [
        ((0, 0, 13, 18), rf"The crop of 13 rows from 0 and 18 columns from 0 does not lie in recording, {SIZE}"),
        ((0, 0, 12, 19), rf"19 columns from 0 .*{SIZE}"),
        ((7, 0, 6, 18), rf"6 rows from 7 .*{SIZE}"),
        ((0, 18, 1, 1), SIZE),
        ((-1, 0, 4, 4), rf"4 rows from -1 .*{SIZE}"),
        ((0, -4, 4, 4), SIZE),
        ((0, 0, 0, 4), SIZE),
        ((0, 0, 4, 0), SIZE),
        ((4, 4, -2, 2), SIZE),
        ((0, 0, 10**30, 1), SIZE),
        ((0, 0, 4), r"crop is \(0, 0, 4\); it must be \(top, left, height, width\), four whole numbers of sensor pix"),
        ((0, 0, 4, 4, 4), r"crop is \(0, 0, 4, 4, 4\); it must be"),
        ([], r"crop is \[\]; it must be"),
        (5, "crop is 5; it must be"),
        ("0,0,4,4", "crop is '0,0,4,4'; it must be"),
        ((0, 0, 4, True), r"crop is \(0, 0, 4, True\); it must be"),
        ((0, 0, 4, 4.5), r"crop is \(0, 0, 4, 4\.5\); it must be"),
        ((0, "0", 4, 4), "it must be .*four whole numbers"),
        ((None, 0, 4, 4), "it must be"),
        (np.array([0.0, 0, 4, 4]), "it must be"),
    ],
)
def test_crop_that_is_none_is_refused_by_every_door(types_unchecked, crop, message):
    for call in (
        lambda: task_of(SPIKES, 2, None, Options(crop=crop)),
        lambda: reconstruct_sequence(SPIKES, [3], scale=2, crop=crop),
    ):
        with pytest.raises(InputError, match=message) as refused:
            call()
        assert ". " not in str(refused.value)


def test_reconstruct_huge_scale_advises_a_crop_that_works(monkeypatch):
    """The recording is dark, so that there is nothing to iterate."""
    monkeypatch.setattr(scsr_opt._validation, "_MOST_PIXELS", 100)
    dark = np.zeros_like(SPIKES)
    with pytest.raises(InputError, match=r"take a smaller scale, or a crop\.$"):
        reconstruct(dark, scale=2, motion=Motion.none(HEIGHT, WIDTH))
    solution = reconstruct(dark, scale=2, motion=Motion.none(5, 5), crop=(2, 3, 5, 5))
    assert solution.image.shape == (10, 10) and solution.crop == (2, 3, 5, 5)
    assert solution.part.shape == (FRAMES, 5, 5) and dataclasses.replace(solution, crop=None).part is solution.recording
    (solution,) = reconstruct_sequence(dark, [3], scale=2, crop=(2, 3, 5, 5))
    assert solution.image.shape == (10, 10) and solution.crop == (2, 3, 5, 5)
