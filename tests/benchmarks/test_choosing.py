"""The figures of docs/choosing.md: what is called a minimum, a gap, a best strength, and where it is written."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from PIL import Image

from benchmarks import choosing_cases, choosing_page, choosing_priors, choosing_solvers
from scsr_opt.priors import HuberTotalVariation
from scsr_opt.solvers import FISTA, CondatVu, DualityGap, Problem, Solver, run

PAGE = Path(__file__).parents[2] / "docs" / "choosing.md"

pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.fixture(scope="module")
def case() -> choosing_cases.Case:
    return choosing_cases.case_of("camera", scale=2, sensor=24, light="day")


@pytest.fixture(scope="module")
def problem(case: choosing_cases.Case) -> Problem:
    return Problem(case.term, HuberTotalVariation(), jnp.asarray(case.strength, jnp.float32))


@pytest.fixture(scope="module")
def exact(case: choosing_cases.Case, problem: Problem) -> choosing_solvers.Exact:
    patient = FISTA(iterations=300, tolerance=1e-7, stopping=DualityGap(-1, 2))
    return choosing_solvers.exact(problem, case.start, patient)


def test_the_minimum_is_below_what_another_method_finds(case, problem, exact):
    assert 0 <= exact.certain < 1e-5
    image = run(CondatVu(iterations=400), problem, case.start, tolerance=0.0).image
    # No picture is lower than the minimum; 400 iterations in float32 come within 1e-4 of it.
    assert -exact.certain <= exact.above(image) < 1e-4
    assert exact.above(np.asarray(case.start)) > 0.1


def test_gaps_are_those_of_the_first_picture_that_is_near_enough(case, problem, exact):
    found = choosing_solvers.approach(FISTA(), problem, case.start, exact, seconds=20.0)
    assert len(found) == len(choosing_solvers.GAPS)
    for gap, (above, iterations, residual) in zip(choosing_solvers.GAPS, found, strict=True):
        again = run(FISTA(iterations=iterations), problem, case.start, tolerance=0.0)
        assert again.stages[-1].residual == pytest.approx(residual, rel=1e-3)
        assert exact.above(again.image) == pytest.approx(above, rel=1e-2, abs=1e-7)
        assert above <= gap
        if 1 < iterations <= 20:
            before = run(FISTA(iterations=iterations - 1), problem, case.start, tolerance=0.0)
            assert exact.above(before.image) > gap


def test_every_solver_of_a_race_can_solve_its_problem(case):
    def one_iteration(solver: Solver, problem: Problem) -> Array:
        return solver.image(solver.step(problem, solver.init(problem, case.start))[0])

    for race in choosing_solvers.races(choosing_cases.FULL):
        problem = Problem(case.term, race.prior, jnp.asarray(case.strength, jnp.float32))
        for name, (solver, steps) in race.entries.items():
            # By shape alone: nothing is computed.
            found = eqx.filter_eval_shape(one_iteration, solver, choosing_solvers._with_steps(problem, steps))
            assert (found.shape, found.dtype) == (case.start.shape, case.start.dtype), name
        race.patient.stopping.check(race.prior)


def test_the_best_strength_is_better_than_half_and_double(case):
    prior = HuberTotalVariation()
    top = choosing_priors.best(case, prior, 8 * case.strength)
    for factor in (0.5, 2.0):
        other = Problem(case.term, prior, jnp.asarray(factor * top.strength, jnp.float32))
        image = run(FISTA(tolerance=3e-4), other, case.start).image
        assert choosing_priors.psnr(case.truth, image, 16) <= top.psnr


def test_tables_and_pictures_come_where_they_belong(tmp_path):
    row = {"compile_seconds": 1.5, "reached": [{"gap": 0.1, "above": 0.07, "iterations": 3, "residual": 0.01}]}
    row["reached"][0]["seconds"] = [0.002, 0.001, 0.9]
    score = {"psnr": 31.26, "ssim": 0.9, "strength": 2.0}
    result = {
        "machine": "a machine",
        "quick": False,
        "rounds": 3,
        "pictures": ["camera"],
        "conditions": ["×2, day"],
        "solvers": {"TV, ×2": {"strength": 0.001, "minimum": 1.0, "certain": 1e-7, "rows": {"FISTA": row}}},
        "priors": {"TV": {"scores": {"×2, day, camera": score}, "seconds": [0.1, 0.2, 0.3]}},
    }
    page = tmp_path / "page.md"
    page.write_text(f"before\n{choosing_page.MARKS[0]}\nold\n{choosing_page.MARKS[1]}\nafter\n", encoding="utf-8")
    picture = np.random.default_rng(0).uniform(size=(96, 96)).astype(np.float32)
    for _ in range(2):  # writing again replaces
        choosing_page.write(page, result, {"truth": picture, "TV": picture})
        text = page.read_text(encoding="utf-8")
        assert text.startswith("before\n") and text.endswith("\nafter\n") and "old" not in text
        assert text.count("| `FISTA` | 2.0 (3) | – | – | – | – | – | 1.5 |") == 1
        assert text.count("| TV | 31.26 / 0.900 | 2 … 2 | 1.0 |") == 1
    for name in ("choosing_solvers.png", "choosing_priors.png"):
        with Image.open(tmp_path / name) as drawn:
            assert min(drawn.size) > 200


def test_the_page_is_ready_to_be_written():
    text = PAGE.read_text(encoding="utf-8")
    assert all(text.count(mark) == 1 for mark in choosing_page.MARKS)
    for name in ("choosing_solvers.png", "choosing_priors.png"):
        assert name in text
        assert 0 < (PAGE.parent / name).stat().st_size < 200_000
