import dataclasses

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from scsr_opt.camera import Recording, tfp
from scsr_opt.errors import InputError
from scsr_opt.pipeline.scene_summary import SceneSummary
from scsr_opt.report import bicubic, compare, detailed_part, figure, scene_figure


def _titles(drawn) -> list[str]:
    return [axes.get_title(loc="left") for axes in drawn.axes if axes.get_title(loc="left")]


def _pixels(drawn) -> np.ndarray:
    canvas = FigureCanvasAgg(drawn)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def test_bicubic_keeps_centres_where_they_are():
    down, right = np.mgrid[0:12, 0:10].astype(np.float32)
    plane = 0.02 * down + 0.03 * right
    large = bicubic(plane, 4)
    y, x = (np.mgrid[0:48, 0:40] - 1.5) / 4
    inner = np.s_[12:-12, 12:-12]
    assert large.shape == (48, 40) and large.dtype == np.float32
    assert large[inner] == pytest.approx(
        (0.02 * y + 0.03 * x)[inner], abs=1e-3
    )  # a shift by half a pixel would be 0.01


def test_the_part_with_detail_is_chosen(scene):
    top, left, tall, wide = detailed_part(scene, scale=1)
    assert top <= 40 and top + tall >= 60 and left <= 100 and left + wide >= 130


def test_of_two_alike_the_one_that_moves_is_chosen(scene):
    both = scene.copy()
    both[40:60, 20:50] = both[40:60, 100:130]
    for columns in (slice(0, 20), slice(20, 40)):
        velocity = np.zeros((2, 24, 40), np.float32)
        velocity[0, :, columns] = 0.3
        _, left, _, wide = detailed_part(both, velocity, scale=4)
        assert (left + wide / 2) // 80 == columns.start // 20


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (16, 16)])
def test_a_part_of_a_small_picture_lies_within_it(size):
    top, left, tall, wide = detailed_part(np.random.default_rng(0).random(size).astype(np.float32), scale=2)
    assert 0 <= top < top + tall <= size[0] and 0 <= left < left + wide <= size[1]


def test_figure_shows_all_that_there_is(solution):
    drawn = figure(solution, truth=solution.image, title="A street")
    assert _titles(drawn) == [
        "Playback (TFP, 21 frames), bicubic ×4",
        "Reconstruction ×4",
        "Truth",
        "Motion",
        "Objective: 12 iterations, converged",
        "Relative residual",
    ]
    assert [text.get_text() for text in drawn.texts] == ["A street"]
    assert np.unique(_pixels(drawn)).size > 50


def test_figure_of_the_best_quality_marks_the_second_solve(solution):
    first = solution.stages[-1].number - 1
    known = dataclasses.replace(solution.diagnostics, quality="best", first_iterations=first)
    drawn = figure(dataclasses.replace(solution, diagnostics=known))
    titles = [axes.get_title(loc="left") for axes in drawn.axes]
    assert any("quality best" in title for title in titles)
    (upper,) = (axes for axes in drawn.axes if axes.get_title(loc="left").startswith("Objective"))
    curve, mark = upper.lines
    assert np.isnan(np.asarray(curve.get_ydata(), float)).nonzero()[0].tolist() == [first]
    assert set(np.asarray(mark.get_xdata())) == {first + 0.5}
    assert [text.get_text() for text in upper.texts] == ["second solve, around\na network's picture"]


def test_figures_show_themselves_in_a_notebook(solution):
    for drawn in (figure(solution), solution.plot(), compare({"one": solution.image})):
        assert drawn._repr_png_().startswith(b"\x89PNG")


def test_plot_is_the_figure_of_the_solution(solution):
    drawn = solution.plot(title="A street", window=5)
    assert _titles(drawn)[:2] == ["Playback (TFP, 5 frames), bicubic ×4", "Reconstruction ×4"]
    np.testing.assert_array_equal(_pixels(drawn), _pixels(figure(solution, title="A street", window=5)))


def test_figure_playback_is_that_of_the_solution_s_key_frame_and_white_rate(solution):
    """Not those of the recording: a solution may be of another frame, and of another level of white."""
    here = dataclasses.replace(solution, key=3, white_rate=0.3)
    drawn = figure(here, window=5)
    expected = bicubic(tfp(solution.recording.spikes[1:6], 2, window=5, white_rate=0.3), 4)
    np.testing.assert_allclose(np.asarray(drawn.axes[0].images[0].get_array()), expected, atol=1e-6)


def test_figure_has_a_map_of_the_frames_that_were_used_where_they_differ(solution):
    used = np.full((24, 40), 50.0, np.float32)
    used[:, :20] = 20.0
    found = dataclasses.replace(solution.diagnostics, used_frames=(20.0, 35.0, 50.0))
    drawn = figure(dataclasses.replace(solution, used_frames=used, diagnostics=found))
    title = "Frames used before and after the key frame: 35 (20 to 50)"
    (axes,) = (axes for axes in drawn.axes if axes.get_title(loc="left") == title)
    np.testing.assert_array_equal(np.asarray(axes.images[0].get_array()), used)
    same = dataclasses.replace(solution.diagnostics, used_frames=(48.0, 50.0, 50.0))
    alike = figure(dataclasses.replace(solution, used_frames=used, diagnostics=same))
    assert not any(title.startswith("Frames used") for title in _titles(alike))


def test_figure_without_stages_or_motion(solution):
    bare = dataclasses.replace(solution, stages=(), motion=None, key=0)
    assert _titles(figure(bare))[2:] == ["Motion: none", "Convergence: not recorded"]


def test_nothing_is_drawn_outside_the_page(solution):
    drawn = figure(solution, title="A street")
    page = drawn.bbox
    drawn.draw_without_rendering()
    for axes in drawn.axes:
        box = axes.get_tightbbox()
        assert box is not None and box.x0 >= page.x0 and box.x1 <= page.x1 and box.y0 >= page.y0 and box.y1 <= page.y1


def test_a_narrow_picture_fits_on_a_page(solution):
    recording = Recording.from_array(np.ones((5, 100, 1), np.uint8))
    image = np.full((400, 4), 0.5, np.float32)
    drawn = figure(dataclasses.replace(solution, image=image, motion=None, recording=recording, key=2))
    assert drawn.get_size_inches()[1] < 30
    drawn.draw_without_rendering()
    first, second = (axes.get_tightbbox() for axes in (drawn.axes[0], drawn.axes[2]))
    assert first is not None and second is not None and first.x1 < second.x0  # with their titles


def test_figures_leave_pyplot_alone(solution):
    figure(solution)
    assert plt.get_fignums() == []


def test_one_grey_scale_for_all_pictures(scene):
    drawn = compare({"dark": scene * 0.1, "bright": scene})
    limits = {axes.images[0].get_clim() for axes in drawn.axes}
    assert len(limits) == 1 and limits.pop()[1] > 0.4


def test_the_key_frame_has_to_be_in_the_recording(solution):
    with pytest.raises(InputError, match="Key frame 99"):
        figure(dataclasses.replace(solution, key=99))


@pytest.mark.parametrize("title", ["a $x$ b", "$\\frac{x$", "two\nlines", "a\udcff", "$$", "\\", "電影"])
@pytest.mark.filterwarnings("ignore:Glyph")
def test_titles_are_names_of_files_and_no_formulas(solution, title):
    """Drawn, as they would fail only then."""
    scene = SceneSummary(np.array([[0, 2]]), np.array([[31, 1]]), np.ones((1, 2), np.float32), "2 layers", 5, 2)
    for drawn in (
        figure(solution, title=title),
        scene_figure(dataclasses.replace(solution, scene=scene), title=title),
    ):
        assert _pixels(drawn).shape[2] == 4
        texts = [text.get_text() for text in (*drawn.texts, *(axes.title for axes in drawn.axes))]
        texts += _titles(drawn)
        assert " ".join(title.split()).replace("\udcff", "\\udcff") in texts


def test_figure_of_a_crop_shows_the_playback_of_the_crop(solution):
    cut = dataclasses.replace(solution, image=solution.image[:32, :64], crop=(3, 5, 8, 16), motion=None)
    part = dataclasses.replace(cut, recording=cut.part, crop=None)
    np.testing.assert_array_equal(_pixels(figure(cut)), _pixels(figure(part)))
