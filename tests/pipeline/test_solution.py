"""`Solution`: what a reconstruction hands out, and what it can do with it."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from scsr_opt import Diagnostics, InputError, Recording, Solution, SolveError, Status, reconstruct
from scsr_opt.motion import Motion
from scsr_opt.report import read_picture
from scsr_opt.solvers import TileIterations

HEIGHT, WIDTH, SCALE = 6, 8, 2


@pytest.fixture
def solution() -> Solution:
    """A made-up one: a ramp, at frame 3 of a recording that says of itself that it is another one's."""
    recording = Recording.from_array(np.ones((9, HEIGHT, WIDTH), np.uint8), white_rate=0.5)
    return Solution(
        image=np.linspace(0, 1, SCALE**2 * HEIGHT * WIDTH, dtype=np.float32).reshape(SCALE * HEIGHT, SCALE * WIDTH),
        recording=recording,
        scale=SCALE,
        key=3,
        white_rate=0.25,
        status=Status.converged,
        motion=Motion.constant((0.5, -1.0), (HEIGHT, WIDTH)),
    )


def test_solution_fields_are_named():
    """By position they would be mistaken for each other when one is added."""
    with pytest.raises(TypeError):
        Solution(np.zeros((4, 4), np.float32), Status.converged)  # type: ignore[call-arg]
    with pytest.raises(TypeError):
        Diagnostics(5, 7)  # type: ignore[call-arg]


def test_velocity_and_confidence_are_those_of_the_motion(solution):
    np.testing.assert_array_equal(solution.velocity, solution.motion.velocity)
    np.testing.assert_array_equal(solution.confidence, np.ones((HEIGHT, WIDTH)))
    without = dataclasses.replace(solution, motion=None)
    assert without.velocity is None and without.confidence is None


def test_save_npz_holds_picture_motion_scale_and_key(solution, tmp_path):
    solution.save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as stored:
        np.testing.assert_array_equal(stored["velocity"], solution.velocity)
        np.testing.assert_array_equal(stored["confidence"], solution.confidence)
        assert stored["scale"] == SCALE and stored["key"] == 3
    np.testing.assert_array_equal(read_picture(tmp_path / "a.npz"), solution.image)
    dataclasses.replace(solution, motion=None).save(tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as stored:
        assert "velocity" not in stored and "confidence" not in stored and stored["key"] == 3


@pytest.mark.parametrize(
    ("name", "bits", "last_digit"), [("a.png", 8, 255), ("a.png", 16, 65535), ("a.tif", 32, 2**24)]
)
def test_save_picture_has_as_many_bits_as_asked_for(solution, tmp_path, name, bits, last_digit):
    solution.save(tmp_path / name, bits=bits)
    np.testing.assert_allclose(read_picture(tmp_path / name), solution.image, atol=0.51 / last_digit)


def test_save_gamma_is_that_of_the_file(solution, tmp_path):
    solution.save(str(tmp_path / "a.png"), bits=16, gamma=2.0)
    np.testing.assert_allclose(read_picture(tmp_path / "a.png"), np.sqrt(solution.image), atol=1e-4)


@pytest.mark.parametrize("status", Status)
def test_save_only_what_is_usable_is_written(solution, tmp_path, status):
    there = dataclasses.replace(solution, status=status)
    if status.usable:
        there.save(tmp_path / "a.png")
        assert (tmp_path / "a.png").exists()
    else:
        with pytest.raises(InputError, match=r"a\.png was not written, as the solve failed: [a-z].*\.$"):
            there.save(tmp_path / "a.png")
        assert not (tmp_path / "a.png").exists()


def test_status_usable_and_message_of_each():
    assert {status.name for status in Status if not status.usable} == {"non_finite", "no_samples"}
    for status in Status:
        assert status.message[0].isupper() and status.message.endswith(".") and ". " not in status.message
        assert f"{status.clause[0].upper()}{status.clause[1:]}." == status.message


def test_tile_iterations_lines_say_what_was_iterated_further():
    further, none = np.array([[0, 12], [3, 0]]), np.zeros((2, 2), int)
    some = TileIterations(7, further, 64, 8e-4, 1e-3).lines()
    assert some == [
        "Iterations: 7 of the whole picture, then up to 12 more on 2 of its 4 squares of 64x64 pixels; the others had "
        "converged.",
        "One more iteration would change no square by more than 0.08 % of the picture's root mean square (limit: "
        "0.1 %).",
    ]
    assert TileIterations(7, none, 64, float("nan"), 1e-3).lines() == ["Iterations: 7 of the whole picture."]


@pytest.mark.parametrize(
    "options", [{}, {"bad_pixels": np.ones((8, 9), bool)}, {"motion": Motion.constant((1e6, 0), (8, 9))}], ids=str
)
def test_reconstruct_failed_raises_only_where_it_is_asked_to(options: dict[str, Any]):
    """Nothing fired; all that did is bad; all of it has left the picture."""
    spikes = np.full((11, 8, 9), bool(options), np.uint8)
    failed = reconstruct(spikes, scale=2, **options)
    assert failed.status is Status.no_samples and failed.stages == () and not failed.image.any()
    assert failed.diagnostics.iterations == failed.diagnostics.samples == 0 and failed.diagnostics.strength is None
    assert failed.recording.frames == 11 and failed.scale == 2 and failed.key == 5
    with pytest.raises(SolveError) as caught:
        reconstruct(spikes, scale=2, throw=True, **options)
    assert str(caught.value) == Status.no_samples.message


def test_reconstruct_solution_knows_what_it_is_of():
    """The key frame is one of the recording, whichever frames were used; the level of white is that asked for."""
    recording = Recording.from_array((np.arange(41)[:, None, None] % 2 * np.ones((1, 8, 9))).astype(np.uint8))
    found = reconstruct(recording, scale=1, key=30, frames=11, white_rate=0.5, motion=Motion.none(8, 9), throw=True)
    assert found.recording is recording and (found.scale, found.key, found.white_rate) == (1, 30, 0.5)
    assert found.diagnostics.iterations == len(found.stages) and found.status.usable
    assert found.diagnostics.solver == "DataProximal" and found.diagnostics.positions == 1
    assert found.diagnostics.motion_carried is None and found.diagnostics.seconds.keys() >= {"samples", "solving"}
    np.testing.assert_allclose(found.image, 1.0, atol=0.1)  # a spike in every second frame
