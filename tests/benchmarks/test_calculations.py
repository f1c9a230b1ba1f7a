"""Calculations of the benchmarks that could be wrong without anyone seeing it."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.bench import kernels, whole
from benchmarks.peers import ours
from benchmarks.peers.optimum import AGREEMENT, minimum
from benchmarks.peers.problems import CASES, Case, camera
from benchmarks.race import GAPS, Entry, followed, reached
from benchmarks.race import minimum as minimum_of
from benchmarks.recordings import posed, recorded
from benchmarks.stress import cases, data, run, solve
from benchmarks.stress.bounds import agreement
from benchmarks.stress.conditioning import condition
from benchmarks.timing import compilations, in_turns, program, ratios
from scsr_opt import solvers
from scsr_opt.camera.sampling_rules import Intervals
from scsr_opt.priors import HuberTotalVariation
from scsr_opt.solvers import FISTA, CondatVu, Problem


def row_of(seconds: list[float], psnr: float, kind: str = "variant") -> dict:
    return {"seconds": [seconds], "psnr": [psnr], "kind": kind}


def test_front_holds_what_nothing_beats():
    places = [(1.0, 20.0), (2.0, 25.0), (2.0, 24.0), (3.0, 25.0), (1.0, 20.0), (5.0, 26.0)]
    assert whole.front([row_of([s] * 4, psnr) for s, psnr in places]) == [True, True, False, False, True, True]


def test_beats_compares_round_by_round_beyond_chance():
    usual = row_of([1.0, 2.0, 1.0, 9.0], 25.0)
    assert whole.beats(row_of([0.9, 1.9, 0.9, 8.9], 25.001), usual)  # faster each time
    assert not whole.beats(row_of([0.9, 2.1, 0.9, 9.1], 25.001), usual)  # now and then
    assert whole.beats(row_of([0.9, 2.1, 0.9, 9.1], 25.02), usual)  # but better
    assert not whole.beats(row_of([0.5, 1.0, 0.5, 4.5], 24.98), usual)
    default, again = row_of([1.0] * 4, 25.0, "default"), row_of([0.95, 1.0, 1.02, 0.95], 25.0, whole.TWICE)
    assert whole.chance([default, again]) == pytest.approx(0.95)
    assert whole.front([default, row_of([0.97] * 4, 25.0), again])[:2] == [True, True]
    assert whole.front([default, row_of([0.94] * 4, 25.0), again])[:2] == [False, True]


def test_in_turns_calls_each_once_a_round():
    order: list[str] = []
    taken = in_turns({name: lambda name=name: order.append(name) for name in "abc"}, 3)
    assert [len(times) for times in taken.values()] == [3, 3, 3]
    assert all(sorted(order[k : k + 3]) == ["a", "b", "c"] for k in (0, 3, 6))
    assert ratios([2.0, 6.0, 2.0], [1.0, 2.0, 2.0]) == pytest.approx((1.5, 2.0, 2.5))


def test_program_counts_a_product_of_matrices():
    counted = program(lambda a: a @ a, jnp.ones((32, 32)))
    assert counted.flops == pytest.approx(2 * 32**3, rel=0.1) and counted.memory >= 2 * 4 * 32**2
    with compilations() as second:
        jax.block_until_ready(counted.call())
    assert second == []


def test_kernels_bytes_by_hand_are_no_more_than_xla_moves():
    """XLA counts each operation of a program by itself: never less than the least, unless a pass is left out."""
    for name, kernel in kernels.kernels((48, 64), (21, 12, 16, 4)).items():
        if name.startswith(("stencil", "aperture", "f and", "Huber", "its prox", "FISTA", "CondatVu")):  # no loops
            moved = program(kernel.call, *kernel.arguments).moved
            assert moved is not None and moved > 0.9 * kernel.moved, name


def test_race_minimum_and_gaps_are_those_of_the_problem():
    case = posed(recorded("camera", scale=2, sensor=24), Intervals(), validate=False)
    problem = Problem(case.term, HuberTotalVariation(), jnp.asarray(case.strength, jnp.float32))
    known = minimum_of(problem, case.start, FISTA(iterations=300))
    assert known is not None and 0 <= known.certain < 1e-5
    # No picture is lower than the minimum; 400 iterations of another method in float32 come within 1e-4 of it.
    image = solvers.run(CondatVu(iterations=400), problem, case.start, tolerance=0.0).image
    assert -known.certain <= known.gap(image) < 1e-4 and known.gap(np.asarray(case.start)) > 0.1
    found = reached(followed(Entry(FISTA(), problem, case.start, known), case.truth, 2, seconds=20.0))
    assert [one["gap"] for one in found] == list(GAPS)
    for one in found:
        again = solvers.run(FISTA(iterations=one["iterations"]), problem, case.start, tolerance=0.0)
        assert known.gap(again.image) == pytest.approx(one["above"], rel=1e-2, abs=1e-7) and one["above"] <= one["gap"]
        if 1 < one["iterations"] <= 20:
            before = solvers.run(FISTA(iterations=one["iterations"] - 1), problem, case.start, tolerance=0.0)
            assert known.gap(before.image) > one["gap"]


ORDINARY = cases.Case("solvers", prior="TV", iterations=40)


def test_stress_cases_hold_every_value_of_every_axis():
    made = cases.cases(0, quick=False)
    tried = {field.name: {getattr(case, field.name) for case in made} for field in dataclasses.fields(cases.Case)}
    for name, values in (
        ("family", cases.FAMILIES), ("solver", cases.SOLVERS), ("prior", cases.PRIORS), ("light", cases.LIGHTS),
        ("strength", cases.STRENGTHS), ("motion", cases.MOTIONS), ("bad", cases.BAD), ("start", cases.STARTS),
        ("step", cases.STEPS), ("scale", cases.SCALES), ("frames", cases.FRAMES), ("sensor", cases.SIZES),
        ("kind", run._KINDS), ("precision", cases.PRECISIONS), ("lens", (1.0, 16.0)), ("iterations", (100_000,)),
    ):  # fmt: skip
        assert set(values) <= tried[name], name
    programs = [case.program for n, case in enumerate(made) if n == 0 or case.program != made[n - 1].program]
    assert (
        len(programs) == len(set(programs)) and {case.family for case in cases.cases(1, quick=True)} == tried["family"]
    )


def test_agreement_rejects_a_picture_that_is_not_the_minimiser():
    """As if a solver had stopped too early and reported the residual of a later picture."""
    early, exact, late = (
        solve.solve(dataclasses.replace(ORDINARY, precision=precision, strength=0.0, iterations=iterations))
        for precision, iterations in (("float32", 2), ("float64", 40), ("float32", 40))
    )
    assert early.certificate is not None and exact.certificate is not None and late.certificate is not None
    distance = float(np.linalg.norm(early.image - exact.image))
    assert agreement(early.certificate, exact.certificate, distance)[1] <= 1
    lying = early.certificate._replace(per_distance=late.certificate.per_distance)
    assert agreement(lying, exact.certificate, distance)[1] > 1


@pytest.mark.parametrize(
    ("image", "good", "objective", "step", "holds"),
    [(0.5, True, 1.0, None, True), (math.nan, True, 1.0, None, False), (math.nan, False, 1.0, 1.5, False),
     (0.5, False, math.nan, 1.5, True), (0.5, False, math.nan, 1.0, False), (0.5, True, math.nan, 1.5, False),
     (math.inf, True, 1.0, None, False)],
)  # fmt: skip
def test_ends_well_needs_finite_pictures_and_named_failures(image, good, objective, step, holds):
    finding = solve.Finding(dataclasses.replace(ORDINARY, step=step))
    solve.ends_well(finding, np.full((2, 2), image), "converged", good, (1.0, objective))
    assert finding.checks == {"ends well": holds}


def test_addends_counts_the_samples_of_a_pixel():
    """Two pixels at ×1 at rest: the right one gets a tap of each of its own samples, and one of each of the left's."""
    case = cases.Case(sensor=(1, 2), scale=1, motion="static", light="all-one", frames=7)
    assert data.addends(case) == int((np.asarray(data.placed_of(case).weight) > 0).sum()) > 4
    assert data.addends(dataclasses.replace(case, bad=1.0)) == 0


def test_condition_of_a_scene_at_rest_sees_a_quarter():
    still = condition(2, "static")
    assert still.seen == 0.25 and still.spectrum[0] == 1 and np.all(np.diff(still.spectrum) <= 0)


@pytest.fixture(scope="module", params=list(CASES))
def peer_case(request) -> Case:
    return CASES[request.param](camera())


def test_peers_objective_is_that_of_this_project(peer_case):
    if len(peer_case.kernels):  # published in docs/peers.md
        assert peer_case.objective(peer_case.start) == pytest.approx(60.6421640, abs=1e-6)
    problem = ours.problem(peer_case, ours.placed(peer_case))
    for picture in (peer_case.start, peer_case.truth, np.random.default_rng(0).uniform(size=peer_case.shape)):
        image = jnp.asarray(picture, jnp.float32)
        objective = problem.data.value(image) + problem.strength * problem.prior.value(image)
        # ½⟨U, M U⟩ − ⟨c, U⟩ + ½ e loses digits to cancellation: its terms are up to e, a rounding unit of 6e-8 each.
        allowed = 1e-7 * float(problem.data.energy)
        assert float(objective) == pytest.approx(peer_case.objective(picture), rel=1e-5, abs=allowed)


def test_peers_minimum_is_certified_and_that_of_this_project(peer_case):
    inside = (peer_case.row < 23) & (peer_case.column < 23)  # the upper left 24×24 pixels
    row, column, value = (axis[inside] for axis in (peer_case.row, peer_case.column, peer_case.value))
    few = dataclasses.replace(
        peer_case, truth=peer_case.truth[:24, :24], row=row, column=column, value=value, kernels=peer_case.kernels[:0]
    )
    found = minimum(few)
    assert 0 <= found["minimum"] - found["bound"] <= AGREEMENT * found["minimum"]
    problem = ours.problem(few, ours.placed(few))
    outcome = solvers.run(FISTA(iterations=500, tolerance=0), problem, jnp.asarray(few.start, jnp.float32))
    assert -AGREEMENT < few.objective(outcome.image) / found["minimum"] - 1 < 1e-5
