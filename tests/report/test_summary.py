import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.camera import Recording
from scsr_opt.report import Report, versions
from scsr_opt.report.summary import plain
from scsr_opt.solvers.solution import Result


@pytest.fixture
def report(spikes, solution) -> Report:
    bad = np.zeros((24, 40), bool)
    bad[0, :3] = True
    recording = Recording.from_array(spikes, white_rate=0.5, bad_pixels=bad, name="street")
    return Report.of(recording, solution, scale=4, key=15, seconds={"solve": 1.23456})


def test_the_numbers_are_the_solution_s(report, solution):
    told = json.loads(report.json())
    assert told["recording"] == {
        "name": "street",
        "frames": 31,
        "width": 40,
        "height": 24,
        "readout_rate": 40000.0,
        "white_rate": 0.5,
        "bad_pixels": 3,
    }
    assert told["picture"]["width"] == 160 and told["picture"]["height"] == 96 and told["picture"]["key"] == 15
    assert told["picture"]["mean"] == pytest.approx(solution.image.mean(), rel=1e-6)
    assert told["result"] == {"name": "converged", "sentence": Result.converged.sentence, "good": True}
    assert told["motion"]["mean_speed"] == pytest.approx(0.1) and told["motion"]["top_speed"] == pytest.approx(0.2)
    assert told["stats"] == {"iterations": 12, "strength": 0.25, "odd": None, "list": [True, None]}
    assert [stage["objective"] for stage in told["stages"]] == [10.0 / t for t in range(1, 13)]
    assert "image" not in told["stages"][0]
    assert told["seconds"] == {"solve": 1.2346}
    assert told["versions"]["numpy"] == np.__version__ and "jax" in told["versions"]


def test_written_file_is_json(report, tmp_path):
    report.write(tmp_path / "report.json")
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8")) == json.loads(report.json())


def test_lines_for_a_reader(report):
    assert report.lines() == [
        "street: 31 frames of 40x24, key frame 15 -> 160x96 (x4)",
        "Motion: 0.1 sensor pixels per frame in the mean, 0.2 at most.",
        "12 iterations in 1.2 s. The picture meets the tolerance.",
    ]


def test_lines_say_what_is_saturated(report):
    told = dataclasses.replace(report, stats={**report.stats, "saturated": 0.0917}).lines()
    (line,) = (line for line in told if line.startswith("Saturated"))
    assert line.startswith("Saturated: 9.2 % of the pixels fired in 90 % of the frames or more") and "bound" in line
    for share in ({}, {"saturated": 0.0}):
        assert "aturated" not in " ".join(dataclasses.replace(report, stats={**report.stats, **share}).lines())


def test_the_report_says_which_part_of_the_sensor_the_picture_shows(spikes, solution):
    recording = Recording.from_array(spikes, name="street")
    assert json.loads(Report.of(recording, solution, scale=4, key=15).json())["picture"]["crop"] is None
    cut = dataclasses.replace(solution, image=solution.image[:32, :64], stats={"crop": (3, 5, 8, 16)}, motion=None)
    report = Report.of(recording, cut, scale=4, key=15)
    told = json.loads(report.json())
    assert told["picture"]["crop"] == [3, 5, 8, 16] and told["recording"]["width"] == 40
    assert report.lines()[0] == (
        "street: 31 frames of 40x24, 16x8 of them from row 3, column 5, key frame 15 -> 64x32 (x4)"
    )


def test_names_that_are_no_text_are_escapes_in_the_report(report, tmp_path):
    odd = 'a\udcff\n"b" é'
    dataclasses.replace(report, recording={"name": odd}).write(tmp_path / "a.json")
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))["recording"]["name"] == odd


def test_a_failed_solve_has_a_report_too(spikes, solution):
    failed = dataclasses.replace(
        solution, image=np.full((96, 160), np.nan, np.float32), result=Result.non_finite, motion=None, stages=()
    )
    told = json.loads(Report.of(Recording.from_array(spikes), failed, scale=4, key=0).json())
    assert told["picture"]["mean"] is None and told["motion"] is None and told["result"]["good"] is False


def test_plain_takes_anything():
    @dataclasses.dataclass
    class Pair:
        a: float
        b: Path

    assert plain(Pair(float("inf"), Path("x/y"))) == {"a": None, "b": "x/y"}
    assert plain({1: jnp.arange(3), "r": Result.converged}) == {"1": [0, 1, 2], "r": "converged"}
    assert plain((jnp.float32(0.5), np.array(2))) == [0.5, 2]
    assert plain(slice(1)) == "slice(None, 1, None)"


def test_versions_names_what_matters():
    assert {"python", "scsr-opt", "jax", "numpy"} <= versions().keys()
