import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.pipeline.scene_summary import SceneSummary
from scsr_opt.pipeline.solution import Diagnostics
from scsr_opt.report import Report, versions
from scsr_opt.report.summary import plain
from scsr_opt.solvers.record import Status, TileIterations


@pytest.fixture
def report(solution) -> Report:
    return Report.of(solution, seconds={"solve": 1.23456})


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
    assert told["picture"]["scale"] == 4
    assert told["status"] == {"name": "converged", "message": Status.converged.message, "usable": True}
    assert told["motion"]["mean_speed"] == pytest.approx(0.1) and told["motion"]["top_speed"] == pytest.approx(0.2)
    said = {name: value for name, value in told["diagnostics"].items() if value is not None}
    assert said == {"iterations": 12, "samples": 0, "strength": 0.25, "motion_carried": True, "seconds": {}}
    assert told["diagnostics"].keys() == {field.name for field in dataclasses.fields(Diagnostics)}
    assert told["scene"] is None and told["tiles"] is None
    assert [stage["objective"] for stage in told["stages"]] == [10.0 / t for t in range(1, 13)]
    assert "image" not in told["stages"][0]
    assert told["seconds"] == {"solve": 1.2346}
    assert told["versions"]["numpy"] == np.__version__ and "jax" in told["versions"]


def test_report_of_a_solution_is_its_own_without_the_seconds_around_it(solution):
    assert dataclasses.replace(solution.report(), seconds={"solve": 1.2346}) == Report.of(
        solution, seconds={"solve": 1.23456}
    )


def test_report_has_the_numbers_of_scene_and_tiles(solution):
    scene = SceneSummary(np.array([[0, 2]]), np.array([[31, 1]]), np.ones((1, 2), np.float32), "2 layers", 500, 200)
    tiles = TileIterations(7, np.array([[0, 12]]), 64, float("nan"), 1e-3)
    told = json.loads(dataclasses.replace(solution, scene=scene, tiles=tiles).report().json())
    assert told["scene"] == scene.numbers and told["scene"]["tiles"]["static"] == 0.5
    assert told["tiles"] == tiles.numbers and told["tiles"]["largest_change"] is None


def test_report_white_rate_is_that_of_the_solution(solution):
    """Light of another level of white than the recording's was asked for."""
    assert dataclasses.replace(solution, white_rate=0.3).report().recording["white_rate"] == 0.3


def test_written_file_is_json(report, tmp_path):
    report.write(tmp_path / "report.json")
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8")) == json.loads(report.json())


def test_lines_for_a_reader(report):
    assert report.lines() == [
        "street: 31 frames of 40x24, key frame 15 -> 160x96 (x4)",
        "Motion: 0.1 sensor pixels per frame in the mean, 0.2 at most.",
        "12 iterations. The picture meets the tolerance. 1.2 s in all.",
    ]


@pytest.mark.parametrize(
    "used, expected",
    [
        (
            (20.0, 35.2, 50.0),
            "Time: 35 frames before and after the key frame are used in the median pixel, 20 to 50 in nine tenths",
        ),
        ((49.6, 50.0, 50.2), "Time: 50 frames before and after the key frame are used."),
    ],
)
def test_lines_say_how_far_in_time_samples_were_used(report, used, expected):
    found = dataclasses.replace(report, diagnostics={**report.diagnostics, "used_frames": used})
    (line,) = (line for line in found.lines() if line.startswith("Time"))
    assert line.startswith(expected)


def test_lines_say_what_is_saturated(report):
    def lines(saturated: float | None) -> list[str]:
        diagnostics = {**report.diagnostics, "saturated": saturated}
        return dataclasses.replace(report, diagnostics=diagnostics).lines()

    (line,) = (line for line in lines(0.0917) if line.startswith("Saturated"))
    assert line.startswith("Saturated: 9.2 % of the pixels fired in 90 % of the frames or more") and "bound" in line
    for share in (None, 0.0):
        assert "aturated" not in " ".join(lines(share))


def test_report_of_a_crop_says_which_part_of_the_sensor_it_shows(solution):
    assert json.loads(solution.report().json())["picture"]["crop"] is None
    cut = dataclasses.replace(solution, image=solution.image[:32, :64], crop=(3, 5, 8, 16), motion=None)
    report = cut.report()
    told = json.loads(report.json())
    assert told["picture"]["crop"] == [3, 5, 8, 16] and told["recording"]["width"] == 40
    assert report.lines()[0] == (
        "street: 31 frames of 40x24, 16x8 of them from row 3, column 5, key frame 15 -> 64x32 (x4)"
    )


def test_names_that_are_no_text_are_escapes_in_the_report(report, tmp_path):
    odd = 'a\udcff\n"b" é'
    dataclasses.replace(report, recording={"name": odd}).write(tmp_path / "a.json")
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))["recording"]["name"] == odd


def test_a_failed_solve_has_a_report_too(solution):
    failed = dataclasses.replace(
        solution, image=np.full((96, 160), np.nan, np.float32), status=Status.non_finite, motion=None, stages=()
    )
    told = json.loads(failed.report().json())
    assert told["picture"]["mean"] is None and told["motion"] is None and told["status"]["usable"] is False


def test_plain_takes_anything():
    @dataclasses.dataclass
    class Pair:
        a: float
        b: Path

    assert plain(Pair(float("inf"), Path("x/y"))) == {"a": None, "b": "x/y"}
    assert plain({1: jnp.arange(3), "r": Status.converged}) == {"1": [0, 1, 2], "r": "converged"}
    assert plain((jnp.float32(0.5), np.array(2))) == [0.5, 2]
    assert plain(slice(1)) == "slice(None, 1, None)"


def test_versions_names_what_matters():
    assert {"python", "scsr-opt", "jax", "numpy"} <= versions().keys()


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ({"quality": "fast"}, []),
        (
            {"quality": "fast", "restored": False, "restored_deviations": 4.24},
            [
                "Quality: fast instead of best. The network's picture predicted held-out measurements 4.2 standard "
                "deviations worse than the usual picture does, so it was not used."
            ],
        ),
        (
            {"quality": "best", "restored": True, "misfit_ratio": 1.0004, "restored_deviations": -2.0},
            [
                "Quality: best. A network improved the picture, and a second solve made it agree with the "
                "measurements: the misfit is 1.000 times that before. Held-out measurements are predicted 2.0 standard "
                "deviations better than before."
            ],
        ),
        (
            {"quality": "best", "restored": True, "misfit_ratio": 1.16},
            [
                "Quality: best. A network improved the picture, and a second solve made it agree with the "
                "measurements: the misfit is 1.160 times that before, so the measurements contradict the network's "
                "picture; compare with the quality fast. Held-out measurements were not compared, as λ was not "
                "searched for."
            ],
        ),
    ],
)
def test_lines_say_what_a_network_did(solution, found, said):
    changed = dataclasses.replace(solution, diagnostics=dataclasses.replace(solution.diagnostics, **found))
    report = changed.report()
    assert [line for line in report.lines() if line.startswith("Quality")] == said
    assert str(report) == repr(report) == "\n".join(report.lines())
