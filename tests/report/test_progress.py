import time

import pytest

from scsr_opt.progress import NoProgress, Progress
from scsr_opt.report import RichProgress


def test_both_are_progress():
    assert isinstance(NoProgress(), Progress) and isinstance(RichProgress(), Progress)


@pytest.fixture
def screen(tmp_path, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # makes rich take the file for a terminal
    with (tmp_path / "screen").open("w+", encoding="utf-8") as file:
        yield file


def test_short_work_shows_nothing(screen):
    progress = RichProgress(delay=5.0, file=screen)
    progress.start(3, "Working")
    progress.advance(3)
    progress.finish()
    screen.seek(0)
    assert screen.read() == ""


def test_long_work_is_shown_even_before_its_first_step(screen):
    progress = RichProgress(delay=0.01, file=screen)
    progress.start(4, "Compiling")
    until = time.monotonic() + 10
    while progress._bar is None and time.monotonic() < until:
        time.sleep(0.01)
    progress.advance(1)
    progress.advance(2)
    assert progress._bar is not None and progress._bar.tasks[0].completed == 3
    progress.start(None, "Solving")  # the next part ends the one before
    assert progress._bar is None
    progress.finish()
    progress.finish()
    screen.seek(0)
    shown = screen.read()
    assert "Compiling" in shown and "75%" in shown
