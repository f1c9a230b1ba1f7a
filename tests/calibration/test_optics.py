"""The lens from the recording, against the lens that the simulator had."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from scsr_opt.calibration.optics import GaussianOptics, estimate_gaussian_optics
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.camera.scenes import Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.sampling import PlacedSamples, place
from scsr_opt.priors.total_variation import TotalVariation
from scsr_opt.solvers.loop import run
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA

SCALE, VELOCITY = 2, (0.11, -0.17)
PICTURE = data.camera()[90:190, 150:250]


def recorded(sigma: float) -> tuple[PlacedSamples, jax.Array]:
    scene = Translation(PICTURE, velocity=tuple(v * SCALE for v in VELOCITY), key=40)
    made = simulate(scene, scale=SCALE, frames=81, sensor=Sensor(psf_sigma=sigma * SCALE, photons=1000.0), seed=1)
    height, width = made.spikes.shape[1:]
    samples = jax.tree.map(jnp.asarray, spike_intervals(made.spikes).padded())
    motion = Motion.of_velocity(np.broadcast_to(np.array(VELOCITY, np.float32)[:, None, None], (2, height, width)))
    path = trajectory_of(motion, key=40, start=0, stop=81)
    placed = place(samples, path, scale=SCALE, shape=(SCALE * height, SCALE * width))
    return placed, samples.row * width + samples.column


def solve(term: DataTerm) -> jax.Array:
    start = jnp.full(term.shape, 0.5, jnp.float32)
    # Weights are in frames here, so the strength is 81 times what it is for weights of sum 1.
    problem = Problem(term, TotalVariation(), jnp.asarray(0.08, jnp.float32))
    return jnp.asarray(run(FISTA(iterations=150), problem, start, tolerance=1e-3).image)


def estimated(sigma: float) -> GaussianOptics:
    placed, pixel = recorded(sigma)
    return estimate_gaussian_optics(placed, pixel, solve, tried=(0.0, 0.4, 0.8, 1.2, 1.6))


@pytest.mark.parametrize("sigma", [0.0, 0.8])
def test_the_width_of_the_lens_is_found(sigma):
    found = estimated(sigma)
    # The grid is 0.4 wide; on other pictures errors were up to 0.15, and up to 0.5 at 1.25 (docs/data-term.md).
    assert found.sigma == pytest.approx(sigma, abs=0.3)
    assert found.errors.min() == 1 and found.errors[-1] > 1 + found.significant[-1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tried": (1.0,)}, "two or more rising"),
        ({"tried": (0.5, 0.2)}, "two or more rising"),
        ({"tried": (-1.0, 0.2)}, "two or more rising"),
        ({"share": 0.0}, "share is 0.0, but it must be between 0 and 1"),
    ],
)
def test_what_cannot_be_used_is_said(change, message):
    placed, pixel = recorded(0.0)
    with pytest.raises(InputError, match=message):
        estimate_gaussian_optics(placed, pixel, solve, **change)
