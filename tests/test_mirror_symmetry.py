"""A mirrored or transposed recording gives the mirrored or transposed picture, as far as docs/decisions/0001 says."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from scsr_opt import reconstruct
from scsr_opt.camera import Sensor, simulate
from scsr_opt.camera.samples import Samples, spike_intervals
from scsr_opt.camera.sampling_rules import Intervals
from scsr_opt.camera.scenes import Translation
from scsr_opt.camera.sparse import sparse_pixels
from scsr_opt.motion.trajectory import Motion
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.folds import held_out
from scsr_opt.pipeline.measurement import measure
from scsr_opt.priors import (
    BilateralTotalVariation,
    HuberTotalVariation,
    RidgeRegulariser,
    TotalGeneralizedVariation,
    TotalVariation,
    WaveletL1,
)


class Turn(NamedTuple):
    """A mirroring of pictures; it is its own inverse."""

    picture: Callable[[np.ndarray], np.ndarray]
    velocity: Callable[[float, float], tuple[float, float]]


TURNS = {
    "left-right": Turn(lambda a: a[..., ::-1].copy(), lambda down, right: (down, -right)),
    "upside-down": Turn(lambda a: a[..., ::-1, :].copy(), lambda down, right: (-down, right)),
    "transposed": Turn(lambda a: np.swapaxes(a, -1, -2).copy(), lambda down, right: (right, down)),
}
SHAPES = [(1, 1), (1, 9), (2, 2), (3, 5), (12, 11), (24, 32), (70, 101)]


@pytest.fixture(params=TURNS)
def turn(request) -> Turn:
    return TURNS[request.param]


def recorded(velocity: tuple[float, float], side: int = 32, frames: int = 41) -> np.ndarray:
    picture = data.brick()[100 : 100 + 2 * side, 150 : 150 + 2 * side]
    scene = Translation(picture, tuple(2 * v for v in velocity), key=float(frames // 2))
    return simulate(scene, scale=2, frames=frames, sensor=Sensor(photons=1000.0), seed=1).spikes


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("apart", [1, 2, 3, 5])
def test_sparse_pixels_of_a_turned_sensor_are_turned(turn, shape, apart):
    numbers = np.arange(shape[0] * shape[1]).reshape(shape)
    found = sparse_pixels(turn.picture(numbers), apart)
    np.testing.assert_array_equal(turn.picture(found), sparse_pixels(numbers, apart))
    assert found.size >= numbers.size / apart**2


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("moves", [True, False])
def test_held_out_samples_of_a_turned_sensor_are_turned(turn, shape, moves):
    def held(spikes: np.ndarray) -> np.ndarray:
        samples = spike_intervals(spikes, white_rate=0.6)
        chosen = held_out(samples, np.full(spikes.shape[1:], 2.0 * moves, np.float32))
        number = np.zeros(spikes.shape)  # by their first frames
        np.add.at(number, (np.maximum(samples.start, 0).astype(int), samples.row, samples.column), chosen)
        return number

    spikes = (np.random.default_rng(0).random((40, *shape)) < 0.3).astype(np.uint8)
    np.testing.assert_array_equal(turn.picture(held(turn.picture(spikes))), held(spikes))


@pytest.mark.parametrize(
    "velocity",
    [(0.06, 0.08), (0.1, 0.0), (0.05, 0.05), (-0.07, 0.24), (0.0, 0.35)],
)
def test_measured_positions_of_a_turned_recording_are_turned(turn, velocity):
    """Round velocities, by which an exposure moves by just what asks for more positions."""

    def found(spikes: np.ndarray, velocity: tuple[float, float]) -> tuple[Samples, np.ndarray, np.ndarray]:
        field = np.ones((2, *spikes.shape[1:]), np.float32) * np.array(velocity, np.float32)[:, None, None]
        motion = Motion.of_velocity(field, np.ones(spikes.shape[1:], np.float32))
        taken = measure(Clip(spikes, 20, 0.6, None), motion, scale=2, sampling=Intervals())
        number = taken.samples.row.size
        return taken.samples, np.asarray(taken.placed.positions)[:number], np.asarray(taken.placed.weight)[:number]

    def by_pixel(spikes: np.ndarray, velocity: tuple[float, float]) -> np.ndarray:
        samples, positions, weight = found(spikes, velocity)
        sums = np.zeros((2, *spikes.shape[1:]))
        for k, of in enumerate((positions, weight)):
            np.add.at(sums[k], (np.asarray(samples.row), np.asarray(samples.column)), of)
        return sums

    spikes = recorded(velocity, side=20)
    here, there = by_pixel(spikes, velocity), by_pixel(turn.picture(spikes), turn.velocity(*velocity))
    np.testing.assert_allclose(turn.picture(there), here, rtol=0, atol=1e-4)


# By how much Ψ of a picture of noise may change, as a share, if it is mirrored, and if it is transposed.
ALLOWED = [
    (TotalVariation(isotropic=False), 1e-6, 1e-6),
    (WaveletL1(), 1e-6, 1e-6),
    (BilateralTotalVariation(), 1e-6, 1e-6),
    (TotalVariation(), 0.02, 1e-6),  # forward differences: a vector of two sides of a pixel, not of the other two
    (HuberTotalVariation(), 0.02, 1e-6),
    (TotalGeneralizedVariation(), 0.02, 1e-6),
    (RidgeRegulariser.load("convex"), 1e-6, 5e-3),  # learned of pictures, in which down is another way than right
    (RidgeRegulariser.load("weakly_convex"), 1e-6, 0.03),
]


@pytest.mark.parametrize(("prior", "mirrored", "transposed"), ALLOWED, ids=lambda of: type(of).__name__)
def test_value_of_a_turned_picture_is_the_same_or_within_a_bound(prior, mirrored, transposed, turn):
    picture = np.random.default_rng(3).random((24, 30)).astype(np.float32)
    values = [float(prior.value(jnp.asarray(of))) for of in (picture, turn.picture(picture))]
    assert values[1] == pytest.approx(values[0], rel=transposed if turn is TURNS["transposed"] else mirrored)


@pytest.fixture(scope="module")
def spikes() -> np.ndarray:
    return recorded((0.06, 0.08))


def test_reconstruct_of_a_mirrored_recording_is_mirrored_at_a_given_strength(spikes):
    """Motion, samples, first picture, prior and solver: to rounding, but for border samples in view or not by it."""
    here = reconstruct(spikes, scale=2, strength=1.2e-3)
    for name in ("left-right", "upside-down"):
        there = reconstruct(TURNS[name].picture(spikes), scale=2, strength=1.2e-3)
        apart = TURNS[name].picture(there.image) - here.image
        assert np.abs(apart).max() < 1e-2 and np.sqrt(np.mean(apart**2)) < 3e-4


def test_reconstruct_of_a_turned_recording_is_turned_within_the_bounds(spikes):
    """The strength differs by what Huber-TV, by which it is looked for, makes of a mirrored picture."""
    here = reconstruct(spikes, scale=2)
    for name, (of_strength, rms) in {"left-right": (0.06, 1e-3), "transposed": (1e-3, 4e-3)}.items():
        there = reconstruct(TURNS[name].picture(spikes), scale=2)
        assert there.diagnostics.strength == pytest.approx(here.diagnostics.strength, rel=of_strength)
        apart = TURNS[name].picture(there.image) - here.image
        assert np.sqrt(np.mean(apart**2)) < rms
