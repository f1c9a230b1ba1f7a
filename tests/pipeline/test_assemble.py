"""`assemble`: the problem that `reconstruct` solves, for a solver or a prior of one's own."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from scsr_opt import InputError, Options, Solution, assemble, reconstruct
from scsr_opt.camera import Sensor, simulate
from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.motion import Motion
from scsr_opt.operators import Huber, PlacedSamples, accumulate
from scsr_opt.operators.exposure import ExposedStencil
from scsr_opt.pipeline.assembly import assemble_task
from scsr_opt.pipeline.task import task_of
from scsr_opt.priors import HuberTotalVariation, Prior
from scsr_opt.solvers import FISTA, LBFGS, Problem, Solver, Status, run

FRAMES, SCALE, KEY = 41, 2, 20
VELOCITY = (0.21, -0.33)
STRENGTH = 3e-3


@pytest.fixture(scope="module")
def spikes() -> np.ndarray:
    """24×24 sensor pixels in dim light: three to four frames from spike to spike, in which the scene moves a pixel."""
    scene = Translation(data.camera()[110:158, 190:238], velocity=(VELOCITY[0] * SCALE, VELOCITY[1] * SCALE), key=KEY)
    return simulate(scene, scale=SCALE, frames=FRAMES, sensor=Sensor(white_rate=0.3, photons=500.0), seed=3).spikes


def options(solver: Solver | None = None) -> Options:
    """The motion known, a smooth prior, and no gains, which are found by solves."""
    return Options(
        motion=Motion.constant(VELOCITY, (24, 24)), white_rate=0.3, prior=HuberTotalVariation(), strength=STRENGTH,
        gain=None, solver=solver,
    )  # fmt: skip


@pytest.fixture(scope="module")
def problem(spikes) -> Problem:
    return assemble(spikes, scale=SCALE, options=options())


@pytest.fixture(scope="module")
def placed(spikes) -> PlacedSamples:
    """The samples that the problem was assembled of."""
    found = assemble_task(task_of(spikes, SCALE, None, options())).measurements.placed
    assert found.finest >= 3
    return found


@pytest.fixture(scope="module")
def solution(spikes) -> Solution:
    return reconstruct(spikes, scale=SCALE, options=options(FISTA(iterations=3000, tolerance=1e-6)))


@pytest.fixture(scope="module")
def pictures() -> list[jax.Array]:
    """Noise, a ramp, and a constant."""
    random = np.random.default_rng(0).random((48, 48), np.float32)
    rows, columns = np.indices((48, 48), np.float32) / np.float32(48)
    return [
        jnp.asarray(picture) for picture in (random, 0.3 * rows + 0.5 * columns, np.full((48, 48), np.float32(0.4)))
    ]


def sums(placed: PlacedSamples, image: jax.Array) -> jax.Array:
    """½ Σ_j ω_j (r_j·B X − Y_j)², sample by sample, each r_j along all of its exposure."""
    seen = placed.read(accumulate(placed).blurred(image))
    return 0.5 * jnp.sum(placed.weight * (seen - placed.value) ** 2)


def test_assemble_gives_prior_strength_and_the_initial_image(problem, spikes):
    assembly = assemble_task(task_of(spikes, SCALE, None, options()))
    assert isinstance(problem.prior, HuberTotalVariation) and float(problem.strength) == pytest.approx(STRENGTH)
    assert problem.start is not None and problem.start.shape == problem.data.shape == (48, 48)
    np.testing.assert_array_equal(problem.start, assembly.image)
    assert isinstance(problem.data.stencil, ExposedStencil)


def test_assemble_value_is_the_sum_over_exposures(problem, placed, pictures):
    for image in [*pictures, problem.start]:
        # f is the difference of sums up to ten times as large, rounded to seven digits each.
        assert float(problem.data.value(image)) == pytest.approx(float(sums(placed, image)), rel=2e-5)
        # And not that of the quadratic in its place, which has no more than the places of each exposure.
        assert float(accumulate(placed).value(image)) > 1.001 * float(sums(placed, image)) or image is pictures[2]


def test_assemble_gradient_is_that_of_the_sum(problem, placed, pictures):
    for image in [*pictures, problem.start]:
        by_hand = jax.grad(lambda picture: sums(placed, picture))(image)
        level = float(jnp.abs(by_hand).max())
        np.testing.assert_allclose(problem.data.gradient(image), by_hand, atol=1e-5 * level)
        # The value may be differentiated, too.
        np.testing.assert_allclose(jax.grad(problem.data.value)(image), by_hand, atol=1e-5 * level)


def test_assemble_stencil_is_symmetric(problem):
    rng = np.random.default_rng(1)
    for _ in range(3):
        u, v = (jnp.asarray(rng.standard_normal(problem.data.target.shape), jnp.float32) for _ in range(2))
        one, other = jnp.sum(u * problem.data.stencil(v)), jnp.sum(v * problem.data.stencil(u))
        size = jnp.linalg.norm(u) * jnp.linalg.norm(problem.data.stencil(v))
        assert abs(float(one - other)) < 1e-5 * float(size)
        assert float(jnp.sum(u * problem.data.stencil(u))) > 0


@pytest.mark.parametrize("solver", [FISTA(iterations=3000, tolerance=1e-6), LBFGS(iterations=1000, tolerance=1e-5)])
def test_run_assembled_problem_ends_at_the_picture_of_reconstruct(problem, placed, solution, solver):
    def objective(image: np.ndarray) -> float:
        picture = jnp.asarray(image)
        return float(sums(placed, picture) + problem.strength * problem.prior.value(picture))

    found = run(solver, problem)
    assert found.status is Status.converged and solution.status is Status.converged
    away = np.linalg.norm(found.image - solution.image) / np.linalg.norm(solution.image)
    above = objective(found.image) / objective(solution.image) - 1
    print(f"{type(solver).__name__}: {away:.2e} away, {above:.2e} above, {len(found.stages)} iterations")
    assert away < 1e-3 and abs(above) < 1e-5


def test_assemble_default_strength_is_that_of_reconstruct(spikes):
    motion = Motion.constant(VELOCITY, (24, 24))
    asked = {"scale": SCALE, "motion": motion, "white_rate": 0.3, "prior": HuberTotalVariation(), "gain": None}
    found = reconstruct(spikes, **asked, solver=FISTA(iterations=1)).diagnostics.strength
    assert found is not None and float(assemble(spikes, **asked).strength) == np.float32(found)


class Smoothness(Prior[None]):
    """½‖∇X‖²: a prior of one's own."""

    smooth: ClassVar[bool] = True

    def value(self, image):
        return jnp.sum(jnp.diff(image, axis=0) ** 2) / 2 + jnp.sum(jnp.diff(image, axis=1) ** 2) / 2

    def initial_state(self, image):
        return None

    def prox(self, image, strength, state):
        raise NotImplementedError


def test_assemble_prior_of_one_s_own_takes_its_place(problem):
    """The minimiser of a quadratic: its gradient is 0."""
    own = dataclasses.replace(problem, prior=Smoothness(), strength=jnp.float32(0.05))
    found = run(LBFGS(iterations=1000, tolerance=1e-5), own)
    assert found.status is Status.converged

    def slope(image: np.ndarray) -> float:
        picture = jnp.asarray(image)
        return float(jnp.linalg.norm(own.data.gradient(picture) + own.strength * own.prior.gradient(picture)))

    assert problem.start is not None
    assert slope(found.image) < 1e-3 * slope(np.asarray(problem.start))


def test_assemble_robust_loss_is_refused(spikes):
    with pytest.raises(InputError, match="assemble was given a robust loss; it gives the problem with squares"):
        assemble(spikes, scale=SCALE, options=options(), robust=Huber())


@pytest.mark.parametrize("what", ["dark", "all bad", "out of the picture"])
def test_assemble_nothing_usable_is_refused(spikes, what):
    change = {
        "dark": {},
        "all bad": {"bad_pixels": np.ones((24, 24), bool)},
        "out of the picture": {"motion": Motion.constant((1e6, 1e6), (24, 24))},
    }[what]
    with pytest.raises(InputError, match="no problem to assemble: the recording holds no usable sample"):
        assemble(0 * spikes if what == "dark" else spikes, scale=SCALE, options=options(), **change)


def test_assemble_unknown_option_is_refused(spikes):
    with pytest.raises(InputError, match=r"no option 'strenght' \(did you mean strength\?\)"):
        assemble(spikes, scale=SCALE, strenght=0.1)


def test_assemble_scene_at_rest_is_on_the_sensor_s_grid():
    """Where nothing moves a problem is exact already, and all of the shortcuts hold."""
    still = simulate(Static(data.camera()[110:158, 190:238]), scale=SCALE, frames=FRAMES, seed=3).spikes
    found = assemble(still, scale=SCALE, motion=Motion.none(24, 24), prior=HuberTotalVariation(), strength=STRENGTH)
    assert found.data.block_diagonal and found.data.shape == (48, 48)
    solution = reconstruct(
        still, scale=SCALE, motion=Motion.none(24, 24), prior=HuberTotalVariation(), strength=STRENGTH, gain=None
    )
    objective = run(FISTA(iterations=1000, tolerance=1e-5), found).stages[-1].objective
    assert objective == pytest.approx(solution.stages[-1].objective, rel=1e-3)
