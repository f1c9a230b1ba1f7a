"""Programs that are kept on disk: found again by the next process, bounded, and harmless where they are damaged."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

import scsr_opt
from scsr_opt._kernels import kept
from scsr_opt.cli import main

SCRIPT = """
import warnings
warnings.simplefilter("always")
import jax, jax.monitoring, numpy as np
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event) if event.endswith("cache_hits") else None)
from scsr_opt.priors import TotalVariation
prior, picture = TotalVariation(), np.arange(20, dtype=np.float32).reshape(4, 5) ** 2
image, _ = prior.prox(picture, 0.1, prior.initial_state(picture))
print(float(image.sum()), len(hits), jax.config.jax_compilation_cache_dir)
"""


def run(home: Path, **environment: str) -> tuple[str, int, str]:
    """(value, programs read from disk, folder) of a process that computes a proximal step."""
    own = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XDG_"))}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        env={**own, "XDG_CACHE_HOME": str(home), **environment},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    value, hits, folder = done.stdout.split()
    return value, int(hits), folder


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory) -> tuple[Path, str, Path]:
    """(home, value, folder) of a process that found nothing, and a copy of the folder beside the home."""
    home = tmp_path_factory.mktemp("home")
    value, hits, folder = run(home)
    assert (hits, Path(folder).parent) == (0, home / "scsr-opt")
    assert Path(folder).stat().st_mode & 0o077 == 0  # who may write there may run code
    shutil.copytree(folder, home / "copy")
    return home, value, Path(folder)


@pytest.fixture
def compiled(compiled_once) -> tuple[Path, str, Path]:
    """(home, value, folder) as that process left them; programs are found again in their own place only."""
    home, value, folder = compiled_once
    shutil.rmtree(folder)
    shutil.copytree(home / "copy", folder)
    return home, value, folder


@pytest.fixture
def entries(tmp_path, monkeypatch):
    """Makes entries of 1,000 bytes, by name and age in seconds."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = kept.programs_folder()
    folder.mkdir(parents=True)

    def make(**ages: float) -> Path:
        for name, age in ages.items():
            path = folder / f"{name}-cache"
            path.write_bytes(kept._ZSTANDARD + bytes(996))
            os.utime(path, (time.time() - age, time.time() - age))
        return folder

    return make


def names(folder: Path) -> list[str]:
    return sorted(path.name.removesuffix("-cache") for path in folder.glob("*-cache"))


def test_second_process_reads_what_the_first_compiled(compiled):
    home, value, _ = compiled
    again, hits, _ = run(home)
    assert again == value
    assert hits >= 1


def test_truncated_entries_are_compiled_anew_and_replaced(compiled):
    home, value, folder = compiled
    for path in folder.glob("*-cache"):
        path.write_bytes(path.read_bytes()[:-20])
        os.utime(path, (time.time() - 3600, time.time() - 3600))
    os.remove(folder / ".checked")
    assert run(home)[:2] == (value, 0)
    assert run(home)[1] >= 1


def test_truncated_entries_that_are_too_young_to_judge_do_no_harm(compiled):
    home, value, folder = compiled
    for path in folder.glob("*-cache"):
        path.write_bytes(path.read_bytes()[:-20])
    assert run(home)[:2] == (value, 0)


def test_folder_that_cannot_be_made_keeps_nothing(tmp_path):
    (tmp_path / "scsr-opt").write_text("a file is in the way")
    assert run(tmp_path)[2] == "None"


@pytest.mark.parametrize(
    ("environment", "folder"),
    [({"JAX_ENABLE_COMPILATION_CACHE": "0"}, "None"), ({"JAX_COMPILATION_CACHE_DIR": "mine"}, "mine")],
)
def test_jax_settings_come_first(tmp_path, environment, folder):
    mine = {name: str(tmp_path / value) if value == "mine" else value for name, value in environment.items()}
    assert run(tmp_path, **mine)[2] == (str(tmp_path / folder) if folder == "mine" else folder)
    assert not (tmp_path / "scsr-opt").exists()


def test_tidy_deletes_the_longest_unused_beyond_the_bound(entries):
    folder = entries(new=100, old=3000, older=4000, between=2000)
    kept.tidy(most=2500)
    assert names(folder) == ["between", "new"]


def test_tidy_looks_at_an_entry_once(entries, monkeypatch):
    entries(a=100, b=200)
    looked = []
    monkeypatch.setattr(kept, "_is_whole", lambda path: not looked.append(path))
    kept.tidy()
    kept.tidy()
    assert len(looked) == 2


def test_cache_command_shows_and_clears(entries, capsys):
    folder = entries(a=1, b=2)
    assert main(["cache"]) == 0
    assert "2 programs, 0.0 MB; at most 524 MB" in capsys.readouterr().out
    assert main(["cache", "--clear"]) == 0
    assert "deleted 2 programs" in capsys.readouterr().out
    assert names(folder) == []


def test_cache_command_says_where_jax_keeps_programs(entries, monkeypatch, capsys):
    entries(a=1)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "elsewhere")
    assert main(["cache"]) == 0
    assert "programs are kept in elsewhere now" in capsys.readouterr().out


@pytest.mark.parametrize(
    "wrong",
    [
        ["--size", "99999x99999"],
        ["--size", "40"],
        ["--size", "8x8", "--scale", "0"],
        ["--size", "8x8", "--frames", "1"],
    ],
)
def test_warm_command_refuses(wrong, capsys):
    assert main(["warm", *wrong]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_warm_command_solves_for_recordings_of_the_size(monkeypatch, capsys):
    solved = []
    monkeypatch.setattr(scsr_opt, "reconstruct", lambda recording, **options: solved.append((recording, options)))
    assert main(["warm", "--size", "16x12", "--scale", "2", "--frames", "21"]) == 0
    assert "programs" in capsys.readouterr().out
    assert [(r.width, r.height, r.frames) for r, _ in solved] == [(16, 12, 21)] * 3
    assert all(options == {"scale": 2, "frames": 21} for _, options in solved)
