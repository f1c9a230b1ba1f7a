"""Stage by stage: what is measured of known iterations, and how it is shown."""

import dataclasses
import inspect
import json
import math
import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import learned
from learned import zoo
from learned.evaluation import compare
from learned.evaluation.compare import compare_stages
from learned.evaluation.costs import cost
from learned.evaluation.reference_problem import PRIOR, ReferenceProblem, reference_problem, reference_task
from learned.evaluation.stage_report import Comparison, shown_stages
from learned.networks.unrolled_ista import UnrolledConfig, UnrolledISTA
from learned.training import checkpoint
from learned.zoo import Optimizer
from scsr_opt import InputError, Status
from scsr_opt.solvers import ISTA

UNROLLED = {"stages": 2, "boundaries": (10,), "proximal": False}
STRENGTH = 0.002


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> str:
    """An unrolled ISTA of two stages without networks and momentum: two steps of steepest descent."""
    path = tmp_path_factory.mktemp("nets") / "plain.scsr"
    net = UnrolledISTA(UnrolledConfig(2, **UNROLLED), key=jax.random.key(0))
    net = eqx.tree_at(lambda n: n.momenta, net, jnp.zeros_like(net.momenta))
    checkpoint.save(path, net, checkpoint.Card("unrolled", {"scale": 2, "network": UNROLLED}, "none", 0, "none", {}))
    return str(path)


ISTA_HUBER = Optimizer("ista-huber", PRIOR, ISTA(iterations=40))


@pytest.fixture(scope="module")
def posed(recording) -> ReferenceProblem:
    return reference_problem(reference_task(recording, scale=2), strength=STRENGTH)


@pytest.fixture(scope="module")
def truth(posed) -> np.ndarray:
    """The last picture of one of the models, so that it is right there and nowhere else."""
    return ISTA_HUBER.solve(posed, keep_images=True).image


@pytest.fixture(scope="module")
def compared(recording, plain, truth) -> Comparison:
    return compare_stages(recording, [ISTA_HUBER, plain], scale=2, truth=truth, strength=STRENGTH)


def test_ista_goes_down_the_gradient(compared):
    ista = compared.models[0]
    assert [stage.number for stage in ista.stages] == list(range(1, len(ista.stages) + 1))
    for stage in ista.stages:
        assert stage.downhill_r == pytest.approx(1, abs=1e-4)  # β∇f is far above the rounding of X
        assert stage.downhill_x < stage.downhill_r  # the prior pulls elsewhere
    own = [stage.own for stage in ista.stages]
    assert own[-1] < own[0]


def test_the_objective_is_the_solvers_own_where_the_prior_is_the_same(compared, posed):
    ista, plain = compared.models
    # ½⟨U, M U⟩ − ⟨c, U⟩ + ½ e in two programs. A sum over n pixels that comes to about e/2 is a walk of n roundings by
    # half a last digit of the sum so far: a standard deviation of √n/6 last digits, three of which are allowed.
    rounding = 0.5 * posed.plain.target.size**0.5 * float(np.spacing(np.float32(0.5 * posed.plain.energy)))
    for stage in ista.stages:
        assert stage.objective == pytest.approx(stage.own, abs=rounding)
        assert stage.objective == pytest.approx(stage.data + stage.prior, rel=1e-6)
    assert all(math.isnan(stage.own) for stage in plain.stages)


def test_the_converged_solution_is_the_end_of_the_scale(compared):
    for row in compared.models:
        assert all(stage.objective >= compared.reference_objective * (1 - 1e-5) for stage in row.stages)
    ista = compared.models[0]
    assert ista.stages[-1].distance < 0.9 * ista.stages[0].distance
    image = ista.pictures[len(ista.stages)][1]
    away = np.linalg.norm(image - compared.reference) / np.linalg.norm(compared.reference)
    assert ista.stages[-1].distance == pytest.approx(away, rel=1e-3)


def test_residual_and_step_by_hand(compared, posed):
    placed, (step, image) = posed.placed, compared.models[1].pictures[2]
    missed = np.asarray(placed.read(posed.plain.blurred(jnp.asarray(image))) - placed.value, np.float64)
    stage = compared.models[1].stages[1]
    assert stage.misfit == pytest.approx(math.sqrt(np.average(missed**2, weights=placed.weight)), rel=1e-3)
    before = compared.models[1].pictures[1][1]
    assert stage.change == pytest.approx(np.linalg.norm(image - before) / np.linalg.norm(before), rel=1e-4)
    np.testing.assert_array_equal(step, image)
    assert stage.downhill_x == stage.downhill_r == pytest.approx(1, abs=1e-4)


def test_the_truth_has_no_error(compared, truth):
    last = compared.models[0].stages[-1]
    assert last.psnr == math.inf and last.ssim == pytest.approx(1)
    assert all(20 < stage.psnr < 80 for stage in compared.models[1].stages)
    ista = compared.models[0]
    assert [n for n, stage in enumerate(ista.stages, 1) if not math.isnan(stage.ssim)] == list(ista.pictures)
    np.testing.assert_array_equal(compared.truth, truth)


def test_each_goes_on_from_the_other_s_picture(compared):
    (hybrid,) = compared.hybrids
    assert hybrid.network == compared.models[1].name and hybrid.optimizer == "fista-huber"
    assert 0 < hybrid.iterations < 200 and 0 < hybrid.iterations_from_scratch < 200
    # Both meet the same tolerance, so they end equally near: within a thousandth, where ISTA's first is off by tens.
    for objective in (hybrid.objective, hybrid.objective_from_scratch):
        assert objective == pytest.approx(compared.reference_objective, rel=2e-3)
    # Steepest descent lowers the data part and leaves the minimum of the whole.
    data = [stage.data for stage in hybrid.stages]
    assert data[1] < data[0] and hybrid.stages[1].objective > compared.reference_objective
    assert hybrid.stages[1].distance > hybrid.stages[0].distance > 0


def test_time_and_operations_grow_with_the_stages(compared):
    for row in compared.models:
        seconds, flops = ([getattr(stage, name) for stage in row.stages] for name in ("seconds", "flops"))
        assert row.seconds_before > 0 and seconds[0] > 0
        assert all(later > earlier for earlier, later in zip(flops, flops[1:], strict=False))
        assert flops[0] > 20 * 40 * 48  # more than its stencil alone


def test_operations_of_loops_are_counted_round_by_round():
    x, n = jnp.ones((32, 32)), 32

    def rounds(count: int):
        return lambda y: jax.lax.scan(lambda c, _: (c @ c, None), y, length=count)[0]

    once = cost(lambda y: y @ y, x).flops
    assert once is not None and once == pytest.approx(2 * n**3, rel=0.05)
    for function in (rounds(7), lambda y: jax.lax.fori_loop(0, 7, lambda _, c: c @ c, y), jax.jit(rounds(7))):
        assert cost(function, x).flops == pytest.approx(7 * once, rel=0.05)
    nested = cost(lambda y: jax.lax.scan(lambda c, _: (rounds(3)(c), None), y, length=5)[0], x)
    assert nested.flops == pytest.approx(15 * once, rel=0.05)
    assert cost(lambda y: jax.lax.while_loop(lambda c: c[0, 0] < 9, lambda c: c + 1, y), x).flops is None


def test_json_has_all_stages_and_finite_numbers(compared):
    def refuse(constant: str):
        raise AssertionError(f"{constant} is no JSON")

    content = json.loads(compared.json(), parse_constant=refuse)
    assert [len(row["stages"]) for row in content["models"]] == [len(row.stages) for row in compared.models]
    last = content["models"][0]["stages"][-1]
    assert last["psnr"] is None and last["objective"] == compared.models[0].stages[-1].objective
    assert content["models"][1]["stages"][0]["own"] is None
    assert content["hybrids"][0]["iterations"] == compared.hybrids[0].iterations and content["scale"] == 2


def test_the_table_has_a_block_for_each_model(compared):
    table = compared.table()
    ista, plain = compared.models
    assert f"\n{ista.name}: {len(ista.stages)} stages; minimises the objective; " in table
    assert f"\n{plain.name}: 2 stages; trained towards true pictures, makes no column small; " in table
    other = dataclasses.replace(ista, prior="TotalVariation", strength=0.0123)
    assert (
        "minimises 'own', with the prior TotalVariation and lambda 0.0123"
        in dataclasses.replace(compared, models=(other,)).table()
    )
    started = f"fista-huber started at the last picture of {plain.name}: {compared.hybrids[0].iterations} iterations"
    assert started in table
    lines = table.splitlines()
    head = lines.index(next(line for line in lines if "PSNR" in line))
    assert lines[head + 1].split()[0] == "1" and len(lines[head].split()) == len(lines[head + 1].split())
    assert len(lines[head]) == len(lines[head + 1])  # right-aligned columns
    legend = lines[lines.index('Columns ("-": the model has none, or it is not known):') + 1 :]
    assert [line.split()[0] for line in legend if line[2] != " "] == lines[head].split()
    own = lines[head].split().index("own")
    network = lines.index(next(line for line in lines if line.startswith(f"{compared.models[1].name}:")))
    assert lines[network + 2].split()[own] == "-"  # a network makes no objective small


def test_the_table_leaves_out_columns_of_which_nothing_is_known(compared):
    def blind(stages):
        unknown = dict.fromkeys(("psnr", "ssim", "seconds", "flops"), math.nan)
        return tuple(dataclasses.replace(stage, **unknown) for stage in stages)

    def blinded(rows):
        return tuple(dataclasses.replace(row, stages=blind(row.stages)) for row in rows)

    known = dataclasses.replace(compared, models=blinded(compared.models), hybrids=blinded(compared.hybrids)).table()
    assert not [name for name in ("PSNR", "SSIM", "seconds ", "GFLOP") if f"  {name}" in known]
    assert "downhill-X" in known


def test_the_figure_has_a_row_a_model(compared):
    drawn = compared.figure()
    shown = [len(row.pictures) for row in compared.models]
    assert shown == [6, 2]
    assert len(drawn.axes) == sum(shown) + len(shown) + 3  # each row's whole picture; last, the whole and two ends
    titles = [axes.get_title(loc="left") for axes in drawn.axes]
    assert titles[-2:] == ["converged", "truth"] and titles[6] == f"stage {len(compared.models[0].stages)}: " + (
        f"{compared.models[0].stages[-1].psnr:.2f} dB"
    )
    blind = dataclasses.replace(compared, truth=None).figure()
    first = f"stage 1: objective {compared.models[0].stages[0].objective:.5g}"
    assert first in [axes.get_title(loc="left") for axes in blind.axes]
    assert len(blind.axes) == len(drawn.axes) - 1


def test_files_are_whole_or_not_there(compared, tmp_path, monkeypatch):
    folder = tmp_path / "compared"
    for _ in range(2):  # it is made, or there already
        assert [path.name for path in compared.write(folder)] == ["stages.txt", "stages.json", "stages.png"]
    assert sorted(os.listdir(folder)) == ["stages.json", "stages.png", "stages.txt"]
    assert (folder / "stages.txt").read_text() == compared.table()
    with pytest.raises(InputError, match="Cannot make the folder .*stages.txt: file exists"):
        compared.write(folder / "stages.txt")

    def fail(_):
        raise RuntimeError("no figure today")

    monkeypatch.setattr(Comparison, "figure", fail)
    (tmp_path / "other").mkdir()
    with pytest.raises(RuntimeError, match="no figure today"):
        compared.write(tmp_path / "other")
    assert os.listdir(tmp_path / "other") == []


@pytest.mark.parametrize(
    ("count", "shown"),
    [
        (1, (1,)),
        (6, (1, 2, 3, 4, 5, 6)),
        (7, (1, 2, 4, 7)),
        (33, (1, 2, 4, 8, 16, 33)),
        (200, (1, 4, 8, 32, 64, 200)),
        (0, ()),
    ],
)
def test_which_stages_are_shown(count, shown):
    assert shown_stages(count) == shown


def test_what_cannot_be(recording, plain, monkeypatch):
    monkeypatch.setattr(compare, "reference_problem", lambda *_, **__: pytest.fail("it has begun to work"))
    for models, changes, message in (
        ([], {}, "name at least one model"),
        (["magic"], {}, "no model 'magic'"),
        (
            ["fista-tv", "ridge", "fista-tv"],
            {},
            "Of the models to compare, fista-tv comes more than once: name each once",
        ),
        (["ridge"], {"truth": np.zeros((20, 24))}, r"The truth is float64 of shape \(20, 24\)"),
        (["ridge"], {"truth": np.full((40, 48), 20_000, np.uint16)}, "mean is 2e.04, .*read_picture"),
        (["ridge"], {"truth": np.full((40, 48), 0.002)}, "mean is 0.002, .*read_picture"),
        (["ridge"], {"truth": np.full((40, 48), np.nan)}, "The truth holds a value that is not finite"),
        (["ridge"], {"truth": "truth.png"}, "The truth is 'truth.png', but it must be an array.*read_picture"),
        (["ridge-x2"], {}, "There is no model 'ridge-x2': leave -x2 out"),
        (["ridge", zoo.load_model("ridge-x2")], {}, "ridge comes more than once"),
        ("ista-tv,ridge", {}, r"it must be a list of names, such as \['ista-tv', 'ridge'\]"),
        (["ridge"], {"key": 41}, "key is 41"),
        ([plain], {"scale": 3}, "was trained for scale 2"),
    ):
        with pytest.raises(InputError, match=message):
            compare_stages(recording, models, **{"scale": 2, **changes})


def test_a_recording_of_darkness():
    with pytest.raises(InputError) as caught:
        compare_stages(np.zeros((41, 20, 24), np.uint8), ["fista-huber"], scale=2)
    assert str(caught.value) == Status.no_samples.message


def test_the_door_takes_the_same_arguments():
    door, inside = (inspect.signature(of).parameters for of in (learned.compare_stages, compare_stages))
    assert list(door) == list(inside)
    for name, parameter in inside.items():
        assert (door[name].kind, door[name].default) == (parameter.kind, parameter.default), name
