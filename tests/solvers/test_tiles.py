"""An active set leaves tiles alone, and ends where iterations of the whole picture do."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from scsr_opt.camera.samples import Samples
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators import Blur, accumulate, place
from scsr_opt.operators.data_term import Stencil
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.priors import HuberTotalVariation, TotalVariation
from scsr_opt.progress import NoProgress
from scsr_opt.solvers import (
    FISTA,
    ISTA,
    DualityGap,
    JaxoptFISTA,
    NormBound,
    Outcome,
    Problem,
    Separable,
    Status,
    is_tileable,
    run,
    run_tiles,
)
from scsr_opt.solvers import tiles as module
from scsr_opt.solvers.settings import TileSettings

SENSOR, SCALE, KEY = (80, 112), 2, 10
SHAPE = (SCALE * SENSOR[0], SCALE * SENSOR[1])  # 3×4 tiles of 64×64 pixels, those at the end smaller
SIDE = TileSettings().side_px * SCALE


@pytest.fixture(scope="module")
def problem() -> Problem:
    """A translation, seen well at the left and by a twentieth as many samples at the right."""
    rng = np.random.default_rng(0)
    number = 60_000
    row, column = (rng.integers(0, length, number).astype(np.int32) for length in SENSOR)
    time = rng.uniform(0, 2 * KEY - 1, number).astype(np.float32)
    rarely = (column > 70) & (rng.uniform(size=number) > 0.05)
    weight = np.where(rarely, 0, np.prod(SENSOR) / number).astype(np.float32)
    truth = data.camera()[100 : 100 + SHAPE[0], 150 : 150 + SHAPE[1]] / 255
    value = truth[::SCALE, ::SCALE][row, column] + 0.03 * rng.normal(size=number)
    samples = Samples(row, column, time, time, value.astype(np.float32), weight)
    velocity = np.broadcast_to(np.array([0.05, -0.08], np.float32)[:, None, None], (2, *SENSOR))
    path = trajectory_of(Motion.of_velocity(velocity), key=KEY, start=0, stop=2 * KEY)
    term = accumulate(place(jax.tree.map(jnp.asarray, samples), path, scale=SCALE, shape=SHAPE))
    return Problem(term, HuberTotalVariation(), jnp.float32(3e-3))


@pytest.fixture(scope="module")
def start() -> jax.Array:
    return jnp.full(SHAPE, 0.5)


@pytest.fixture(scope="module")
def rough(problem, start) -> Outcome:
    """A picture after a few iterations."""
    return run(FISTA(iterations=6, tolerance=0.0), problem, start)


@pytest.fixture(scope="module")
def best(problem, start) -> Outcome:
    """The minimiser, nearly."""
    return run(FISTA(iterations=4000, tolerance=1e-7), problem, start)


def objective(problem: Problem, image) -> float:
    f, _ = problem.data.value_and_gradient(jnp.asarray(image))
    return float(f + problem.strength * problem.prior.value(jnp.asarray(image)))


STEPS = dataclasses.replace(FISTA(), iterations=1, tolerance=0.0)


def one_tile(row: int, column: int) -> np.ndarray:
    slopes = np.zeros((3, 4), np.float32)
    slopes[row, column] = 1
    return slopes


def pixels(row: int, column: int) -> tuple[slice, slice]:
    return slice(row * SIDE, (row + 1) * SIDE), slice(column * SIDE, (column + 1) * SIDE)


@pytest.mark.parametrize("skip", [True, False])
@pytest.mark.parametrize("make", [FISTA, partial(ISTA, step_size=Separable())])
def test_it_ends_at_the_minimum_with_no_tile_far_from_it(make, skip, problem, start, best):
    found = run_tiles(make(iterations=400), problem, start, finished_tiles=skip)
    assert found.status is Status.converged and found.stages[-1].residual <= 1e-4
    tiles = found.tiles
    assert tiles is not None and tiles.largest_change <= tiles.change_limit
    assert tiles.tile_iterations.any() == skip
    # At a relative residual of 1e-4 the plain loop is about as far above; five times as much is still safe.
    least = objective(problem, best.image)
    plain = run(make(iterations=400), problem, start)
    above = [objective(problem, outcome.image) / least - 1 for outcome in (found, plain)]
    assert above[0] < max(1.5 * above[1], 1e-4) < 5e-4


def test_tiles_are_iterated_as_a_whole_picture_whose_other_pixels_are_held(problem, rough):
    """The window reaches far enough: one iteration in it is that of the whole picture with steps of 0 elsewhere."""
    solver = FISTA()
    state = solver.warm(problem, rough.state)
    for row, column in ((0, 0), (1, 1), (2, 0), (2, 3)):  # in a corner, inside, where tiles are smaller, hardly seen
        inside = np.zeros(SHAPE, bool)
        inside[pixels(row, column)] = True
        held = state._replace(step_size=jnp.where(jnp.asarray(inside), state.step_size, 0))
        expected, record = solver.step(problem, held)
        assert np.isfinite(record.residual) and record.residual > 0
        found, took = module._on_tiles(STEPS, problem, state, one_tile(row, column), 0.0, 1, TileSettings())
        assert took.sum() == took[row, column] == 1
        np.testing.assert_array_equal(np.asarray(found.image)[~inside], np.asarray(state.image)[~inside])
        # Rounding of float32, of numbers up to 1; the dual variable's are divided by λβ, of about 0.01.
        np.testing.assert_allclose(found.image, expected.image, atol=2e-6)
        top, left = max(row * SIDE - 1, 0), max(column * SIDE - 1, 0)
        reached = np.zeros(SHAPE, bool)  # and by the edges that end in the tile
        reached[top : (row + 1) * SIDE, left : (column + 1) * SIDE] = True
        for new, old, before in zip(found.prior, expected.prior, state.prior, strict=True):
            np.testing.assert_allclose(np.asarray(new)[inside], np.asarray(old)[inside], atol=2e-4)
            np.testing.assert_array_equal(np.asarray(new)[~reached], np.asarray(before)[~reached])


def test_the_objective_falls_with_each_turn_of_tiles(problem, rough):
    state, before = rough.state, objective(problem, rough.image)
    for turn in range(3):
        state, took = module._on_tiles(STEPS, problem, state, np.ones((3, 4), np.float32), 1e-4, 40, TileSettings())
        after = objective(problem, state.image)
        assert after <= before * (1 + 1e-6)  # rounding of float32
        assert turn or after < before
        before = after
        assert (took > 0).all()


def test_only_what_is_unfinished_and_what_that_wakes_is_gone_on_with(problem, best):
    settings = TileSettings(whole_tolerances=1e6)  # one iteration of the whole picture, and then tiles
    image = np.array(best.image)
    image[pixels(0, 0)] += 0.05 * np.random.default_rng(1).normal(size=(SIDE, SIDE))
    disturbed = best.state._replace(image=jnp.asarray(image, jnp.float32))
    found = run_tiles(FISTA(tolerance=3e-4), problem, jnp.asarray(image), similar=disturbed, settings=settings)
    assert found.status is Status.converged and found.tiles is not None
    further = found.tiles.tile_iterations
    assert further[0, 0] > 0 and not further[2:].any() and not further[:, 2:].any()
    least = objective(problem, best.image)
    assert objective(problem, found.image) - least < 0.01 * (objective(problem, image) - least)


def test_it_does_not_matter_what_weights_are_counted_in(problem, start):
    """Also where a part of the picture was not seen at all."""
    planes, target = problem.data.stencil.planes.at[:, :, 150:].set(0), problem.data.target.at[:, 150:].set(0)

    def times(factor: float) -> Problem:
        data = dataclasses.replace(problem.data, stencil=Stencil(factor * planes), target=factor * target)
        return dataclasses.replace(problem, data=data, strength=factor * problem.strength)

    found = [run_tiles(FISTA(iterations=400), times(factor), start) for factor in (1.0, 1e3, 1e-4)]
    for outcome in found:
        assert outcome.status is Status.converged and outcome.tiles is not None and found[0].tiles is not None
        assert abs(outcome.tiles.tile_iterations.max() - found[0].tiles.tile_iterations.max()) <= 5
        np.testing.assert_allclose(outcome.image, found[0].image, atol=0.01)


@pytest.mark.parametrize("skip", [True, False])
@pytest.mark.parametrize("most", [1, 2, 5, 9])
def test_no_more_iterations_are_done_than_allowed(most, skip, problem, start):
    found = run_tiles(FISTA(iterations=most, tolerance=3e-3), problem, start, finished_tiles=skip)
    assert found.tiles is not None and len(found.stages) + found.tiles.tile_iterations.max() <= most
    assert np.isfinite(found.image).all()


def test_corrections_are_asked_for_by_the_tolerance(problem, start):
    """Whatever its digits: 1e-3 is more than its float32."""
    for tolerance in (1e-3, 1e-4, 3e-4):
        asked = []
        solver, correction = FISTA(tolerance=tolerance), lambda _, t: asked.append(t)  # noqa: B023
        run_tiles(solver, problem, start, correction=correction, finished_tiles=False)
        assert asked and all(t == pytest.approx(tolerance) for t in asked)


def test_picture_of_few_tiles_is_iterated_as_a_whole(problem, start):
    """They would all be finished once the whole picture is near its tolerance."""
    few = TileSettings(side_px=80)
    found, whole = (run_tiles(FISTA(), problem, start, finished_tiles=skip, settings=few) for skip in (True, False))
    assert found.tiles is not None and not found.tiles.tile_iterations.any()
    assert [stage.objective for stage in found.stages] == [stage.objective for stage in whole.stages]


def test_the_limit_of_iterations_holds_for_each_tile(problem, start):
    found = run_tiles(FISTA(iterations=12, tolerance=1e-5), problem, start)
    assert found.status is Status.iterations_exhausted and found.tiles is not None
    assert len(found.stages) + found.tiles.tile_iterations.max() <= 12


def test_what_is_not_finite_ends_it(problem, start, rough, monkeypatch):
    target = problem.data.target.at[30, 30].set(jnp.nan)
    wrong = dataclasses.replace(problem, data=dataclasses.replace(problem.data, target=target))
    assert run_tiles(FISTA(), wrong, start).status is Status.non_finite

    # And where tiles make it so: the picture before them is what is left.
    def spoilt(solver, problem, state, slopes, *limits):
        return state._replace(image=state.image * jnp.nan), np.sign(slopes).astype(int)

    monkeypatch.setattr(module, "_on_tiles", spoilt)
    found = run_tiles(FISTA(), problem, start)
    assert found.status is Status.non_finite and np.isfinite(found.image).all()


def test_it_is_one_solve_to_those_who_watch(problem, start):
    class Watched(NoProgress):
        started, done, finished = 0, 0, 0

        def start(self, total, what):
            self.started += 1

        def advance(self, done):
            self.done += done

        def finish(self):
            self.finished += 1

    watched = Watched()
    found = run_tiles(FISTA(), problem, start, progress=watched)
    assert watched.started == watched.finished == 1
    assert found.tiles is not None and found.tiles.tile_iterations.any()
    assert watched.done == len(found.stages) + found.tiles.tile_iterations.max()
    assert [stage.number for stage in found.stages] == list(range(1, len(found.stages) + 1))
    seconds = [stage.seconds for stage in found.stages]
    assert seconds == sorted(seconds)


def test_it_is_for_steps_of_each_pixel_and_near_neighbours(problem):
    assert is_tileable(FISTA(), problem) and is_tileable(ISTA(step_size=Separable()), problem)
    assert not is_tileable(ISTA(), problem)  # one step size for all pixels
    assert not is_tileable(FISTA(step_size=NormBound()), problem) and not is_tileable(JaxoptFISTA(), problem)
    assert not is_tileable(FISTA(stopping=DualityGap()), problem)
    assert is_tileable(FISTA(), dataclasses.replace(problem, prior=TotalVariation()))
    assert not is_tileable(FISTA(), dataclasses.replace(problem, prior=default_prior(2)))
    blurred = dataclasses.replace(problem.data, optics=Blur.gaussian(SHAPE, 1.0))
    assert not is_tileable(FISTA(), dataclasses.replace(problem, data=blurred))
