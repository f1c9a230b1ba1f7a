"""Charts show what they are given: their data are read back from the artists, not compared with pictures."""

import dataclasses
import io
import math
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EventCollection
from matplotlib.quiver import Quiver
from PIL import Image

from scsr_opt.errors import InputError
from scsr_opt.report import (
    Wipe,
    convergence,
    error_map,
    explore,
    spike_raster,
    stage_grid,
    time_against_error,
    velocity_map,
    zoomed_crops,
)
from scsr_opt.solvers import Stage


def stages(count: int, image: np.ndarray | None = None) -> list[Stage]:
    """Stages whose objective falls from 2 towards 1."""
    return [
        Stage(t, 1 + 2.0**-t, 1.0, 2.0**-t, 0.5**t, 0.1, seconds=0.01 * t, image=image, gradient_step=image)
        for t in range(1, count + 1)
    ]


def line(axes: Any, number: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = axes.lines[number].get_data()
    return np.asarray(x), np.asarray(y)


def shown(axes: Any) -> np.ndarray:
    """The picture in axes."""
    return np.asarray(axes.images[0].get_array())


def drawn_once(figure) -> None:
    FigureCanvasAgg(figure).draw()  # layout and texts, under warnings as errors
    used, page = figure.get_tightbbox(), figure.bbox_inches  # nothing is cut off
    assert used.x0 > -0.02 and used.y0 > -0.02 and used.x1 < page.x1 + 0.02 and used.y1 < page.y1 + 0.02


def test_spike_raster_shows_the_spikes_of_the_pixels_named():
    spikes = np.zeros((30, 4, 5), np.uint8)
    spikes[[3, 9, 20], 1, 2] = 1
    drawn = spike_raster(spikes, pixels=[(1, 2), (0, 0)], key=9, title="Spikes")
    drawn_once(drawn)
    first, second = (rows for rows in drawn.axes[1].collections[:2] if isinstance(rows, EventCollection))
    assert list(first.get_positions()) == [3, 9, 20] and len(second.get_positions()) == 0
    assert shown(drawn.axes[0]).sum() == 1  # one pixel fires in frame 9


@pytest.mark.parametrize("wrong", [{"key": 30}, {"pixels": [(4, 0)]}])
def test_spike_raster_outside_the_recording_is_refused(wrong):
    with pytest.raises(InputError):
        spike_raster(np.zeros((30, 4, 5), np.uint8), **wrong)


def test_zoomed_crops_shows_the_same_part_of_each():
    pictures = {name: np.random.default_rng(n).random((40, 60)).astype(np.float32) for n, name in enumerate("abc")}
    drawn = zoomed_crops(pictures, parts=[(2, 3, 10, 20), (20, 30, 10, 20)])
    drawn_once(drawn)
    parts = [shown(axes) for axes in drawn.axes]
    for row, (top, left) in zip((parts[1:4], parts[5:8]), ((2, 3), (20, 30)), strict=True):
        for part, image in zip(row, pictures.values(), strict=True):
            assert np.array_equal(part, image[top : top + 10, left : left + 20])
    drawn_once(zoomed_crops(pictures, scale=1))
    small = zoomed_crops({name: picture[:40, :40] for name, picture in pictures.items()}, scale=2)
    assert len(small.axes) == 4  # one row: two parts would overlap
    with pytest.raises(InputError, match="one size"):
        zoomed_crops({"a": np.zeros((3, 4)), "b": np.zeros((4, 4))})


def test_error_map_is_signed_and_says_the_root_mean_square():
    truth = np.full((6, 8), 0.5, np.float32)
    drawn = error_map({"bright": truth + 0.1, "dark": truth - 0.2}, truth)
    drawn_once(drawn)
    assert np.allclose(shown(drawn.axes[0]), 0.1) and np.allclose(shown(drawn.axes[1]), -0.2)
    assert drawn.axes[0].get_title(loc="left") == "bright: RMS 0.1"
    least, most = drawn.axes[0].images[0].get_clim()
    assert least is not None and least == -(most or 0)  # white is no error


def test_velocity_map_arrows_point_along_the_motion(solution):
    velocity = np.stack([np.full((24, 40), 0.3), np.full((24, 40), -0.4)]).astype(np.float32)
    drawn = velocity_map(velocity)
    drawn_once(drawn)
    arrows = drawn.axes[0].collections[0]
    assert isinstance(arrows, Quiver)
    assert np.allclose(arrows.U, -0.4) and np.allclose(arrows.V, 0.3)
    drawn_once(velocity_map(solution))
    drawn_once(velocity_map(np.zeros((2, 5, 6), np.float32)))
    with pytest.raises(InputError, match="no motion"):
        velocity_map(dataclasses.replace(solution, motion=None))


def test_convergence_has_a_line_for_each_method(solution):
    drawn = convergence({"FISTA": stages(5), "ISTA": stages(9)})
    drawn_once(drawn)
    objective, residual = drawn.axes
    assert [len(line(objective, n)[0]) for n in range(2)] == [5, 9]
    assert list(line(residual, 0)[1]) == [0.5**t for t in range(1, 6)]
    assert len({(one.get_color(), one.get_linestyle()) for one in objective.lines}) == 2
    drawn_once(convergence(solution))
    with pytest.raises(InputError, match="no stages"):
        convergence({"nothing": []})


def test_convergence_draws_objectives_relative_to_their_own_lowest():
    """An objective with another prior may be ten times as large; the curves lie on each other all the same."""
    tenfold = [dataclasses.replace(stage, objective=10 * stage.objective) for stage in stages(5)]
    given = {"weak": stages(5), "strong": tenfold}
    objective = convergence(given).axes[0]
    assert line(objective, 0)[1] == pytest.approx(line(objective, 1)[1]) and line(objective, 0)[1][-1] == 1
    assert objective.get_ylabel() == "objective / its own lowest value"
    nothing = [dataclasses.replace(stage, objective=0.0) for stage in stages(2)]
    with pytest.raises(InputError, match="lowest objective of zero is 0"):
        convergence({"zero": nothing, **given})
    drawn_once(convergence(nothing))


def test_convergence_of_one_problem_draws_the_gap_to_the_lowest_of_all():
    given = {"a": stages(5), "b": stages(9)}
    objective = convergence(given, one_problem=True).axes[0]
    least = stages(9)[-1].objective
    assert list(line(objective, 0)[1]) == pytest.approx([(stage.objective - least) / least for stage in stages(5)])
    assert math.isnan(line(objective, 1)[1][-1]) and objective.get_yscale() == "log"
    assert objective.get_ylabel() == "gap (F − F*) / F*"


def test_convergence_of_one_method_draws_objectives_as_they_are():
    for one_problem in (False, True):
        objective = convergence({"a": stages(5)}, one_problem=one_problem).axes[0]
        assert list(line(objective, 0)[1]) == [stage.objective for stage in stages(5)]
        assert objective.get_ylabel() == ""


def test_time_against_error_is_the_gap_to_the_least():
    drawn = time_against_error({"one": stages(4)}, least=1.0)
    drawn_once(drawn)
    assert list(line(drawn.axes[0], 0)[1]) == pytest.approx([2.0**-t for t in range(1, 5)])
    assert list(line(drawn.axes[0], 0)[0]) == pytest.approx([10, 20, 30, 40])  # milliseconds
    with pytest.raises(InputError, match="above 0"):
        time_against_error({"one": stages(2)}, least=0.0)


def test_stage_grid_shows_stages_and_the_last_one():
    image = np.random.default_rng(0).random((40, 40)).astype(np.float32)
    drawn = stage_grid({"a": stages(6, image), "b": stages(2, image)}, stages=(1, 4), truth=image)
    drawn_once(drawn)
    titles = [axes.get_title(loc="left").split(":")[0] for axes in drawn.axes]
    assert titles == ["a, t = 1", "a, t = 4", "a, t = 6", "truth", "b, t = 1", "", "b, t = 2", "truth"]
    assert [text.get_text() for text in drawn.axes[5].texts] == ["ended at\nt = 2 →"]
    few = stage_grid({"a": stages(6, image), "b": stages(2, image)}, stages=(1, 8))
    assert len(few.axes) == 4  # none of the methods has a stage 8, and no column
    with pytest.raises(InputError, match="keep_images"):
        stage_grid({"a": stages(3)})


def test_wipe_goes_from_one_picture_to_the_other(tmp_path):
    before, after = np.full((20, 30), 0.2, np.float32), np.full((20, 30), 1.0, np.float32)
    wipe = Wipe(before, after, names=("<before>", "after"))  # both over 0.7, the white that they share
    film = wipe.frames(8)
    assert np.allclose(film[0][:, 1:], 1.0) and np.allclose(film[3][:, :-1], 2 / 7)
    assert np.allclose(film[1][:, :8], 2 / 7) and np.allclose(film[1][:, 12:], 1.0)
    wipe.write(tmp_path / "wipe.gif")
    with Image.open(tmp_path / "wipe.gif") as read:
        assert read.size == (30, 20) and read.n_frames == 24  # pyright: ignore[reportAttributeAccessIssue]
    wipe.write(tmp_path / "wipe.html")
    page = (tmp_path / "wipe.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2 and "&lt;before&gt;" in page and "<before>" not in page


def test_wipe_of_two_sizes_is_refused():
    with pytest.raises(InputError, match="one size"):
        Wipe(np.zeros((4, 4)), np.zeros((4, 5)))


def test_explore_shows_each_value_with_the_others_in_the_middle():
    """Also without ipywidgets, which is not installed for the tests."""
    asked = []

    def picture(strength, key):
        asked.append((strength, key))
        return np.full((8, 12), strength * key, np.float32)

    drawn = explore(picture, strength=[0.1, 0.2, 0.4], key=[1, 2], title="Choices")
    drawn_once(drawn)
    assert asked[:5] == [(0.1, 2), (0.2, 2), (0.4, 2), (0.2, 1), (0.2, 2)]
    titles = [axes.get_title(loc="left") for axes in drawn.axes]
    assert titles == ["strength = 0.1", "strength = 0.2", "strength = 0.4", "key = 1", "key = 2", ""]
    with pytest.raises(InputError, match="no value"):
        explore(picture, strength=[])


def test_explore_sliders_make_the_picture_anew(monkeypatch):
    """With a stand-in for ipywidgets: one slider a parameter, and a picture for what they say."""
    sliders, shown = {}, []

    class Slider:
        def __init__(self, options, value, description):
            self.options, self.value = options, value
            sliders[description] = self

        def observe(self, function, name):
            assert name == "value"
            self.changed = function

    image = SimpleNamespace(value=b"")
    stand_in = SimpleNamespace(SelectionSlider=Slider, Image=lambda **_: image, VBox=lambda children: children)
    monkeypatch.setitem(sys.modules, "ipywidgets", stand_in)
    monkeypatch.setattr("IPython.display.display", shown.append)
    explore(lambda grey: np.full((6, 8), grey, np.float32), grey=[0.1, 0.4, 0.8])
    assert sliders["grey"].value == 0.4 and shown == [[sliders["grey"], image]]
    levels = []
    for grey in sliders["grey"].options:
        sliders["grey"].value = grey
        sliders["grey"].changed({})
        with Image.open(io.BytesIO(image.value)) as read:
            levels.append(int(np.asarray(read).mean()))
    assert levels == [32, 128, 255]  # white is that of the middle still: twice its median, as it is plain
