"""The problems that peers are given, and that this project solves the very same. No peer is installed or run here."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import convolve2d

from benchmarks.peers import ours, rows
from benchmarks.peers.in_jax import forward
from benchmarks.peers.optimum import AGREEMENT, difference, minimum
from benchmarks.peers.problems import CASES, SCALE, SIZE, Case, camera, total_variation
from scsr_opt import solvers


@pytest.fixture(scope="module", params=list(CASES))
def case(request) -> Case:
    return CASES[request.param](camera())


def small(case: Case) -> Case:
    """The upper left 24×24 pixels of a problem, with the samples that read nothing else."""
    inside = (case.row < 23) & (case.column < 23)
    row, column, truth = case.row[inside], case.column[inside], case.truth[:24, :24]
    return replace(case, truth=truth, row=row, column=column, value=case.value[inside], kernels=case.kernels[:0])


@pytest.fixture(scope="module")
def few(case: Case) -> Case:
    return small(case)


@pytest.fixture(scope="module")
def lowest(few: Case) -> float:
    found = minimum(few)
    assert 0 <= found["minimum"] - found["bound"] <= AGREEMENT * found["minimum"]
    return found["minimum"]


def test_shifted_frames_are_convolutions():
    case = CASES["shifts"](camera())
    picture = np.random.default_rng(0).uniform(size=case.shape)
    frames = [convolve2d(picture, kernel, mode="same")[::SCALE, ::SCALE] for kernel in case.kernels]
    np.testing.assert_allclose(case.matrix @ picture.ravel(), np.ravel(frames), atol=1e-12)
    # Published with this problem: F at the start and at the truth.
    assert case.objective(case.start) == pytest.approx(60.6421640, abs=1e-6)
    assert case.objective(case.truth) == pytest.approx(16.3255475, abs=1e-6)


def test_flow_moves_every_pixel_its_own_way():
    case = CASES["flow"](camera())
    # Nearly all of the 64 frames' samples stay in the picture, and they fall in between its pixels.
    assert 0.95 * 64 * (SIZE // SCALE) ** 2 < case.value.size < 64 * (SIZE // SCALE) ** 2
    assert len(np.unique(np.round(case.row % 1, 6))) > 0.5 * case.value.size
    constant = case.reading @ np.ones((SIZE + 2) ** 2)
    np.testing.assert_allclose(constant, 1, atol=1e-12)


def test_operator_in_jax(case: Case):
    picture = np.random.default_rng(0).uniform(size=case.shape)
    applied = jax.jit(forward(case))(jnp.asarray(picture, jnp.float32))
    # Sums of 25 or 36 products of numbers below 1, in float32.
    np.testing.assert_allclose(np.asarray(applied), case.matrix @ picture.ravel(), atol=3e-6)


def test_objective_is_that_of_this_project(case: Case):
    problem = ours.problem(case, ours.placed(case))
    for picture in (case.start, case.truth, np.random.default_rng(0).uniform(size=case.shape)):
        image = jnp.asarray(picture, jnp.float32)
        objective = problem.data.value(image) + problem.strength * problem.prior.value(image)
        # ½⟨U, M U⟩ − ⟨c, U⟩ + ½ e loses digits to cancellation: its terms are up to e, a rounding unit of 6e-8 each.
        assert float(objective) == pytest.approx(
            case.objective(picture), rel=1e-5, abs=1e-7 * float(problem.data.energy)
        )


def test_gradient_is_that_of_this_project(case: Case):
    problem = ours.problem(case, ours.placed(case))
    gradient = case.matrix.T @ (case.matrix @ case.truth.ravel() - case.value)
    ratio = np.asarray(problem.data.gradient(jnp.asarray(case.truth, jnp.float32))).ravel() - gradient
    # M X and c, which differ by the gradient, are of the size of the rows' sums (≈ L), rounded to 6e-8 each.
    assert np.abs(ratio).max() < 1e-5 * case.lipschitz


def test_differences(case: Case):
    picture = np.random.default_rng(0).uniform(size=(5, 7))
    field = [along @ picture.ravel() for along in difference(picture.shape)]
    assert np.sum(np.hypot(*field)) == pytest.approx(total_variation(picture))


def test_minimum_is_that_of_this_project(few: Case, lowest: float):
    problem = ours.problem(few, ours.placed(few))
    outcome = solvers.run(solvers.FISTA(iterations=500, tolerance=0), problem, jnp.asarray(few.start, jnp.float32))
    # Never below the minimum but for rounding, and, after so many iterations, hardly above it.
    assert -AGREEMENT < few.objective(outcome.image) / lowest - 1 < 1e-5


def test_row(few: Case, lowest: float):
    method = next(method for method in ours.methods(few) if method.name == ours.DEFAULT)
    row = rows.measure(few, lowest, method)
    iterations = row["iterations"]
    assert isinstance(iterations, int) and iterations > 1
    target = lowest * (1 + rows.NEAR)
    assert few.objective(method.prepare(iterations)()) <= target < few.objective(method.prepare(iterations - 1)())
    hopeless = rows.measure(few, lowest, method._replace(most=iterations - 1))
    assert hopeless["iterations"] is None and hopeless["seconds"] == []


def test_saved_and_loaded(few: Case, tmp_path):
    few.save(tmp_path / "case.npz")
    loaded = Case.load(tmp_path / "case.npz")
    assert loaded.objective(few.truth) == few.objective(few.truth)
