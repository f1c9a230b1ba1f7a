"""Odd names that are good, and URLs: every command takes them."""

import os
import shutil
from pathlib import Path

import fsspec
import pytest

from scsr_opt.cli import main

GOOD = [
    "two  words",
    " a",
    "a:b",
    "C:",
    "s3:",
    "Straße 電影",
    "new\nline",
    "-dash",
    "a,b",
    "[x]*?",
    "100%",
    "none",
    "x" * 240,
]


@pytest.mark.usefixtures("quickly")
@pytest.mark.parametrize("name", GOOD)
def test_odd_names_work(capsys, name):
    """The name is that of the recording, of the store, of the files that are made from it, and of their folder."""
    folder = f"./{name}"
    os.mkdir(folder)
    shutil.copy("ramp.npz", f"{folder}/{name}.npz")
    given = ["--every", "10", "--scale", "1", "--quiet"]
    for command in (
        ["info", f"{folder}/{name}.npz", "--quiet"],
        ["play", f"{folder}/{name}.npz", "-o", f"{folder}/{name}.png", "--quiet"],
        ["sequence", f"{folder}/{name}.npz", "-o", f"{folder}/{name}.zarr", *given],
        ["export", f"{folder}/{name}.zarr", "-o", f"{folder}/{name}.gif", "--quiet"],
    ):
        assert main(command) == 0
        said = capsys.readouterr()
        assert said.out == said.err == ""
    assert sorted(os.listdir(folder)) == sorted(f"{name}.{end}" for end in ("npz", "png", "zarr", "gif"))


@pytest.mark.usefixtures("quickly")
def test_recordings_by_url_work(capsys):
    fsspec.filesystem("memory").pipe_file("/two words.npz", Path("ramp.npz").read_bytes())
    fsspec.filesystem("memory").pipe_file("/ramp_40x24.dat", Path("ramp_40x24.dat").read_bytes())
    assert main(["info", "memory://two words.npz"]) == 0
    assert capsys.readouterr().out.startswith("memory://two words.npz\n")
    for command in (
        ["play", "memory://two words.npz"],
        ["play", f"file://{os.getcwd()}/ramp.npy", "-o", "new.npz"],
        ["sequence", "memory://ramp_40x24.dat", "-o", "new.zarr", "--every", "10", "--scale", "1"],
        ["export", "new.zarr", "-o", "new.npy"],
    ):
        assert main([*command, "--quiet"]) == 0
        assert capsys.readouterr().err == ""
    assert {"two words_tfp.png", "new.npz", "new.zarr", "new.npy"} <= set(os.listdir())
    assert not [name for name in os.listdir() if ":" in name]
