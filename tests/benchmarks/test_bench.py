"""`scsr bench`: does it measure what it says, and is it written where it belongs?"""

import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from benchmarks import bench as library
from benchmarks import (
    bench_cases,
    bench_iteration,
    bench_page,
    bench_plain,
    bench_published,
    bench_roofline,
    bench_scaling,
    bench_solvers,
    bench_timing,
    bench_whole,
)
from benchmarks.choosing_page import MARKS
from scsr_opt.camera.sampling_rules import Intervals, Windows
from scsr_opt.cli import bench as command
from scsr_opt.cli import main, measuring
from scsr_opt.errors import InputError
from scsr_opt.operators.sampling import accumulate
from scsr_opt.solvers import FISTA, CondatVu, NormBound

DOCS = Path(__file__).parents[2] / "docs"
# Everything once, as small as it goes.
TINY = bench_cases.Size(
    scales=(2,), solvers=("FISTA",), priors=(), methods=("reconstruct", "tfp_bicubic"), careful=False, sensor=16,
    rounds=2, exact=60, seconds=0.05, recordings=(("camera", "pan"),), lights=("day",), repeats=2,
    frames=(), still=16, sides=(16,),
    picture=(48, 64), accumulated=(21, 12, 16, 4),
)  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def small_pictures(quick_compilation):
    """Of 1,024 pixels."""


@pytest.fixture(scope="module")
def report() -> library.Report:
    """All families; the recordings of one are those of another, so that little is compiled twice."""
    return library.bench(size=TINY)


def test_every_family_says_what_it_found(report):
    assert list(report.figures) == list(library.FAMILIES)
    rows = report.figures["solvers"]
    assert {(row["part"], row["measuring"], row["precision"]) for row in rows} == {
        ("solvers", "Intervals", "float32"), ("data terms", "Windows", "float32"),
        ("precisions", "Intervals", "float64"),
    }  # fmt: skip
    for row in rows:
        gaps = [look["gap"] for look in row["looks"]]
        assert len(gaps) > 2 and gaps[0] > gaps[-1] and row["compile_seconds"] >= 0
        assert all(len(one["seconds"]) == TINY.rounds for one in row["reached"]) and row["reached"][0]["gap"] == 0.1
        assert all(look["psnr"] > 10 and look["ssim"] <= 1 and look["seconds"] > 0 for look in row["looks"])
    whole = {row["method"]: row for row in report.figures["whole"]["×2, day"]}
    assert whole["reconstruct"]["psnr"][0] > whole["tfp_bicubic"]["psnr"][0] + 3 and whole["tfp_bicubic"]["front"]
    (row,) = report.figures["scaling"]["sensor"]
    assert set(row["seconds"][0]) == set(bench_scaling.PARTS) and row["frames"] == bench_cases.FRAMES
    for kernel in report.figures["roofline"]["kernels"]:
        assert kernel["share"] > 0 and kernel["moved"] > 0
    assert all(one["ratio"]["middle"] > 0 for one in report.figures["statements"]["iterations"])


def test_a_run_that_was_stopped_goes_on_where_it_was(monkeypatch, tmp_path):
    done: list[str] = []

    def family(name, fails):
        def measure(size, seed, progress):
            done.append(name)
            if fails and done.count(name) == 1:
                raise KeyboardInterrupt
            return name.upper()

        return measure

    monkeypatch.setattr(library, "FAMILIES", {name: family(name, name == "b") for name in "abc"})
    monkeypatch.setattr(library, "machine", lambda: {"commit": "0123"})
    with pytest.raises(KeyboardInterrupt):
        library.bench(size=TINY, kept=tmp_path / "kept")
    assert library.bench(size=TINY, kept=tmp_path / "kept").figures == {"a": "A", "b": "B", "c": "C"}
    assert done == ["a", "b", "b", "c"] and not (tmp_path / "kept").exists()


def test_json_says_on_what_it_was_measured_and_nothing_of_whose_it_is(report, tmp_path):
    odd = dataclasses.replace(report, figures={**report.figures, "scaling": {"a": math.nan, "b": [math.inf, 1.5]}})
    odd.write(tmp_path / "all.json")
    told = json.loads((tmp_path / "all.json").read_text(encoding="utf-8"))
    assert told["figures"]["scaling"] == {"a": None, "b": [None, 1.5]}
    about = told["about"]
    assert about["versions"]["jax"] == jax.__version__ and about["cores"] > 0 and about["processor"]
    assert {"memory", "system", "commit", "seed", "quick", "only", "size", "seconds", "seconds_of"} <= set(about)
    import platform

    text = (tmp_path / "all.json").read_text(encoding="utf-8")
    assert str(Path.cwd()) not in text and f'"{platform.node()}"' not in text


def test_the_page_is_written_with_its_plots(report, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter\n", encoding="utf-8")
    bench_page.write(page, report)
    text = page.read_text(encoding="utf-8")
    assert text.startswith("before\n") and text.endswith("\nafter\n") and "old" not in text
    for head in ("### Solvers", "### Whole", "### How it grows", "### How far", "### Two", "### Beside"):
        assert text.count(head) == 1
    assert "the default **is**" in text or "the default is **not**" in text
    for name in ("solvers", "whole_x2_day", "scaling", "roofline"):
        assert f"](page_{name}.png)" in text
        with Image.open(tmp_path / f"page_{name}.png") as drawn:
            assert min(drawn.size) > 200
    assert report.summary().count("\n") > 10
    report.write(tmp_path / "kept.json")
    page.write_text(f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter\n", encoding="utf-8")
    bench_page.main(str(tmp_path / "kept.json"), str(page))
    assert page.read_text(encoding="utf-8") == text


def test_the_design_is_what_the_page_says():
    for scale, prior in ((2, "ridge"), (4, "Huber-TV")):
        entries = bench_solvers.design(scale)
        tried = {e.solver for e in entries if e.part == "solvers"}
        assert {name.split(",")[0] for name in bench_solvers.SOLVERS} <= tried < {*bench_solvers.SOLVERS}
        assert all((e.prior == prior) == (e.part != "priors") for e in entries)
        assert {e.prior for e in entries} == {name for name, *_ in bench_solvers.tried()}
        assert {e.measuring for e in entries} == {"Intervals", "Windows"}
        assert {e.precision for e in entries} == {"float32", "float64"}
    for size in (bench_cases.FULL, bench_cases.QUICK):
        assert len(set(size.recordings)) == len(size.recordings)
    stills, motions = zip(*bench_cases.FULL.recordings, strict=True)
    assert len(set(stills)) == len(set(motions)) == 3 == len(stills)
    assert bench_cases.FULL.scales == (2, 4)
    assert isinstance(bench_solvers.measuring_of("Windows"), Windows)
    assert isinstance(bench_solvers.measuring_of("Intervals"), Intervals)
    for scale in (2, 4):
        names = [one.name for one in bench_whole.methods(scale)]
        assert names[0] == bench_whole.DEFAULT and "unrolled" in names and len(set(names)) == len(names)
        # What is the default there is not measured again under its own name.
        assert ("ridge" in names, "fista-huber" in names) == ((False, True) if scale == 2 else (True, False))
        assert set(bench_cases.QUICK.methods or ()) <= set(names)


def row_of(seconds: list[float], psnr: float, kind: str = "variant") -> dict[str, Any]:
    return {"seconds": [seconds], "psnr": [psnr], "kind": kind}


def test_the_front_is_what_nothing_beats():
    places = [(1.0, 20.0), (2.0, 25.0), (2.0, 24.0), (3.0, 25.0), (1.0, 20.0), (5.0, 26.0)]
    rows = [row_of([seconds] * 4, psnr) for seconds, psnr in places]
    assert bench_whole.front(rows) == [True, True, False, False, True, True]


def test_times_are_compared_round_by_round_and_beyond_chance():
    usual = row_of([1.0, 2.0, 1.0, 9.0], 25.0)
    assert bench_whole.beats(row_of([0.9, 1.9, 0.9, 8.9], 25.001), usual)  # faster each time
    assert not bench_whole.beats(row_of([0.9, 2.1, 0.9, 9.1], 25.001), usual)  # now and then
    assert bench_whole.beats(row_of([0.9, 2.1, 0.9, 9.1], 25.02), usual)  # but better
    assert not bench_whole.beats(row_of([0.9, 2.1, 1.1, 9.1], 25.02), usual)
    assert not bench_whole.beats(row_of([0.5, 1.0, 0.5, 4.5], 24.98), usual)


def test_what_the_same_method_differs_by_is_no_difference():
    usual = row_of([1.0, 1.0, 1.0, 1.0], 25.0, "default")
    quicker, again = row_of([0.97] * 4, 25.0), row_of([0.95, 1.0, 1.02, 0.95], 25.0, "default again")
    assert bench_whole.chance([usual, quicker]) == 1 and bench_whole.front([usual, quicker]) == [False, True]
    assert bench_whole.chance([usual, quicker, again]) == pytest.approx(0.95)
    assert bench_whole.front([usual, quicker, again])[:2] == [True, True]
    assert bench_whole.front([usual, row_of([0.94] * 4, 25.0), again])[:2] == [False, True]
    slower = row_of([1.0, 1.0, 1.25, 1.25], 25.0, "default again")
    assert bench_whole.chance([usual, slower]) == pytest.approx(0.8)


def test_calls_take_turns():
    order: list[str] = []
    taken = bench_timing.in_turns({name: lambda name=name: order.append(name) for name in "abc"}, 3)
    assert [len(times) for times in taken.values()] == [3, 3, 3]
    assert all(sorted(order[k : k + 3]) == ["a", "b", "c"] for k in (0, 3, 6))
    assert bench_timing.ratios([2.0, 6.0, 2.0], [1.0, 2.0, 2.0]) == pytest.approx((1.5, 2.0, 2.5))


def test_compilations_are_counted():
    function = jax.jit(lambda x: x * 3 + 1)
    with bench_timing.compilations() as first:
        function(jnp.ones(7))
    with bench_timing.compilations() as second:
        function(jnp.ones(7))
    assert len(first) >= 1 and second == []


def test_xla_counts_what_is_plain_to_see():
    told = bench_timing.program(lambda a: a @ a, jnp.ones((32, 32)))
    assert told.flops == pytest.approx(2 * 32**3, rel=0.1) and told.memory >= 2 * 4 * 32**2
    assert told.moved is not None and told.moved >= 2 * 4 * 32**2
    np.testing.assert_array_equal(np.asarray(told.call()[0]), np.full((32, 32), 32.0))


@pytest.mark.parametrize(
    ("solver", "iteration"),
    [(FISTA(step_size=NormBound()), bench_plain.plain_fista), (CondatVu(), bench_plain.plain_condat_vu)],
)
def test_the_plain_iteration_is_the_iteration(solver, iteration):
    problem, image = bench_iteration.problem_of((24, 32))
    state = bench_iteration.first_state(solver, problem, image)
    fused, plain = state, state
    for _ in range(3):  # with momentum, too
        fused, record = bench_iteration.fused_iteration(solver, problem, fused)
        plain, said = iteration(problem, plain)
        np.testing.assert_allclose(said, (record.data, record.prior, record.residual), rtol=1e-4)
    for one, other in zip(jax.tree.leaves(fused), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts page faults of Linux")
def test_kept_memory_is_not_cleared_again():
    resource = pytest.importorskip("resource")
    double, ones = jax.jit(lambda x: 2 * x), jnp.ones(4_000_000)

    def faults() -> int:
        """Pages that are new to the process, of 16 MB in each of four calls."""
        double(ones).block_until_ready()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(4):
            double(ones).block_until_ready().delete()
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    kept, usual = [], []
    for _ in range(6):  # which memory is free by the time of a call is a matter of threads
        with bench_timing.keeping_memory():
            kept.append(faults())
        usual.append(faults())
    # At first there is nothing that could have been kept.
    assert sum(kept[1:]) < sum(usual[1:]) / 2


def test_numpy_accumulates_the_same():
    placed = bench_iteration.placed_of(21, 12, 16, 4)
    term, (planes, target) = accumulate(placed), bench_iteration.plain_accumulation(placed)
    np.testing.assert_allclose(term.stencil.planes, planes, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(term.target, target, rtol=1e-4, atol=1e-4)


def test_bytes_by_hand_are_no_more_than_xla_moves():
    """It counts each operation of a program by itself: never less than the least, unless a pass is left out."""
    for name, kernel in bench_roofline.kernels((48, 64), (21, 12, 16, 4)).items():
        # Those without loops, of which it counts one round.
        if name.startswith(("stencil", "aperture", "f and", "Huber", "its prox", "FISTA", "CondatVu")):
            told = bench_timing.program(kernel.call, *kernel.arguments)
            assert told.moved is not None and told.moved > 0.9 * kernel.moved, name


def test_what_does_not_fit_is_left_out(monkeypatch):
    monkeypatch.setattr(bench_scaling, "memory_available", lambda: 1000)
    found = bench_scaling.measure(TINY, 0, library.NoProgress())
    assert found["sensor"] == [] and found["skipped"][0]["side"] == 16


def test_published_figures_are_the_papers_and_ours_are_on_the_pages(shared_data):
    paper = (shared_data.parent / "paper" / "spikesr_net_aaai2023.txt").read_text(encoding="utf-8")
    for figures in bench_published.PUBLISHED.values():
        assert all(figure in paper for figure in figures)


def test_our_figures_are_on_the_pages():
    for one in bench_published.OURS:
        text = (DOCS / one.page).read_text(encoding="utf-8").replace("**", "")
        for ratio, likeness in (*(one.twice or ()), *(one.four_times or ())):
            digits = 1 if one.method.startswith("playback") else 2
            shown = f"{ratio:.{digits}f}" + ("" if likeness is None else f" / {likeness:.3f}")
            assert shown in text, (one.method, shown)
    assert bench_published.mean(((20.0, 0.5), (21.0, 0.7))) == "20.50/0.600"
    assert bench_published.mean(((20.0, None), (21.0, 0.7))) == "20.50" and bench_published.mean(None) == "–"


def test_what_cannot_be_done_is_refused(tmp_path):
    with pytest.raises(InputError, match="no family of benchmarks 'magic': take some of solvers, "):
        library.bench(only=["magic"])
    with pytest.raises(InputError, match="seed is -1"):
        library.bench(seed=-1)
    (tmp_path / "page.md").write_text("no marks")
    for name in ("page.md", "missing.md"):
        with pytest.raises(InputError, match=f"{name} is no page with the marks"):
            bench_page.check_page(tmp_path / name)


@pytest.fixture
def asked(monkeypatch, tmp_path) -> list[dict]:
    """Puts a stand-in in the place of the measurements; returns what it was called with."""
    monkeypatch.chdir(tmp_path)
    calls: list[dict] = []

    def stand_in(*, seed, quick, only, kept, progress):
        calls.append({"seed": seed, "quick": quick, "only": only, "kept": kept})
        about = {
            **library.machine(), **library.hardware(), "seed": seed, "quick": quick, "only": only, "seconds": 1.0,
        }  # fmt: skip
        return library.Report({}, about)

    monkeypatch.setattr(library, "bench", stand_in)
    return calls


def test_the_command(asked, capsys, tmp_path):
    (tmp_path / "page.md").write_text(f"{MARKS[0]}\n{MARKS[1]}\n")
    asking = ["bench", "--quick", "--seed", "5", "--only", "solvers, whole", "--json", "all.json", "--page", "page.md"]
    assert main(asking) == 0
    kept = Path("all.json.partial")
    assert asked == [{"seed": 5, "quick": True, "only": ["solvers", "whole"], "kept": kept}]
    assert "in 1 s" in capsys.readouterr().out and (tmp_path / "all.json").stat().st_size > 0
    assert "`scsr bench --quick --seed 5 --only solvers,whole`" in (tmp_path / "page.md").read_text()
    assert main(["bench", "-q"]) == 0 and capsys.readouterr().out == "" and asked[-1]["kept"] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--only", " , "], "--only names no family"),
        (["--json", "no/where.json"], "the folder no does not exist"),
        (["--page", "page.md"], "page.md is no page with the marks"),
        (["--seed", "1.5"], "1.5"),
    ],
)
def test_it_refuses_before_it_starts(asked, capsys, options, message):
    assert main(["bench", *options]) == 2
    assert message in capsys.readouterr().err and not asked


def test_an_unknown_family_is_a_bad_request(capsys):
    assert main(["bench", "--only", "magic"]) == 2
    assert "There is no family of benchmarks 'magic'" in capsys.readouterr().err


def test_without_the_benchmarks_it_says_where_to_go(monkeypatch, capsys):
    monkeypatch.setattr(measuring, "find_spec", lambda name: None)
    assert main(["bench"]) == 2
    assert "needs the project's own folder" in capsys.readouterr().err


def test_help_names_the_families():
    parameter = command.bench.__annotations__["only"].__metadata__[0]
    assert all(name in parameter.help for name in library.FAMILIES)


def test_the_page_is_ready_to_be_written():
    page = DOCS / "benchmarks.md"
    bench_page.check_page(page)
    text = page.read_text(encoding="utf-8")
    for name in ("solvers", "whole_x2_day", "scaling", "roofline"):
        assert f"benchmarks_{name}.png" in text
        assert 0 < (DOCS / f"benchmarks_{name}.png").stat().st_size < 200_000
