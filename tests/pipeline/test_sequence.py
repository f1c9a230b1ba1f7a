"""`reconstruct_sequence`: pictures of many moments beside those of `reconstruct`, and what is saved."""

import copy
import dataclasses
import threading

import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from scsr_opt import InputError, Recording, Shortcuts, reconstruct, reconstruct_sequence
from scsr_opt.camera import Sensor, simulate
from scsr_opt.camera.scenes import MovingObject, Static, Translation
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.motion import Global, Motion
from scsr_opt.pipeline import sequence
from scsr_opt.pipeline.assembly import assemble_task
from scsr_opt.pipeline.options import Options
from scsr_opt.pipeline.sequence import _frames, _where_seen
from scsr_opt.pipeline.strength import StrengthSearch
from scsr_opt.pipeline.task import task_of

PICTURE = data.camera()[90:250, 150:310]
SMALL = PICTURE[:96, :96]
SCALE = 2
KEYS = (56, 58, 61, 64)


def simulated(scene, frames: int = 121):
    return simulate(scene, scale=SCALE, frames=frames, sensor=Sensor(photons=1000.0), seed=3)


def test_reconstruct_sequence_pan_is_carried_on_to_the_pictures_of_single_solves(monkeypatch):
    """Up to where a solve ends: what exposures blur comes back slowly, from either side (0.1 dB at most was seen)."""
    made = simulated(Translation(SMALL, velocity=(0.22, -0.34), key=55))
    keys = (50, 54, 58)
    validated, find = [], StrengthSearch.find
    with monkeypatch.context() as patched:
        patched.setattr(
            StrengthSearch, "find", lambda *given, **options: validated.append(find(*given, **options)) or validated[-1]
        )
        solutions = list(reconstruct_sequence(made.spikes, keys, scale=SCALE))
    assert [solution.diagnostics.motion_carried for solution in solutions] == [False, True, True]
    # Found with the motion, and carried on with it.
    assert [found.strength for found in validated] == pytest.approx([solutions[0].diagnostics.strength])
    assert len({solution.diagnostics.strength for solution in solutions}) == 1
    for key, solution in zip(keys, solutions, strict=True):
        alone = reconstruct(made.spikes, scale=SCALE, key=key)
        truth = made.truth(key)
        assert abs(psnr(truth, solution.image, 8) - psnr(truth, alone.image, 8)) < 0.15
        assert solution.velocity is not None
        assert np.abs(np.median(solution.velocity, axis=(1, 2)) - [0.11, -0.17]).max() < 0.002


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.22, -0.34)])
def test_reconstruct_sequence_goes_on_from_the_picture_before(velocity):
    """To the same minimum, in fewer iterations than one from playback with the same motion and strength."""
    made = simulated(Translation(SMALL, velocity=velocity, key=55))
    *_, last = reconstruct_sequence(made.spikes, KEYS, scale=SCALE)
    assert last.diagnostics.motion_carried and last.motion is not None
    anew = reconstruct(made.spikes, scale=SCALE, key=KEYS[-1], motion=last.motion, strength=last.diagnostics.strength)
    print(f"{last.diagnostics.iterations} iterations instead of {anew.diagnostics.iterations}")
    assert last.diagnostics.iterations < anew.diagnostics.iterations
    assert last.diagnostics.objective == pytest.approx(anew.diagnostics.objective, rel=1e-3)


def test_where_seen_bad_pixels_begin_at_playback():
    """Half of the sensor is bad."""
    made = simulated(Translation(PICTURE, velocity=(0.22, -0.34), key=55))
    bad = np.zeros(made.spikes.shape[1:], bool)
    bad[:, 40:] = True
    options = Options(motion=Motion.none(80, 80), strength=0.01, bad_pixels=bad, shortcuts=Shortcuts.none())
    placed = assemble_task(task_of(made.spikes, SCALE, 50, options)).measurements.placed
    begun = _where_seen(placed, jnp.zeros((160, 160)), jnp.ones((160, 160)), 0.1)
    np.testing.assert_array_equal(begun[:, :80], 0)
    np.testing.assert_array_equal(begun[:, 80:], 1)


def test_an_object_takes_its_layer_along():
    """Where it is seen is found anew; without that, 10 frames cost 0.4 dB."""
    made = simulated(MovingObject(PICTURE, data.brick()[:60, :60], velocity=(0.3, 0.5), key=55))
    _, solution = reconstruct_sequence(made.spikes, (50, 58), scale=SCALE)
    assert solution.diagnostics.motion_carried
    alone = psnr(made.truth(58), reconstruct(made.spikes, scale=SCALE, key=58).image, 8)
    assert psnr(made.truth(58), solution.image, 8) > alone - 0.1


def test_motion_is_found_anew_where_it_changes():
    """A pan that stops: two recordings, one after the other. Neither motion holds for both.

    A picture whose motion is estimated anew finds bad pixels of its own and is that of `reconstruct`, bit for bit; the
    one that follows it leaves out the same pixels.
    """
    before = simulated(Translation(PICTURE, velocity=(0.22, -0.34), key=60))
    after = simulated(Static(before.truth(120)), 121)
    spikes = np.concatenate([before.spikes, after.spikes])
    spikes[:121, 30, 40], spikes[:, 52, 24] = 0, 0  # dead while the scene moves, and all the time
    solutions = list(reconstruct_sequence(spikes, (60, 68, 180, 188), scale=SCALE))
    assert [solution.diagnostics.motion_carried for solution in solutions] == [False, True, False, True]
    assert solutions[2].velocity is not None and not solutions[2].velocity.any()
    for place, dead in ((0, (30, 40)), (2, (52, 24))):
        alone = reconstruct(spikes, scale=SCALE, key=solutions[place].key)
        np.testing.assert_array_equal(solutions[place].image, alone.image)
        assert alone.bad_pixels is not None and alone.bad_pixels.mask[dead]
        for solution in solutions[place : place + 2]:
            assert solution.bad_pixels is not None
            np.testing.assert_array_equal(solution.bad_pixels.kind, alone.bad_pixels.kind)


@pytest.mark.slow  # like one that changes, with longer solves
def test_motion_is_found_anew_where_something_comes_into_view():
    """A disc passes from one frame to the next before what had been a still wall."""
    wall = simulated(Static(PICTURE), 81)
    passing = simulated(MovingObject(PICTURE, data.brick()[:60, :60], velocity=(0.3, 0.5), key=40), 81)
    both = Recording.from_array(np.concatenate([wall.spikes, passing.spikes]))
    solutions = list(reconstruct_sequence(both, (40, 45, 113, 121), scale=SCALE, frames=61))
    assert [solution.diagnostics.motion_carried for solution in solutions[:2]] == [False, True]
    assert not solutions[2].diagnostics.motion_carried or not solutions[3].diagnostics.motion_carried
    assert solutions[3].velocity is not None and solutions[3].velocity.any()


def test_a_motion_is_not_carried_on_for_ever():
    made = simulated(Static(SMALL))
    solutions = reconstruct_sequence(made.spikes, range(50, 67, 4), scale=SCALE)
    assert [solution.diagnostics.motion_carried for solution in solutions] == [False, True, True, False, True]


def test_reconstruct_sequence_far_pictures_are_made_once_though_solves_change_the_motion(monkeypatch):
    """What is made ahead is thrown away only where it follows the motion that a solve has changed."""
    solve, assembled = sequence.solve, []

    def changed(*given):
        solution = solve(*given)
        return dataclasses.replace(solution, motion=copy.copy(solution.motion))

    def counted(task):
        assembled.append(task.clip.key_frame)
        return assemble_task(task)

    monkeypatch.setattr(sequence, "solve", changed)
    monkeypatch.setattr(sequence, "assemble_task", counted)
    keys = (20, 40, 60)  # further apart than a motion is carried on
    solutions = reconstruct_sequence(simulated(Static(SMALL)).spikes, keys, scale=SCALE, strength=0.01)
    assert [solution.key for solution in solutions] == assembled == list(keys)


def test_reconstruct_sequence_options_hold_for_all_pictures():
    made = simulated(Translation(SMALL, velocity=(0.22, -0.34), key=55))
    options = Options(strength=0.01, motion=Global(affine=False), gain=np.ones((48, 48)))
    first, second = reconstruct_sequence(made.spikes, (50, 60), scale=SCALE, options=options, frames=61)
    assert first.diagnostics.strength == second.diagnostics.strength == pytest.approx(0.01)
    assert second.velocity is not None and np.ptp(second.velocity, axis=(1, 2)).max() == 0


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ([5, 61], r"keys\[1\] is 61; it must be a whole number, from 0 to 60"),
        ([50, 500], r"keys\[1\] is 500"),
        ([500], r"keys\[0\] is 500"),
        (range(0, 101, 50), r"keys\[2\] is 100"),
        (range(60, -31, -30), r"keys\[3\] is -30"),
        (np.array([3, -1]), r"keys\[1\] is np.int64\(-1\)"),
        ([True, False], r"keys\[0\] is True"),
        ([], r"keys is \[\]; it must be the frames of the pictures"),
        (range(50, 20, 5), r"keys is range\(50, 20, 5\); it must be the frames"),
    ],
)
def test_sequence_with_keys_that_are_no_frames_is_refused_by_the_call(monkeypatch, keys, message):
    """Before the first picture is asked for, and before anything is done for it."""
    monkeypatch.setattr("scsr_opt.pipeline.sequence.task_of", None)
    with pytest.raises(InputError, match=message):
        reconstruct_sequence(np.ones((61, 8, 8), np.uint8), keys, scale=SCALE)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ([3, 4.0], r"keys\[1\] is 4.0; it must be a whole number, from 0 to 60"),
        (np.linspace(0, 60, 3), r"keys\[0\] is np.float64\(0.0\)"),
        (np.array([True, False]), r"keys\[0\] is np.True_"),
        ([3, None], r"keys\[1\] is None"),
        (["3"], r"keys\[0\] is '3'"),
        (np.array([[3, 4]]), r"keys\[0\] is an array of shape \(2,\)"),
        (iter(()), "it must be the frames of the pictures"),
        ("50", "keys is '50'; it must be the frames"),
        (b"50", "keys is b'50'; it must be the frames"),
        (50, "keys is 50; it must be the frames"),
        (None, "keys is None; it must be the frames"),
    ],
)
def test_frames_of_another_type_are_refused(keys, message):
    with pytest.raises(InputError, match=message):
        _frames(keys, Recording.from_array(np.ones((61, 8, 8), np.uint8)))


@pytest.mark.parametrize("keys", [[3, 3], (5, 3), np.array([3, 4]), {3: 1, 4: 1}, (key for key in (3, 4)), range(3, 5)])
def test_frames_in_any_order_and_container_are_taken(keys):
    found = _frames(keys, Recording.from_array(np.ones((20, 8, 8), np.uint8)))
    assert found in ((3, 3), (5, 3), (3, 4)) and {type(key) for key in found} == {int}


def test_a_sequence_that_nobody_wants_any_more_ends():
    made = simulated(Static(SMALL), 61)
    following = reconstruct_sequence(made.spikes, range(20, 41), scale=SCALE, frames=31)
    assert next(following).status.usable
    before = threading.active_count()
    following.close()
    assert threading.active_count() < before  # nothing is prepared in the background


def test_reconstruct_sequence_motion_that_a_solve_changes_is_followed_anew():
    """A fixed pattern rests while the scene moves, and only the first picture can tell the two apart."""
    made = simulate(
        Translation(PICTURE, velocity=(0.3, -0.4), key=55), scale=SCALE, frames=121,
        sensor=Sensor(photons=1000.0, fixed_pattern=0.1), seed=3,
    )  # fmt: skip
    first, second = reconstruct_sequence(made.spikes, (50, 55), scale=SCALE)
    assert (first.diagnostics.gain_spread or 0) > 0.05 and second.diagnostics.motion_carried
    assert first.motion is not None and second.motion is not None
    assert np.abs(first.motion.velocity - second.motion.velocity).max() < 1e-3
    assert second.diagnostics.strength == first.diagnostics.strength
    # The pattern is the camera's: it is found once.
    assert first.gain is not None and np.std(first.gain) > 0.05
    np.testing.assert_array_equal(second.gain, first.gain)


def test_nothing_to_see_is_no_reason_to_stop():
    dark = Recording.from_array(np.zeros((40, 8, 8), np.uint8))
    assert [solution.status.usable for solution in reconstruct_sequence(dark, (10, 20), scale=SCALE)] == [False, False]
    assert len(list(reconstruct_sequence(np.ones((2, 8, 8), np.uint8), (0, 1), scale=SCALE))) == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"key": 3}, "given key"),
        ({"state": 3}, "given state"),
        ({"motion": Motion.constant((0.1, 0.2), (8, 8))}, "which holds at one key frame; give an Estimator"),
        ({"frames": 0}, "frames"),
        ({"scale": 0}, "scale"),
        ({"strenght": 0.1}, r"no option 'strenght' \(did you mean strength\?\)"),
        ({"gain": np.ones((3, 3))}, "gain is an array of shape"),
        ({"strength": -1.0}, "strength"),
    ],
)
def test_reconstruct_sequence_option_that_cannot_be_used_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        list(reconstruct_sequence(np.ones((20, 8, 8), np.uint8), (10,), **{"scale": SCALE, **options}))
