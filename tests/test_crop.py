"""`crop` of `reconstruct` and `sequence`: the part of the sensor that is solved for, and what is handed in along."""

import numpy as np
import pytest

import scsr_opt.inputs
from scsr_opt import InputError, Recording, reconstruct, sequence
from scsr_opt.inputs import Part
from scsr_opt.motion import Global
from scsr_opt.solvers.solution import Result, Solution

FRAMES, HEIGHT, WIDTH = 21, 12, 18
CROP = (3, 5, 6, 7)
CUT = (..., slice(3, 9), slice(5, 12))

SPIKES = (np.random.default_rng(0).random((FRAMES, HEIGHT, WIDTH)) < 0.3).astype(np.uint8)
BAD = np.random.default_rng(1).random((HEIGHT, WIDTH)) < 0.1
GAIN = np.random.default_rng(2).uniform(0.9, 1.1, (HEIGHT, WIDTH))
VELOCITY = np.random.default_rng(3).uniform(-1, 1, (2, HEIGHT, WIDTH)).astype(np.float32)


@pytest.fixture
def prepared(monkeypatch) -> list[dict]:
    """What `reconstruct` and `sequence` hand to `prepare`, or to what calls it; nothing is solved."""
    calls = []

    def pictures(part, keys, scale, estimator, options):
        calls.append({"spikes": part.recording, "said": part.said, "velocity": estimator, **options})
        yield from ()

    monkeypatch.setattr("scsr_opt.reconstruction.prepare", lambda spikes, **o: calls.append({"spikes": spikes, **o}))
    monkeypatch.setattr(
        "scsr_opt.reconstruction.solve", lambda *_: Solution(np.zeros((12, 14), np.float32), (), Result.converged)
    )
    monkeypatch.setattr("scsr_opt.key_frames._pictures", pictures)
    return calls


@pytest.mark.parametrize("whole", [True, False])
def test_reconstruct_cuts_out_what_is_given_for_the_whole_sensor(prepared, whole):
    cut = (...,) if whole else CUT
    recording = Recording.from_array(SPIKES, bad_pixels=BAD, name="street")
    given = {"bad_pixels": BAD[cut], "gain": GAIN[cut], "velocity": VELOCITY[cut]}
    solution = reconstruct(recording, scale=2, crop=CROP, **given)
    (call,) = prepared
    np.testing.assert_array_equal(call["spikes"].spikes, SPIKES[CUT])
    np.testing.assert_array_equal(call["spikes"].bad_pixels, BAD[CUT])
    np.testing.assert_array_equal(call["bad_pixels"], BAD[CUT])
    np.testing.assert_array_equal(call["gain"], GAIN[CUT])
    np.testing.assert_array_equal(call["velocity"], VELOCITY[CUT])
    assert solution.stats["crop"] == CROP


@pytest.mark.parametrize(
    "given",
    [
        {"velocity": (0.1, 0.2)},
        {"velocity": Global()},
        {"velocity": None},
        {"gain": "auto"},
        {"gain": "blind"},
        {"gain": None},
        {"gain": np.ones((WIDTH, HEIGHT))},  # fits neither: refused by `prepare`
        {"bad_pixels": None},
        {"bad_pixels": np.ones((3, 3), bool)},
    ],
)
def test_reconstruct_hands_on_what_is_not_of_each_pixel(prepared, given):
    reconstruct(SPIKES, scale=2, crop=CROP, **given)
    (name,) = given
    assert prepared[0][name] is given[name]


def test_reconstruct_without_a_crop_solves_for_the_whole_sensor(prepared):
    solution = reconstruct(SPIKES, scale=2, gain=GAIN)
    assert prepared[0]["spikes"].shape == SPIKES.shape and prepared[0]["gain"] is GAIN
    assert "crop" not in solution.stats


def test_sequence_crops_as_reconstruct_does(prepared):
    assert list(sequence(SPIKES, [3, 5], scale=2, crop=CROP, bad_pixels=BAD, gain=GAIN, strength=0.1)) == []
    (call,) = prepared
    np.testing.assert_array_equal(call["spikes"].spikes, SPIKES[CUT])
    np.testing.assert_array_equal(call["bad_pixels"], BAD[CUT])
    np.testing.assert_array_equal(call["gain"], GAIN[CUT])
    assert call["said"] == {"crop": CROP} and call["strength"] == 0.1 and "crop" not in call


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
def test_part_of_a_crop_that_is_none_is_refused(crop, message):
    with pytest.raises(InputError, match=message) as refused:
        Part.of(SPIKES, crop)
    assert ". " not in str(refused.value)


@pytest.mark.parametrize("crop", [(11, 17, 1, 1), (0, 0, 12, 18), [3, 5, 6, 7], np.array([3, 5, 6, 7])])
def test_part_of_a_crop_is_that_of_the_array(crop):
    part = Part.of(SPIKES, crop)
    top, left, height, width = crop
    np.testing.assert_array_equal(part.recording.spikes, SPIKES[:, top : top + height, left : left + width])
    assert part.said == {"crop": tuple(crop)} and {type(number) for number in part.said["crop"]} == {int}


def test_sequence_refuses_a_crop_when_it_is_called(prepared):
    with pytest.raises(InputError, match=SIZE):
        sequence(SPIKES, [3], scale=2, crop=(0, 0, 13, 1))
    assert prepared == []


def test_the_advice_to_crop_for_a_huge_scale_holds(monkeypatch):
    """Word for word: the same call with `crop` comes through. (It is dark, so that there is nothing to iterate.)"""
    monkeypatch.setattr(scsr_opt.inputs, "_MOST_PIXELS", 100)
    dark = np.zeros_like(SPIKES)
    with pytest.raises(InputError, match=r"take a smaller scale, or a crop\.$"):
        reconstruct(dark, scale=2, velocity=(0.0, 0.0))
    solution = reconstruct(dark, scale=2, velocity=(0.0, 0.0), crop=(2, 3, 5, 5))
    assert solution.image.shape == (10, 10) and solution.stats["crop"] == (2, 3, 5, 5)
    (solution,) = sequence(dark, [3], scale=2, crop=(2, 3, 5, 5))
    assert solution.image.shape == (10, 10) and solution.stats["crop"] == (2, 3, 5, 5)
