"""`scsr compare`."""

import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from learned import zoo
from learned.evaluation import compare
from learned.evaluation.stage_report import Comparison, ModelStages, StageMeasures
from learned.networks.unrolled_ista import UnrolledConfig, UnrolledISTA
from learned.training import checkpoint
from scsr_opt.report import write_picture
from scsr_opt.solvers import Status

UNROLLED = {"stages": 2, "boundaries": (10,), "proximal": False}
FILES = ["stages.txt", "stages.json", "stages.png"]


@pytest.fixture
def net(here) -> str:
    """Two steps of steepest descent."""
    net = UnrolledISTA(UnrolledConfig(2, **UNROLLED), key=jax.random.key(0))
    checkpoint.save("plain.scsr", net, checkpoint.Card("unrolled", {"scale": 2, "network": UNROLLED}, "", 0, "", {}))
    return "plain.scsr"


@pytest.fixture
def asked(monkeypatch) -> list[dict]:
    """Puts a quick stand-in in the place of `compare_stages`; returns what it was called with."""
    calls: list[dict] = []

    def stand_in(recording, chosen, *, scale, key, truth, strength, costs, progress):
        calls.append(
            {"strength": strength, "models": [one.name for one in chosen], "key": key, "truth": truth, "costs": costs}
        )
        progress.start(1, "comparing")
        progress.finish()
        image = np.full((scale * recording.height, scale * recording.width), 0.5, np.float32)
        stage = StageMeasures(1, 2.0, *[1.0] * 12)
        rows = tuple(ModelStages(one.name, Status.converged, None, (stage,), {1: (image, image)}) for one in chosen)
        return Comparison(recording, scale, key, 31, 0.1, image, 2.0, Status.converged, 9, truth, rows, ())

    monkeypatch.setattr(compare, "compare_stages", stand_in)
    return calls


def test_compare_writes_table_figure_and_numbers(scsr, here, file, net, asked):
    write_picture("right.npz", np.full((48, 80), 0.5, np.float32))
    said = scsr(
        "compare", file, "--models", f"fista-huber, {net},", "--scale", "2", "--output", "seen", "--key", "12",
        "--truth", "right.npz", "--strength", "2e-3", "--no-costs",
    )  # fmt: skip
    assert asked[0]["models"] == ["fista-huber", net] and asked[0]["key"] == 12 and asked[0]["costs"] is False
    assert asked[0]["truth"].shape == (48, 80) and asked[0]["strength"] == 2e-3
    assert sorted(os.listdir("seen")) == sorted(FILES)
    table = (here / "seen" / "stages.txt").read_text()
    assert said.startswith(table) and said.splitlines()[-3:] == [f"seen/{name}" for name in FILES]
    assert "key frame 12 -> 80x48 (x2)" in table
    told = json.loads((here / "seen" / "stages.json").read_text())
    assert [row["name"] for row in told["models"]] == ["fista-huber", net]

    (here / "seen" / "stages.txt").write_text("the old one")
    refused = scsr("compare", file, "--models", net, "--scale", "2", "-o", "seen", code=2)
    assert "--output seen holds stages.txt already: give --overwrite, or another folder" in refused
    assert scsr("compare", file, "--models", net, "--scale", "2", "-o", "seen", "-q", "--overwrite") == ""
    assert "plain.scsr: 1 stage" in (here / "seen" / "stages.txt").read_text()
    assert asked[1]["truth"] is asked[1]["strength"] is None and asked[1]["key"] == 15 and asked[1]["costs"] is True


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--models", "magic"], "There is no model 'magic': take one of ista-tv"),
        (["--models", "spikesr-full"], "There are no weights of spikesr-full for scale 2"),
        (["--models", " , "], "--models names no model"),
        (["--models", "ridge.scsr"], "The checkpoint ridge.scsr cannot be read: no such file"),
        (["--models", "ridge", "--scale", "0"], "--scale is 0"),
        (["--models", "ridge", "--strength", "-1"], "--strength is -1"),
        (["--models", "ridge", "--key", "31"], "Key frame 31 is not in ramp"),
        (["--models", "ridge", "--truth", "small.npz"], "The truth is float32 of shape (3, 4)"),
        (["--models", "ridge", "--truth", "missing.png"], "missing.png"),
        (["--models", "ridge", "--output", "ramp.npz"], "--output ramp.npz is a file; name a folder"),
        (["--models", "ridge", "--output", "no/where"], "the folder no does not exist"),
        ([], "scsr compare needs --models"),
    ],
)
def test_compare_refuses_before_it_starts(scsr, here, file, monkeypatch, options, message):
    monkeypatch.setattr(compare, "reference_problem", lambda *_, **__: pytest.fail("it has begun to work"))
    monkeypatch.setattr(zoo, "CHECKPOINTS", here)
    write_picture("small.npz", np.zeros((3, 4), np.float32))
    given = dict(zip(options[::2], options[1::2], strict=True))
    arguments = {"--scale": "2", "--output": "seen", **given}
    assert message in scsr("compare", file, *(part for pair in arguments.items() for part in pair), code=2)
    assert sorted(os.listdir(here)) == ["ramp.npz", "small.npz"]


def test_compare_does_not_replace_what_it_reads(scsr, here, file):
    os.mkdir("seen")
    write_picture("seen/truth.png", np.zeros((48, 80), np.float32))
    os.rename("seen/truth.png", "seen/stages.png")
    said = scsr("compare", file, "--models", "ridge", "--output", "seen", "--truth", "seen/stages.png", code=2)
    assert "seen/stages.png is a file that is read: give --output another folder" in said and os.listdir("seen") == [
        "stages.png"
    ]


def test_the_command_line_does_not_wait_for_the_networks():
    program = "import sys, learned.cli.compare, scsr_opt.cli; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
