"""`scsr train`."""

import os
import subprocess
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from learned.training import checkpoint, registry
from learned.training.registry import Trainable

CONFIG = """
model = "tiny"
scale = 2
steps = 3
frames = 5
patch = 16
batch = 1
workers = 0
scenes = ["static"]
validate_every = 2
save_every = 2
"""


@pytest.fixture
def config(here, monkeypatch) -> str:
    """A network that multiplies the enlarged firing rate by one number."""

    def make(scale, network):
        def picture(model, spikes, white_rate):
            rate = jnp.mean(spikes.astype(jnp.float32), axis=0) / white_rate
            return model.weight[0, 0] * jnp.repeat(jnp.repeat(rate, scale, 0), scale, 1)

        def loss(model, example):
            loss = jnp.mean(jnp.abs(picture(model, example.spikes, example.white_rate) - example.truth))
            return loss * network.get("loss", 1.0)

        return Trainable(lambda key: eqx.nn.Linear(1, 1, key=key), loss, picture)

    monkeypatch.setitem(registry.MODELS, "tiny", make)
    (here / "plan.toml").write_text(CONFIG)
    return "plan.toml"


def test_train_and_go_on(scsr, here, config):
    said = scsr("train", config)
    assert said.splitlines()[0].startswith("3 steps, 0 of them skipped") and said.splitlines()[-1] == "run-plan"
    assert sorted(os.listdir("run-plan")) == [
        "best.scsr", "curves.png", "last.scsr", "loss.csv", "samples", "state", "validation.csv",
    ]  # fmt: skip
    assert sorted(os.listdir("run-plan/samples")) == ["000002.png", "000003.png"]
    # Five rows of three tiles of 32 pixels with a frame of 2 around each.
    assert np.asarray(Image.open("run-plan/samples/000003.png")).shape == (5 * 36, 3 * 36)
    rows = (here / "run-plan" / "loss.csv").read_text().splitlines()
    assert rows[0] == "step,loss,rate" and [row.split(",")[0] for row in rows[1:]] == ["1", "2", "3"]
    assert scsr("train", config, "--steps", "5", "-o", "run-plan", "--quiet") == ""
    assert checkpoint.load("run-plan/last.scsr")[1].steps == 5


def test_train_on_pictures(scsr, here, config):
    (here / "mine").mkdir()
    Image.fromarray(np.arange(48 * 48, dtype=np.uint16).reshape(48, 48).astype(np.uint8)).save("mine/ramp.png")
    scsr("train", config, "--pictures", "mine", "--output", "made/here", "--steps", "1")
    assert "mine" in checkpoint.load("made/here/last.scsr")[1].data


def test_train_that_fails(scsr, here, config):
    (here / config).write_text(CONFIG + "[network]\nloss = inf\n")
    assert "Training failed: too many steps in a row" in scsr("train", config, "--steps", "40", code=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing"], "There is no configuration nothing: give the path of a .toml file, or one of compensation-x2"),
        (["plan.toml", "--steps", "0"], "steps is 0, but it must be a whole number of at least 1"),
        (["plan.toml", "--pictures", "nowhere"], "nowhere is not a folder"),
        (["plan.toml", "-o", "plan.toml"], "The folder plan.toml cannot be made"),
        ([], "scsr train needs CONFIG, which is missing"),
    ],
)
def test_train_refuses(scsr, here, config, arguments, message):
    assert message in scsr("train", *arguments, code=2)
    assert os.listdir(here) == ["plan.toml"]


def test_the_command_line_does_not_wait_for_the_networks():
    program = "import sys, learned.cli.train, scsr_opt.cli; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
