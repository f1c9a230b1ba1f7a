"""Every benchmark on its smallest case: it runs, and makes its page or table."""

import json
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import choosing, command, ladder, masked, sensitivity, sequences, skipping
from benchmarks.bench import __main__ as bench
from benchmarks.bench.size import Size
from benchmarks.peers import __main__ as peers
from benchmarks.peers import ours, rows
from benchmarks.peers.problems import CASES, camera
from benchmarks.recordings import recorded, recording_of
from benchmarks.stress import __main__ as stress
from benchmarks.stress.cases import Case
from scsr_opt import priors, reconstruct, solvers
from scsr_opt._settings import Settings
from scsr_opt.baselines import BASELINES
from scsr_opt.camera import Recording
from scsr_opt.progress import NoProgress

# Everything once, as small as it goes; the recording of all families is the same, so that little is compiled twice.
TINY = Size(
    scales=(2,), solvers=("FISTA",), priors=(), methods=("reconstruct", "tfp_bicubic"), careful=False, sensor=16,
    rounds=2, exact=60, seconds=0.05, recordings=(("camera", "pan"),), lights=("day",), repeats=2,
    frames=(), still=16, sides=(16,), picture=(48, 64), accumulated=(21, 12, 16, 4),
)  # fmt: skip


@pytest.fixture(scope="module")
def recording() -> Recording:
    return recording_of(recorded("camera", scale=2, sensor=16))


@pytest.fixture
def written(tmp_path):
    """A function that runs a benchmark's command line with a measurement in the place of its own, twice: measuring, and
    from the JSON file; and returns the page."""

    def run(benchmark: command.Benchmark, *parts: dict) -> str:
        page, kept = tmp_path / "page.md", tmp_path / "found.json"
        begin, end = command.marks("measured")
        page.write_text(f"before\n{begin}\nold\n{end}\nafter\n", encoding="utf-8")
        benchmark = benchmark._replace(measure=lambda options: iter(parts))
        command.main(benchmark, ["--json", str(kept), "--page", str(page), "--quick"])
        text = page.read_text(encoding="utf-8")
        assert text.startswith("before\n") and text.endswith("\nafter\n") and "old" not in text
        assert f"`python -m benchmarks.{benchmark.name} --quick`" in text
        assert set(json.loads(kept.read_text(encoding="utf-8"))) == {"about", *parts[-1]}
        for plot in benchmark.plots(command.finite(parts[-1])):
            assert (tmp_path / f"page_{plot}.png").stat().st_size > 1000
        command.main(benchmark, ["--from", str(kept), "--page", str(page)])
        assert page.read_text(encoding="utf-8") == text
        return text

    return run


@pytest.mark.slow  # 41 core seconds; test_calculations.py has what it calculates, and the two below write a page
def test_bench_smallest_case_writes_page(written):
    text = written(bench.BENCHMARK, *bench.measured(TINY, tuple(bench.FAMILIES), 0, NoProgress()))
    for head in ("### Solvers", "### Whole", "### How it grows", "### How far"):
        assert text.count(head) == 1
    for plot in ("solvers", "whole_x2_day", "scaling", "roofline"):
        assert f"](page_{plot}.png)" in text
    for line in (
        "| `FISTA`, ridge |",
        "| **`reconstruct`**, the default |",
        "| 101 | 16×16 |",
        "| FISTA, an iteration",
    ):
        assert line in text


def test_stress_smallest_cases_write_page(written):
    case = Case("solvers", prior="TV", iterations=20)
    refused = Case("reconstruct", kind="reconstruct", motion="not a number")
    rising = Case("descent", kind="descent", solver="ISTA", prior="TV", step=2.5, strength=0.0)
    few = [case, Case("conditioning", prior="TV", iterations=20), refused, rising]
    text = written(stress.BENCHMARK, stress.measured(few, NoProgress(), quick=True, workers=1))
    assert "4 cases by 3 programs. **1 failed.**" in text
    assert "- descent, descent, ISTA, TV, float32, strength 0.0, step 2.5: not so: objective falls" in text
    assert "| agrees with float64 | 2 | 0 |" in text and "| ×2 | static |" in text
    assert not stress.rows_of.__module__.endswith("__main__")  # worker processes could not import it


def test_choosing_smallest_case_writes_page(written, monkeypatch):
    tv = priors.TotalVariation()
    few = {"TV": (tv, 1, solvers.FISTA(iterations=15)), "Huber-TV": (priors.HuberTotalVariation(), 1, solvers.FISTA())}
    monkeypatch.setattr(choosing, "compared_priors", lambda: few)
    race = choosing.Race("TV", 2, tv, 1, {"FISTA": (solvers.FISTA(), 4)}, solvers.FISTA(iterations=60))
    monkeypatch.setattr(choosing, "races", lambda size: [race])
    size = choosing.Size(16, 32, ("camera",), ((2, "day"),), 60, 0.05)
    text = written(choosing.BENCHMARK, *choosing.measured(size, ("solvers", "priors"), 0))
    assert "**TV, ×2, 32×32**" in text and "| `FISTA` |" in text and "| Huber-TV |" in text


def test_ladder_smallest_case_makes_table():
    *models, network, _ = ladder.rows(ladder.turning(2, 16, 16), ["ridge"], rounds=1)
    assert [line[0] for line in models] == ["`ridge`"] and models[0][2] == "1.00" and float(models[0][3]) > 20
    assert network[0].startswith("SpikeSR-Net") and network[1] == "1.09"


def test_skipping_smallest_case_makes_row(recording):
    row = skipping.row(skipping.Case("pan", recording, 2, 101, None), rounds=1)
    assert row.startswith("| pan ×2 | ") and row.count("|") == 8


@pytest.mark.slow  # it measures with the functions of skipping
def test_sequences_smallest_case_makes_table(recording):
    table = sequences.table(recording, range(45, 55, 5), 2, rounds=1)
    assert all(f"| {way} | " in table for way in ("sequence", "from scratch", "in full"))


def test_masked_smallest_case_ranks_reconstruct_first(recording):
    methods = {"reconstruct": reconstruct, "tfp_bicubic": BASELINES["tfp_bicubic"]}
    _, first, second = masked.lines(recording, 2, 0.2, 1, methods)
    assert first.startswith("| reconstruct | 0.0") and "| 0.0 % ± 0.0 % |" in first
    assert float(second.split("|")[2]) > float(first.split("|")[2])


@dataclass(frozen=True, kw_only=True)
class Inner(Settings):
    decay: tuple[float, ...] = (1.0, 0.5)
    count: int = 1


@dataclass(frozen=True, kw_only=True)
class Outer(Settings):
    strength: float = 1e-3
    inner: Inner = field(default_factory=Inner)


def test_sensitivity_walks_nested_settings():
    assert sensitivity.numbers(Outer()) == {"strength": 1e-3, "inner.decay": (1.0, 0.5), "inner.count": 1}
    assert sensitivity.changed(Outer(), "inner.count", 4) == Outer(inner=Inner(count=4))
    assert sensitivity.scaled((3, 0.5), 0.5) == (2, 0.25) and sensitivity.scaled(1, 0.5) == 1


def test_sensitivity_field_without_effect_is_a_candidate(recording):
    made = [sensitivity.Case("pan", recording, np.zeros((32, 32)))]

    def solve(recording, *, scale, settings):
        return reconstruct(recording, scale=scale, strength=settings.strength)

    row, other = (sensitivity.measured(name, made, 1, Outer(), solve) for name in ("strength", "inner.decay"))
    assert abs(row["+50 %"]["psnr"][0]) > 1e-4 and row["-50 %"]["time"][0] > 0
    other = other | {way: one | {"time": [1.0]} for way, one in other.items() if way != "value"}
    text = sensitivity.page({"strength": row, "inner.decay": other})
    assert "\n| `strength` | 0.001 | " in text and "- `inner.decay`, no picture changes at all" in text
    slow = sensitivity.measured("inner.count", made, 1, Outer(), solve)
    assert "- `inner.count`, -50 % (1): the same value" in sensitivity.page({"inner.count": slow})


def test_peers_own_row_makes_table():
    case = CASES["shifts"](camera())
    method = next(method for method in ours.methods(case) if method.name == ours.DEFAULT)
    problem = ours.problem(case, ours.placed(case))
    near = solvers.run(solvers.FISTA(iterations=60, tolerance=0), problem, jnp.asarray(case.start, jnp.float32))
    row = rows.measure(case, case.objective(near.image), method)
    table = peers.table("shifts", 1.0, [{"peer": peers.OURS, **row}])
    assert f"| {peers.OURS} | FISTA | {row['iterations']} |" in table and table.count("\n") == 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--only", "magic"], "--only has no family 'magic': take some of solvers, "),
        (["--only", ""], "--only has no family ''"),
        (["--seed", "-1"], "--seed is -1"),
        (["--json", "no/where.json"], "the folder no does not exist"),
        (["--page", "missing.md"], "missing.md is no page with the marks"),
        (["--from", "missing.json"], "--from missing.json cannot be read"),
    ],
)
def test_command_bad_option_exits_with_message(options, message, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        command.main(bench.BENCHMARK._replace(measure=lambda options: pytest.fail("it began")), options)
    assert ended.value.code == 2 and message in " ".join(capsys.readouterr().err.split())
