"""Exposures are corrected for while a solver goes on: whichever it is, it ends at the exact problem's minimum."""

import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from scsr_opt import Options, Status
from scsr_opt.camera import Sensor, simulate
from scsr_opt.camera.scenes import Translation
from scsr_opt.motion import Motion
from scsr_opt.operators import accumulate, with_exposure
from scsr_opt.pipeline import outer_loop
from scsr_opt.pipeline.assembly import Assembly, assemble_task
from scsr_opt.pipeline.reconstruct import solve
from scsr_opt.pipeline.settings import OuterLoopSettings
from scsr_opt.pipeline.task import task_of
from scsr_opt.priors import HuberTotalVariation
from scsr_opt.progress import NoProgress
from scsr_opt.solvers import ADMM, FISTA, ISTA, LBFGS, ChambollePock, CondatVu, JaxoptFISTA, NonlinearCG, Problem, run

FRAMES, SCALE, KEY = 41, 2, 20
VELOCITY = (0.21, -0.33)


@pytest.fixture(scope="module")
def spikes() -> np.ndarray:
    """24×24 sensor pixels in dim light: three to four frames from spike to spike, in which the scene moves a pixel."""
    scene = Translation(data.camera()[110:158, 190:238], velocity=(VELOCITY[0] * SCALE, VELOCITY[1] * SCALE), key=KEY)
    return simulate(scene, scale=SCALE, frames=FRAMES, sensor=Sensor(white_rate=0.3, photons=500.0), seed=3).spikes


def assembled(spikes: np.ndarray, solver) -> Assembly:
    motion = Motion.constant(VELOCITY, spikes.shape[1:])
    options = Options(
        motion=motion, white_rate=0.3, prior=HuberTotalVariation(), strength=3e-3, gain=None, solver=solver
    )
    return assemble_task(task_of(spikes, SCALE, KEY, options))


def exact(assembly: Assembly, image: np.ndarray) -> float:
    """½ Σ_j ω_j (r_j·B X − Y_j)² + λ Ψ(X), each r_j along all of its exposure."""
    placed, method = assembly.measurements.placed, assembly.method
    seen = placed.read(accumulate(placed).blurred(jnp.asarray(image)))
    penalty = float(method.prior.value(jnp.asarray(image)))
    return 0.5 * float(placed.weight @ (seen - placed.value) ** 2) + float(method.strength) * penalty


@pytest.fixture(scope="module")
def least(spikes) -> float:
    long = assembled(spikes, FISTA(iterations=3000, tolerance=1e-6))
    found = solve(long)
    assert found.status is Status.converged and (found.diagnostics.positions or 0) >= 3
    # Corrections are what the minimum asks for: without them the picture is another one.
    plain = accumulate(long.measurements.placed)
    without = run(FISTA(), Problem(plain, long.method.prior, long.method.strength), long.image).image
    assert exact(long, without) > 1.02 * exact(long, found.image)
    return exact(long, found.image)


@pytest.mark.parametrize("make", [FISTA, ISTA, ADMM, CondatVu, ChambollePock, JaxoptFISTA, NonlinearCG, LBFGS])
def test_solve_every_solver_ends_at_the_minimum_of_the_exact_problem(make, spikes, least):
    assembly = assembled(spikes, make())
    found = solve(assembly)
    above = exact(assembly, found.image) / least - 1
    print(f"{make.__name__}: {100 * above:.4f} % above, {len(found.stages)} iterations")
    # A thousandth is what skipping work may cost. JaxoptFISTA and NonlinearCG end at three times the tolerance.
    assert found.status is Status.converged and -1e-5 < above < 1e-3


@pytest.mark.parametrize("make", [FISTA, ISTA, ADMM, CondatVu, ChambollePock])
def test_retargeted_state_has_the_gradients_of_the_new_problem(make, spikes):
    given = assembled(spikes, make())
    plain = accumulate(given.measurements.placed)
    before = Problem(plain, given.method.prior, given.method.strength)
    outcome = run(make(iterations=7, tolerance=0), before, given.image)
    corrected = with_exposure(plain, given.measurements.placed, jnp.asarray(outcome.image))
    after = make().retargeted(Problem(corrected, before.prior, before.strength), before, outcome.state)
    for name, at in (("gradient", "image"), ("ahead_gradient", "ahead")):
        if hasattr(after, name):
            expected = corrected.gradient(getattr(after, at))
            np.testing.assert_allclose(getattr(after, name), expected, atol=1e-5 * float(jnp.abs(expected).max()))
            assert float(jnp.abs(expected - plain.gradient(getattr(after, at))).max()) > 0.01 * float(
                jnp.abs(expected).max()
            )


def test_exposure_correction_far_in_some_tiles_is_made_in_these(spikes):
    settings = OuterLoopSettings()
    given = assembled(spikes, FISTA())
    placed, image = given.measurements.placed, jnp.asarray(given.image)
    problem = Problem(accumulate(placed), given.method.prior, given.method.strength)
    inside = np.zeros(image.shape, bool)
    inside[24:36, 12:24] = True
    # A fifth of the picture's norm, in a tile: as a whole a quarter of that.
    level = float(jnp.sqrt(jnp.mean(image**2)))
    tolerance = 0.06 / settings.correction_tolerances
    assert 0.2 / 4 < settings.correction_tolerances * tolerance
    assert 0.2 > settings.tile_correction_tolerances * tolerance
    further = image + 1e-3 * level + 0.2 * level * jnp.asarray(inside, jnp.float32)
    for skip in (True, False):
        # 4×4 tiles
        exposures = outer_loop.ExposureCorrection(problem, placed, None, tile_px=6, finished_tiles=skip)
        assert exposures(image, tolerance) is not None and exposures(image, tolerance) is None
        found = exposures(further, tolerance)
        assert found is not None and exposures._touched is not None
        moved = np.asarray(exposures._touched != image)
        np.testing.assert_array_equal(moved, inside if skip else np.ones_like(inside))
        expected = with_exposure(problem.data, placed, exposures._touched)
        np.testing.assert_allclose(found.data.target, expected.target, atol=2e-6)  # of numbers up to 1
        np.testing.assert_allclose(found.data.energy, expected.energy, rtol=1e-5)


def test_solve_with_corrections_is_one_solve_to_those_who_watch(spikes):
    class Watched(NoProgress):
        started, done = 0, 0

        def start(self, total, what):
            self.started += 1

        def advance(self, done):
            self.done += done

    watched = Watched()
    found = solve(assembled(spikes, FISTA()), progress=watched)
    assert watched.started == 1 and watched.done == len(found.stages)
    assert [stage.number for stage in found.stages] == list(range(1, len(found.stages) + 1))
    seconds = [stage.seconds for stage in found.stages]
    assert seconds == sorted(seconds)
