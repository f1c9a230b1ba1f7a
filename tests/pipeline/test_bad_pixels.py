"""Bad pixels and white on their way through a reconstruction."""

import numpy as np
import pytest
from skimage import data

from scsr_opt import InputError, Options, reconstruct, reconstruct_sequence
from scsr_opt.calibration.bad_pixels import BadPixels, PixelKind
from scsr_opt.calibration.settings import BadPixelSettings
from scsr_opt.camera import Recording
from scsr_opt.camera.scenes import TurningDisc
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.motion import Motion, Still
from scsr_opt.pipeline.settings import PipelineSettings
from scsr_opt.pipeline.task import Task, task_of
from scsr_opt.report import read_picture

SHAPE, FRAMES, RATE = (24, 32), 40, 0.6
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]]
LIGHT = 0.35 + 0.1 * np.sin(ROWS / 5) * np.cos(COLUMNS / 6)
DEAD, HOT = (8, 9), (15, 20)


def spikes_of(light: np.ndarray) -> np.ndarray:
    charge = np.random.default_rng(0).random(SHAPE) + RATE * light * np.arange(FRAMES + 1)[:, None, None]
    return np.diff(np.floor(charge), axis=0).astype(np.uint8)


SPIKES = spikes_of(LIGHT)
SPIKES[:, *DEAD], SPIKES[:, *HOT] = 0, 1
MASK = np.zeros(SHAPE, bool)
MASK[DEAD] = MASK[HOT] = True
OPTIONS = Options(motion=Motion.none(*SHAPE), strength=0.01, gain=None)


def left_out(task: Task) -> BadPixels:
    assert task.bad is not None
    return task.bad


@pytest.fixture(scope="module")
def solution():
    return reconstruct(SPIKES, scale=2, options=OPTIONS)


def test_reconstruct_finds_bad_pixels_and_says_which(solution):
    assert solution.bad_pixels.kind[DEAD] == PixelKind.DEAD and solution.bad_pixels.kind[HOT] == PixelKind.HOT
    assert solution.diagnostics.bad_pixels == {"given": 0, "dead": 1, "hot": 1, "isolated": 0, "resting": 0}
    report = solution.report()
    assert report.recording["bad_pixels"] == 2
    assert "Bad pixels: 2 are not used: 1 dead, 1 always firing." in report.lines()
    titles = [axes.get_title(loc="left") for axes in solution.plot().axes]
    assert "Motion: none; 2 bad pixels" in titles


def test_reconstruct_uses_a_mask_as_it_is_given(solution):
    given = reconstruct(SPIKES, scale=2, options=OPTIONS, bad_pixels=MASK)
    np.testing.assert_array_equal(given.image, solution.image)
    assert given.diagnostics.bad_pixels == {"given": 2, "dead": 0, "hot": 0, "isolated": 0, "resting": 0}
    one = task_of(SPIKES, 2, None, Options(bad_pixels=np.where(MASK & (COLUMNS == DEAD[1]), True, False)))
    assert left_out(one).mask.sum() == 1 and one.clip.spikes[:, *HOT].all()


def test_reconstruct_searches_for_none_where_told_not_to():
    task = task_of(SPIKES, 2, None, Options(bad_pixels=None))
    assert task.bad is None and task.clip.bad_pixels is None
    known = Recording.from_array(SPIKES, bad_pixels=MASK)
    assert left_out(task_of(known, 2, None, Options(bad_pixels=None))).numbers["given"] == 2
    with pytest.raises(InputError, match="bad_pixels is 'none'; it must be 'auto', None, or a mask"):
        reconstruct(SPIKES, scale=2, bad_pixels="none")


def test_bad_pixels_are_found_by_more_frames_than_the_clip():
    """In 8 frames a pixel without spikes is not remarkable."""
    task = task_of(SPIKES, 2, None, Options(frames=8))
    np.testing.assert_array_equal(left_out(task).mask, MASK)


def test_find_resting_end_of_a_hair_stands_out_without_the_rest(monkeypatch):
    spikes = spikes_of(2 * LIGHT)
    hair = [(10, 12), (11, 13), (12, 14), (13, 15)]
    for row, column in hair:
        spikes[:, row, column] = spikes_of(0.5 * LIGHT)[:, row, column]
    resting = np.zeros(SHAPE, np.uint8)
    resting[tuple(zip(*hair[:3], strict=True))] = PixelKind.RESTING
    moving = Motion.constant((0.1, 0.1), SHAPE)
    task = task_of(spikes, 2, None, Options(motion=moving, bad_pixels=None))
    monkeypatch.setattr("scsr_opt.pipeline.task.resting_pixels", lambda *given, **options: BadPixels(resting))
    found = task.find_resting(None, moving)
    assert [kind for row, column in hair if (kind := found.kind[row, column])] == [PixelKind.RESTING] * 3 + [
        PixelKind.ISOLATED
    ]
    assert found.mask.sum() == 4
    monkeypatch.setattr("scsr_opt.pipeline.task.resting_pixels", lambda *given, **options: BadPixels.none(SHAPE))
    assert not task.find_resting(None, moving).mask.any()


def test_bad_pixels_of_a_crop_are_those_of_the_sensor():
    kinds = BadPixels(np.where(MASK, PixelKind.RESTING, PixelKind.GOOD).astype(np.uint8))
    task = task_of(SPIKES, 2, None, Options(bad_pixels=kinds, crop=(4, 5, 16, 20)))
    np.testing.assert_array_equal(left_out(task).kind, kinds.kind[4:20, 5:25])


def test_sequence_has_one_white_and_one_search():
    solutions = list(
        reconstruct_sequence(SPIKES, [10, 30], scale=2, frames=10, motion=Still(), strength=0.01, gain=None)
    )
    for one in solutions:
        assert one.bad_pixels is not None
        np.testing.assert_array_equal(one.bad_pixels.mask, MASK)
    assert len({one.white for one in solutions}) == 1 and solutions[0].white.level == pytest.approx(0.7, abs=0.05)


def test_save_png_is_up_to_white_and_other_files_absolute(solution, tmp_path):
    level = solution.white.level
    assert solution.white.found and level == pytest.approx(2 * np.median(LIGHT), rel=0.1)  # it is grey all over
    for name, white in (("a.png", level), ("a.tif", 1.0), ("a.npz", 1.0)):
        solution.save(tmp_path / name)
        stored = read_picture(tmp_path / name)
        np.testing.assert_allclose(stored, np.clip(solution.image / white, 0, 1), atol=0.003)
    solution.save(tmp_path / "b.png", white=2.0)
    np.testing.assert_allclose(read_picture(tmp_path / "b.png"), np.clip(solution.image / 2, 0, 1), atol=0.003)
    with pytest.raises(InputError, match="only an 8-bit .png has another"):
        solution.save(tmp_path / "b.tif", white=2.0)


def test_find_resting_rim_of_a_turning_disc_is_not_judged():
    """The rim stays where it is, and its pixels see some of both surfaces all the time."""
    wall, texture = data.grass()[:160, :192] / 255, data.coins()[50:130, 60:140] / 255
    made = simulate(TurningDisc(wall, texture, 0.004), scale=2, frames=101, sensor=Sensor(photons=1000.0), seed=2)

    def found(of: BadPixelSettings) -> int:
        settings = PipelineSettings(bad_pixels=of)
        task = task_of(made.spikes, 2, None, Options(settings=settings, white_rate=made.white_rate))
        frames = task.motion_frames(None)
        return int(task.find_resting(frames, task.estimate_motion(frames)).mask.sum())

    assert found(BadPixelSettings()) <= 1 < 4 < found(BadPixelSettings(border_px=0))
