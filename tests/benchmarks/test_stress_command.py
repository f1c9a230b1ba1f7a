"""`scsr stress` as a command."""

from pathlib import Path

import pytest

from benchmarks import stress as library
from benchmarks import stress_page
from benchmarks.choosing_page import MARKS
from benchmarks.stress_cases import Case
from benchmarks.stress_solve import Finding
from scsr_opt.cli import main, measuring
from scsr_opt.cli import stress as command

PAGE = Path(__file__).parents[2] / "docs" / "stability.md"


@pytest.fixture
def asked(monkeypatch, tmp_path) -> list[dict]:
    """Puts a stand-in in the place of the cases; returns what it was called with."""
    monkeypatch.chdir(tmp_path)
    calls: list[dict] = []

    def stand_in(*, seed, quick, only, kept, progress):
        calls.append({"seed": seed, "quick": quick, "only": only})
        fails = "lights" in only
        finding = Finding(Case("lights", light="all-one"), "converged", {"ends well": not fails}, {}, "")
        about = {
            **library.machine(), "seed": seed, "quick": quick, "only": only, "programs": 1, "seconds": 1.0,
        }  # fmt: skip
        return library.Report((finding,), (), about)

    monkeypatch.setattr(library, "stress", stand_in)
    return calls


def test_a_run_that_passes(asked, capsys, tmp_path):
    (tmp_path / "page.md").write_text(f"{MARKS[0]}\n{MARKS[1]}\n")
    assert main(["stress", "--quick", "--seed", "5", "--json", "all.json", "--page", "page.md"]) == 0
    assert asked == [{"seed": 5, "quick": True, "only": []}]
    assert "1 cases, 0 failed" in capsys.readouterr().out
    assert (tmp_path / "all.json").stat().st_size > 0
    assert "`scsr stress --quick --seed 5`: 1 cases" in (tmp_path / "page.md").read_text()
    assert main(["stress", "-q"]) == 0 and capsys.readouterr().out == ""


def test_a_case_that_fails_is_said_and_is_the_exit_code(asked, capsys):
    assert main(["stress", "--only", "lights, steps"]) == 1
    assert asked[0]["only"] == ["lights", "steps"]
    assert (
        "failed: lights, solve, FISTA, Huber-TV, float32, light all-one: not so: ends well" in capsys.readouterr().out
    )


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
    assert main(["stress", *options]) == 2
    assert message in capsys.readouterr().err and not asked


def test_an_unknown_family_is_a_bad_request(capsys):
    assert main(["stress", "--only", "magic"]) == 2
    assert "There is no family of cases 'magic'" in capsys.readouterr().err


def test_without_the_benchmarks_it_says_where_to_go(monkeypatch, capsys):
    monkeypatch.setattr(measuring, "find_spec", lambda name: None)
    assert main(["stress"]) == 2
    assert "needs the project's own folder" in capsys.readouterr().err


def test_the_page_is_ready_to_be_written():
    stress_page.check_page(PAGE)
    text = PAGE.read_text(encoding="utf-8")
    for name in ("stability_agreement.png", "stability_condition.png"):
        assert name in text
        assert 0 < (PAGE.parent / name).stat().st_size < 200_000


def test_help_names_the_families():
    from benchmarks.stress_cases import FAMILIES

    parameter = command.stress.__annotations__["only"].__metadata__[0]
    assert all(name in parameter.help for name in FAMILIES)
