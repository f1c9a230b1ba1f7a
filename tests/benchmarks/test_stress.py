"""`scsr stress`: does it try what it says, and does it notice what is wrong?"""

import dataclasses
import json
import math
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from benchmarks import stress_cases, stress_data, stress_methods, stress_page, stress_run, stress_solve
from benchmarks.choosing_page import MARKS
from benchmarks.stress import Report, stress
from benchmarks.stress_cases import Case
from benchmarks.stress_checks import agreement
from benchmarks.stress_conditioning import condition
from scsr_opt.errors import InputError

# One program in two precisions serves most of this module.
ORDINARY = Case("solvers", solver="FISTA", prior="TV", iterations=40)


@pytest.fixture(autouse=True, scope="module")
def small_pictures(quick_compilation):
    """Of 192 pixels."""


def test_everything_is_tried():
    made = stress_cases.cases(0, quick=False)
    assert len(made) >= 2000
    tried = {field.name: {getattr(case, field.name) for case in made} for field in dataclasses.fields(Case)}
    assert tried["family"] == set(stress_cases.FAMILIES)
    assert tried["solver"] == set(stress_methods.SOLVERS) and tried["prior"] == set(stress_methods.PRIORS)
    assert tried["precision"] == set(stress_cases.PRECISIONS)
    for name, values in (
        ("strength", stress_cases.STRENGTHS), ("light", stress_cases.LIGHTS), ("motion", stress_cases.MOTIONS),
        ("bad", stress_cases.BAD), ("start", stress_cases.STARTS), ("step", stress_cases.STEPS),
        ("scale", stress_cases.SCALES), ("frames", stress_cases.FRAMES), ("sensor", stress_cases.SIZES),
        ("lens", (1.0, 16.0)), ("kind", ("solve", "reconstruct", "defaults", "descent", "gradient", "vmap")),
        ("iterations", (100_000,)),
    ):  # fmt: skip
        assert set(values) <= tried[name], name


def test_the_seed_decides_and_programs_are_not_made_twice():
    for quick in (False, True):
        made = stress_cases.cases(3, quick=quick)
        assert made == stress_cases.cases(3, quick=quick) != stress_cases.cases(4, quick=quick)
        runs = [case.program for n, case in enumerate(made) if n == 0 or case.program != made[n - 1].program]
        assert max(Counter(runs).values()) == 1


def test_recordings_are_what_their_names_say():
    def spikes(light: str) -> np.ndarray:
        return stress_data.situation(Case("", light=light, frames=400, motion="static")).spikes

    assert not spikes("all-zero").any() and spikes("all-one").all()
    bright, dim = spikes("1").mean(), spikes("0.1").mean()
    # The texture lies between a tenth and once the light; white fires 0.6 times a frame.
    assert 0.06 <= bright <= 0.6 and dim == pytest.approx(bright / 10, abs=2 / 400)
    assert spikes("saturated").mean() > bright
    true = stress_data.situation(Case("")).velocity
    wrong = stress_data.situation(Case("", motion="wrong")).velocity
    np.testing.assert_allclose(wrong, -3 * true, rtol=1e-6)
    assert np.isnan(stress_data.situation(Case("", motion="not a number")).velocity).any()
    assert stress_data.situation(Case("", bad=1.0)).bad.all()
    assert not stress_data.situation(Case("", bad=0.0)).bad.any()


@pytest.mark.parametrize(
    ("axes", "something"),
    [({}, True), ({"light": "all-one", "motion": "integer"}, True),
     ({"bad": 1.0}, False), ({"light": "all-zero"}, False), ({"motion": "huge"}, False)],
)  # fmt: skip
def test_where_there_is_something_to_see_a_picture_is_asked_for(axes, something):
    case = Case("door", kind="reconstruct", iterations=5, **axes)
    assert stress_data.has_samples(stress_data.situation(case)) == something
    found = stress_run.examine(case)
    assert found.passed and (found.outcome == "no_samples") != something


def test_addends_are_counted():
    """Two pixels at ×1 at rest: the right one gets a tap of each of its own samples, and one of each of the left's."""
    case = Case("", sensor=(1, 2), scale=1, motion="static", light="all-one", frames=7)
    used = int((np.asarray(stress_data.placed_of(case).weight) > 0).sum())
    assert stress_data.addends(case) == used > 4
    assert stress_data.addends(dataclasses.replace(case, bad=1.0)) == 0


def test_bfloat16_is_a_rounding_of_what_is_stored():
    plain, rounded = (stress_data.problem_of(Case("", precision=p)).data for p in ("float32", "bfloat16"))
    for one, other in ((plain.stencil.planes, rounded.stencil.planes), (plain.target, rounded.target)):
        off = np.abs(np.asarray(one, float) - np.asarray(other))
        assert 0 < off.max() and (off <= 2.0**-8 * np.abs(np.asarray(one, float))).all()


def test_an_ordinary_case_passes_and_says_so():
    found = stress_run.examine(ORDINARY)
    assert found.passed and found.outcome in ("converged", "iterations_exhausted")
    assert set(found.checks) == {"ends well", "is the same again", "agrees with float64"}
    assert 0 <= found.numbers["share of the bound"] < 1


def test_a_prior_without_a_dual_variable_is_certified_by_its_gradient():
    found = stress_run.examine(dataclasses.replace(ORDINARY, prior="ridge", iterations=20))
    assert found.passed and found.checks["agrees with float64"] and 0 <= found.numbers["share of the bound"] < 1
    falls = Case("descent", kind="descent", solver="ISTA", prior="ridge", step=1.0)
    assert stress_run.examine(falls).checks == {"ends well": True, "objective falls": True}


def test_a_picture_that_is_not_the_minimiser_does_not_agree():
    """As if a solver had stopped too early and reported the residual of a later picture."""
    one, exact = (
        stress_solve.solve(dataclasses.replace(ORDINARY, precision=p, strength=0.0, iterations=n))
        for p, n in (("float32", 2), ("float64", 40))
    )
    patient = stress_solve.solve(dataclasses.replace(ORDINARY, strength=0.0))
    assert one.certificate is not None and exact.certificate is not None and patient.certificate is not None
    distance = float(np.linalg.norm(one.image - exact.image))
    assert agreement(one.certificate, exact.certificate, distance)[1] <= 1
    lying = one.certificate._replace(per_distance=patient.certificate.per_distance)
    assert agreement(lying, exact.certificate, distance)[1] > 1


def test_a_step_too_long_is_seen_to_rise():
    rising = Case("descent", kind="descent", solver="ISTA", prior="TV", step=2.5, strength=0.0)
    assert stress_run.examine(rising).checks == {"ends well": True, "objective falls": False}
    assert stress_run.examine(dataclasses.replace(rising, step=1.0)).passed


@pytest.mark.parametrize(
    ("image", "good", "objective", "step", "holds"),
    [(0.5, True, 1.0, None, True), (math.nan, True, 1.0, None, False), (math.nan, False, 1.0, 1.5, False),
     (0.5, False, math.nan, 1.5, True), (0.5, False, math.nan, 1.0, False), (0.5, True, math.nan, 1.5, False),
     (math.inf, True, 1.0, None, False)],
)  # fmt: skip
def test_what_ends_well(image, good, objective, step, holds):
    finding = stress_solve.Finding(dataclasses.replace(ORDINARY, step=step))
    stress_solve.ends_well(finding, np.full((2, 2), image), "converged", good, (1.0, objective))
    assert finding.checks == {"ends well": holds}


@pytest.mark.parametrize(
    ("precision", "last", "holds"),
    [("bfloat16", -2.0, True), ("bfloat16", -0.5, False), ("bfloat16", math.nan, False), ("float32", -2.0, False)],
)
def test_rounded_data_may_have_no_minimum(precision, last, holds):
    finding = stress_solve.Finding(dataclasses.replace(ORDINARY, precision=precision))
    stress_solve.ends_well(finding, np.zeros((2, 2)), "non_finite", False, (1.0, last, math.nan))
    assert finding.checks == {"ends well": holds}


def test_refusals_are_expected_or_faults(monkeypatch):
    refused = stress_run.examine(Case("", solver="LBFGS", prior="TV"))
    assert refused.outcome == "refused" and refused.passed and "has kinks" in refused.said

    def fails(error):
        def solve(case):
            raise error

        monkeypatch.setattr(stress_run, "solve", solve)
        return stress_run.examine(ORDINARY)

    for error, outcome in ((InputError("no"), "refused"), (ZeroDivisionError("no"), "raised")):
        found = fails(error)
        assert (found.outcome, found.passed) == (outcome, False) and "no" in found.said
    monkeypatch.setattr(stress_run, "_solve", lambda case, finding: None)
    assert not stress_run.examine(Case("", solver="LBFGS", prior="TV")).passed


def test_a_run_that_is_not_repeated_bit_for_bit_is_a_fault(monkeypatch):
    found = stress_solve.solve(ORDINARY)
    pictures = iter([found, found._replace(image=found.image + np.float32(1e-7))])
    monkeypatch.setattr(stress_run, "solve", lambda case: next(pictures))
    case = dataclasses.replace(ORDINARY, precision="float64")
    assert stress_run.examine(case).checks == {"ends well": True, "is the same again": False}


@settings(max_examples=12)
@given(
    strength=st.floats(0, 1e4), light=st.sampled_from(stress_cases.LIGHTS), bad=st.floats(0, 1),
    start=st.sampled_from(stress_cases.STARTS[:-1]), motion=st.sampled_from(stress_cases.MOTIONS),
    step=st.one_of(st.none(), st.floats(1e-3, 20)), seed=st.integers(0, 1000),
    precision=st.sampled_from(("float32", "bfloat16")),
)  # fmt: skip
def test_whatever_the_numbers_are_it_passes(strength, light, bad, start, motion, step, seed, precision):
    axes = {
        "strength": strength, "light": light, "bad": bad, "start": start, "motion": motion, "step": step, "seed": seed,
    }  # fmt: skip
    found = stress_run.examine(dataclasses.replace(ORDINARY, precision=precision, **axes))
    assert found.passed, (found.case.name(), found.checks, found.numbers, found.said)


def test_derivatives_are_finite_and_checked(monkeypatch):
    case = Case("gradients", kind="gradient", prior="TV", bad=1.0, strength=1e-2)
    found = stress_run.examine(case)
    assert found.passed and found.checks["gradient is finite"]
    assert found.numbers["by samples"] == 0  # none is left
    monkeypatch.setattr(stress_run, "_derivatives", lambda *_: (jnp.zeros(3), jnp.asarray(jnp.nan), jnp.zeros(3)))
    assert not stress_run.examine(case).passed


def test_condition_numbers_are_those_of_the_operator():
    still, moving = condition(2, "static"), condition(2, "diagonal")
    # At rest a sensor pixel sees one mean of four: a quarter of the directions is seen, all alike but for dark pixels.
    assert still.seen == 0.25 and still.pixels == 192
    assert moving.seen > still.seen and moving.bound >= 1 and moving.with_prior < moving.condition
    assert still.spectrum[0] == 1 and np.all(np.diff(still.spectrum) <= 0)


def test_the_report_is_written(tmp_path):
    report = stress(only=["vmap"], quick=True, workers=1)
    assert isinstance(report, Report) and len(report.findings) == 4 and not report.failed
    assert report.summary().startswith("4 cases, 0 failed, in ")
    broken = dataclasses.replace(report.findings[0], checks={"ends well": False}, numbers={"objective": math.nan})
    agreeing = stress_run.examine(ORDINARY)
    both = dataclasses.replace(
        report, findings=(broken, *report.findings, agreeing), conditions=(condition(2, "static"),)
    )
    assert both.summary().startswith("failed: vmap, vmap, FISTA, TV, float64, ") and len(both.failed) == 1
    both.write(tmp_path / "all.json")
    told = json.loads((tmp_path / "all.json").read_text())
    assert told["failed"] == 1 and len(told["cases"]) == 6 and told["cases"][0]["numbers"] == {"objective": None}
    assert told["about"]["versions"]["jax"] == jax.__version__ and told["about"]["seed"] == 0
    page = tmp_path / "page.md"
    page.write_text(f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter\n", encoding="utf-8")
    for _ in range(2):  # writing again replaces
        stress_page.write(page, both)
    text = page.read_text(encoding="utf-8")
    assert text.startswith("before\n") and text.endswith("\nafter\n") and "old" not in text
    assert "6 cases" in text and "**1 failed.**" in text and text.count("### Cases that failed") == 1
    assert "| agrees with float64 | 1 | 0 |" in text and "| ×2 | static |" in text
    for name in ("page_agreement.png", "page_condition.png"):
        with Image.open(tmp_path / name) as drawn:
            assert min(drawn.size) > 200


def test_what_cannot_be_done_is_refused(tmp_path):
    with pytest.raises(InputError, match="no family of cases 'magic': take some of solvers, "):
        stress(only=["magic"])
    with pytest.raises(InputError, match="workers is 0"):
        stress(workers=0)
    (tmp_path / "page.md").write_text("no marks")
    for name in ("page.md", "missing.md"):
        with pytest.raises(InputError, match=f"{name} is no page with the marks"):
            stress_page.check_page(tmp_path / name)
