"""`scsr baseline`."""

import functools
import os
import time
from typing import get_args

import pytest

from scsr_opt.baselines import BASELINES, tfi_bicubic
from scsr_opt.camera import read_recording
from scsr_opt.cli import main
from scsr_opt.cli.baseline import Method
from scsr_opt.report import LineProgress, read_picture


def test_every_baseline_has_a_name():
    assert [name.replace("-", "_") for name in get_args(Method)] == list(BASELINES)


def test_the_picture_is_that_of_the_function(scsr, file):
    said = scsr("baseline", file, "--method", "tfi-bicubic", "--scale", "2", "--key", "12", "-o", "a.npz")
    assert said == "a.npz: frame 12 by tfi-bicubic, 80x48.\n"
    assert (read_picture("a.npz") == tfi_bicubic(read_recording(file), scale=2, key=12)).all()


def test_a_slow_method_says_so_off_a_terminal(file, monkeypatch, capsys):
    def slow(*arguments, **options):
        time.sleep(0.5)
        return tfi_bicubic(*arguments, **options)

    monkeypatch.setitem(BASELINES, "tfi_bicubic", slow)
    monkeypatch.setattr("scsr_opt.cli.options.LineProgress", functools.partial(LineProgress, every=0.1))
    assert main(["baseline", file, "--method", "tfi-bicubic", "-o", "a.npz"]) == 0
    assert "scsr: making the picture by tfi-bicubic (" in capsys.readouterr().err


def test_reading_options_count(scsr, file):
    """Half as many spikes for white: everything twice as bright."""
    scsr("baseline", file, "--method", "tfp-bicubic", "--scale", "1", "-o", "a.npz", "-q")
    scsr("baseline", file, "--method", "tfp-bicubic", "--scale", "1", "-o", "b.npz", "-q", "--white-rate", "0.3")
    assert read_picture("b.npz") == pytest.approx(2 * read_picture("a.npz"), rel=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("-o a.bmp", "its ending is '.bmp'"),
        ("-o ramp.npz", "--output ramp.npz is the file that is read"),
        ("-o a.png --scale 0", "--scale is 0"),
        ("-o a.png --key 31", "Key frame 31 is not in ramp"),
        ("-o a.png --method tfp", "--method"),
    ],
)
def test_refuses(scsr, here, file, options, message):
    assert message in scsr("baseline", file, *options.split(), code=2)
    assert os.listdir(here) == ["ramp.npz"]
