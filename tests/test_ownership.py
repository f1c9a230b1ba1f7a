"""Arguments may be overwritten after a call, and results may be written to."""

import copy
import dataclasses
import gc
import pickle
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from scsr_opt import Recording, Shortcuts, Solution, reconstruct, reconstruct_sequence
from scsr_opt.baselines import conventional_camera, stp_bicubic, tfi_bicubic, tfp_bicubic
from scsr_opt.calibration import flat_gain, gain_at_rest
from scsr_opt.camera import (
    Sensor,
    Static,
    interval_rates,
    simulate,
    spike_intervals,
    stp,
    tfi,
    tfp,
    windows,
)
from scsr_opt.motion import Global, Motion, estimate_motion
from scsr_opt.motion.trajectory import Layers
from scsr_opt.motion.validation import validate_motion
from scsr_opt.operators import Warp
from scsr_opt.priors import Centred, TotalVariation

KEYS = (14, 18)


def moving_spikes() -> np.ndarray:
    """(32, 12, 16): a pattern that moves by 0.1 pixels a frame to the right."""
    rows, columns = np.mgrid[0:12, 0:16]
    charge, spikes = np.random.default_rng(0).random((12, 16)), np.zeros((32, 12, 16), np.uint8)
    for t in range(32):
        charge += 0.3 + 0.2 * np.sin((columns - 0.1 * t) * 0.9) * np.cos(rows * 0.6)
        spikes[t] = charge >= 1
        charge -= spikes[t]
    return spikes


def options() -> dict[str, Any]:
    """Arrays of each kind that `reconstruct` takes and that hold for several moments."""
    bad = np.zeros((12, 16), bool)
    bad[3, 4] = True
    return {
        "bad_pixels": bad,
        "gain": np.random.default_rng(1).uniform(0.95, 1.05, (12, 16)),
        "strength": np.array(0.003),
        "white_rate": np.array(0.6),
        "frames": np.array(24),
    }


def arrays_of(value: Any, path: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """The NumPy arrays in a value, with their places. A state is JAX's, which nobody can write to, and a
    recording is what the caller gave."""
    if isinstance(value, np.ndarray):
        yield path, value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            if field.name not in ("state", "recording"):
                yield from arrays_of(getattr(value, field.name), f"{path}.{field.name}")
    elif isinstance(value, dict):
        for name, part in value.items():
            yield from arrays_of(part, f"{path}[{name}]")
    elif isinstance(value, tuple | list):
        for number, part in enumerate(value):
            yield from arrays_of(part, f"{path}[{number}]")


@pytest.fixture(scope="module")
def undisturbed() -> list[Solution]:
    return list(reconstruct_sequence(moving_spikes(), KEYS, scale=2, **options()))


@pytest.mark.parametrize("as_recording", [False, True])
def test_sequence_arrays_overwritten_on_the_way_change_no_picture(undisturbed, as_recording):
    """Neither arguments nor results are read again after the call."""
    spikes, given = moving_spikes(), options()
    bad = given["bad_pixels"]
    recording = Recording.from_array(spikes, bad_pixels=given.pop("bad_pixels")) if as_recording else spikes
    solutions = reconstruct_sequence(recording, KEYS, scale=2, **given)

    def overwrite() -> None:
        spikes[:], bad[:] = 1, True
        for array in given.values():
            array[...] = 1
        if isinstance(recording, Recording):
            assert recording.bad_pixels is not None
            recording.bad_pixels[:] = True

    overwrite()
    for number, solution in enumerate(solutions):
        np.testing.assert_array_equal(solution.image, undisturbed[number].image)
        assert solution.diagnostics.motion_carried == undisturbed[number].diagnostics.motion_carried
        for _, array in arrays_of(solution):
            array[...] = 1
        solution.diagnostics.seconds.clear()


def test_sequence_solutions_are_all_writable(undisturbed):
    found = [place for solution in undisturbed for place, array in arrays_of(solution) if not array.flags.writeable]
    assert undisturbed[1].diagnostics.motion_carried  # which has other arrays than one whose motion is estimated
    assert not found
    places = {place for place, _ in arrays_of(undisturbed[1])}
    assert {".image", ".motion.velocity", ".motion.confidence", ".gain", ".scene.kind"} <= places


def test_solution_fields_are_multiplied_in_place(undisturbed):
    solution = undisturbed[0].handed_out()
    image, velocity, confidence = (np.array(v) for v in (solution.image, solution.velocity, solution.confidence))
    solution.image *= 255
    solution.velocity *= 2
    solution.confidence *= 0.5
    solution.gain += 1
    np.testing.assert_array_equal(solution.image, 255 * image)
    np.testing.assert_array_equal(solution.velocity, 2 * velocity)
    np.testing.assert_array_equal(solution.confidence, 0.5 * confidence)
    np.testing.assert_array_equal(undisturbed[0].image, image)
    np.testing.assert_array_equal(undisturbed[0].velocity, velocity)


def test_reconstruct_solution_that_is_let_go_leaves_no_array_behind():
    solution = reconstruct(moving_spikes(), scale=2, strength=0.003)
    arrays = [weakref.ref(array) for _, array in arrays_of(solution)]
    assert solution.motion is not None and any(array() is solution.motion.velocity for array in arrays)
    del solution
    gc.collect()
    assert [array() for array in arrays] == [None] * len(arrays)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda motion: pickle.loads(pickle.dumps(motion))])
def test_motion_that_is_copied_and_let_go_is_let_go(copied: Callable[[Motion], Motion]):
    ones = np.ones((3, 4), np.float32)
    pair = np.stack([ones, 2 * ones])
    layers = Layers(np.stack([pair, pair]), np.stack([pair, pair]), np.zeros((3, 4), int), np.arange(2))
    found = copied(Motion(pair, pair, ones, layers, reach=5 * ones))
    assert found.layers is not None and found.reach is not None
    np.testing.assert_array_equal(found.reach, 5 * ones)
    np.testing.assert_array_equal(found.layers.depth, [0, 1])
    parts = [weakref.ref(part) for part in (found, found.layers)]
    del found, layers
    gc.collect()
    assert [part() for part in parts] == [None, None]


def test_reconstruct_pictures_of_stages_are_writable_and_the_motion_a_copy():
    """A motion that is given is part of the solution as a copy, not the caller's own array."""
    motion = Motion.of_velocity(np.full((2, 12, 16), 0.05, np.float32))
    solution = reconstruct(
        moving_spikes(), scale=2, motion=motion, gain=None, strength=0.003, keep_images=True, shortcuts=Shortcuts.none()
    )
    last = solution.stages[-1].image
    assert last is not None
    last *= 2
    assert solution.velocity is not None
    solution.velocity[:] = 7
    np.testing.assert_array_equal(motion.velocity, np.float32(0.05))
    assert not [place for place, array in arrays_of(solution) if not array.flags.writeable]


MADE = {
    "tfp": lambda spikes: tfp(spikes, 16),
    "tfi": lambda spikes: tfi(spikes, 16),
    "stp": lambda spikes: stp(spikes, 16),
    "tfp_bicubic": lambda spikes: tfp_bicubic(spikes, scale=2),
    "tfi_bicubic": lambda spikes: tfi_bicubic(spikes, scale=2),
    "stp_bicubic": lambda spikes: stp_bicubic(spikes, scale=2),
    "tfp_bicubic of a recording with bad pixels": lambda spikes: tfp_bicubic(
        Recording.from_array(spikes, bad_pixels=options()["bad_pixels"]), scale=1
    ),
    "conventional_camera": lambda spikes: conventional_camera(spikes, scale=2),
    "Recording.spikes": lambda spikes: Recording.from_array(spikes).spikes,
    "Recording.window": lambda spikes: Recording.from_array(spikes).window(3, 9),
    "Recording.crop": lambda spikes: Recording.from_array(spikes).crop(2, 3, 4, 5).spikes,
    "interval_rates": lambda spikes: interval_rates(spikes, np.array([2.0, 12.0, 30.0])),
    "spike_intervals": spike_intervals,
    "windows": lambda spikes: windows(spikes, length=4),
    "flat_gain": flat_gain,
    "gain_at_rest": lambda spikes: gain_at_rest(spikes, white_rate=0.6),
    "estimate_motion": lambda spikes: estimate_motion(spikes, key=16, estimator=Global()),
    "Motion.constant": lambda _: Motion.constant((0.1, 0.2), (12, 16)),
    "simulate": lambda spikes: [
        (made := simulate(Static(spikes.mean(0)), scale=2, frames=4, sensor=Sensor())).spikes,
        made.gain, made.dead, made.bad_pixels, made.truth(0), made.velocity(0),
    ],
}  # fmt: skip


@pytest.mark.parametrize("maker", MADE)
def test_maker_arrays_are_writable(maker):
    found = list(arrays_of(MADE[maker](moving_spikes())))
    assert found
    assert not [place for place, array in found if not array.flags.writeable]


def test_checked_motion_overwritten_afterwards_stays_what_it_was():
    mine = Motion.of_velocity(np.full((2, 6, 8), 0.5, np.float32))
    motion = validate_motion(mine, 6, 8)
    mine.velocity[:] = 9
    np.testing.assert_array_equal(motion.velocity, np.float32(0.5))


# 64-byte alignment is what JAX asks for to look at an array in place; NumPy gives it to large ones by chance.
@pytest.mark.parametrize("keeper", [lambda a: Centred(TotalVariation(), a[0]).centre, lambda a: Warp(a).displacement])
def test_keeper_array_overwritten_afterwards_stays_what_it_was(keeper):
    memory = np.zeros(2 * 64 * 64 * 4 + 64, np.uint8)
    begin = -memory.ctypes.data % 64
    mine = memory[begin : begin + 2 * 64 * 64 * 4].view(np.float32).reshape(2, 64, 64)
    kept = keeper(mine)
    mine[:] = 9
    assert not np.asarray(kept).any()
