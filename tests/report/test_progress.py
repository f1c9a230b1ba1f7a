import re
import time

import pytest

from scsr_opt.progress import NoProgress, Progress
from scsr_opt.report import LineProgress, RichProgress
from scsr_opt.report.progress import speed


def test_all_are_progress():
    assert all(isinstance(one, Progress) for one in (NoProgress(), RichProgress(), LineProgress()))


@pytest.fixture
def log(tmp_path):
    with (tmp_path / "log").open("w+", encoding="utf-8") as file:
        yield file


def lines_of(log) -> list[str]:
    with open(log.name, encoding="utf-8") as file:
        return file.read().splitlines()


def test_lines_appear_without_a_step_and_count_through_parts(log):
    progress = LineProgress(every=0.05, file=log)
    progress.start(None, "Compiling")
    progress.start(200, "Solving")
    progress.advance(40)
    until = time.monotonic() + 10
    while len(lines_of(log)) < 2 and time.monotonic() < until:
        time.sleep(0.01)
    progress.finish()
    time.sleep(0.1)
    lines = lines_of(log)
    assert any(re.match(r"scsr: solving: 40 of 200, [\d.e+]+ per second, \d+ s left \(", line) for line in lines)
    time.sleep(0.1)
    assert lines_of(log) == lines  # nothing after the end


def test_lines_count_where_nobody_knows_how_many_there_are(log):
    progress = LineProgress(every=0.05, file=log)
    progress.start(None, "Solving")
    progress.advance(4)
    until = time.monotonic() + 10
    while not lines_of(log) and time.monotonic() < until:
        time.sleep(0.01)
    progress.finish()
    assert re.fullmatch(r"scsr: solving: 4 done \(\d+ s\)", lines_of(log)[0])


def test_short_work_shows_no_line(log):
    progress = LineProgress(every=30.0, file=log)
    progress.start(2, "Solving")
    progress.advance(2)
    progress.finish()
    assert not lines_of(log)


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


@pytest.mark.parametrize(
    ("done", "total", "seconds", "words"),
    [
        (0, 10, 5.0, ""),
        (10, 10, 5.0, ""),
        (3, None, 5.0, ""),
        (20, 60, 10.0, "2 per second, 20 s left"),
        (2, 10, 9.0, "4.5 s each"),  # too few to foretell the rest
        (6, 10, 27.0, "4.5 s each, 18 s left"),
        (6, 1000, 27.0, "4.5 s each, 75 min left"),
        (6, 10_000, 27.0, "4.5 s each, 12 h left"),
    ],
)
def test_speed_is_of_what_was_done_so_far(done, total, seconds, words):
    assert speed(done, total, seconds) == words
