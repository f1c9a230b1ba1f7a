"""What is compiled is kept in the user's cache folder, unless JAX was told otherwise."""

import os

import pytest

from scsr_opt.cli.compiled import keep_compiled

DIRECTORY = "JAX_COMPILATION_CACHE_DIR"


@pytest.fixture(autouse=True)
def environment(monkeypatch, tmp_path):
    """Without JAX's variables before the test, and as it was after it."""
    for name in (DIRECTORY, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_the_users_cache_folder(tmp_path):
    keep_compiled()
    assert os.environ[DIRECTORY].startswith(str(tmp_path / "scsr-opt"))
    assert os.path.isdir(os.environ[DIRECTORY])


def test_jax_was_told_another_folder(monkeypatch):
    monkeypatch.setenv(DIRECTORY, "elsewhere")
    keep_compiled()
    assert os.environ[DIRECTORY] == "elsewhere"


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "scsr-opt").write_text("a file is in the way")
    keep_compiled()
    assert DIRECTORY not in os.environ
