"""Training of the network that tells gains at rest."""

import json

import jax
import jax.numpy as jnp
import numpy as np

from learned.training.gain import GainTraining, patch, train
from scsr_opt.calibration.gain_network import GainNetwork


def test_patches_are_what_the_sensor_made_of_pictures():
    picture = np.random.default_rng(0).uniform(0.2, 0.9, (130, 150)).astype(np.float32)
    generator = np.random.default_rng(1)
    for spread in (0.0, 0.05, 0.05, 0.05):
        rate, noise, gain = patch([picture], generator, GainTraining(), spread)
        assert rate.shape == noise.shape == gain.shape == (1, 56, 56)
        assert abs(gain.std() - spread) < 0.003 and (rate >= 0).all() and (noise >= 0).all()


def test_training_lowers_the_error_and_writes_a_network_with_its_card(tmp_path):
    run, lines = GainTraining(channels=8, layers=3, held_out=4, report_every=10), list[str]()
    trained = train(tmp_path / "gain.npz", folder=None, steps=40, run=run, report=lines.append)
    card = json.loads((tmp_path / "gain.json").read_text())
    assert card["steps"] == 40 and set(card["missed"]) == {"0.0", "0.05"}
    first, last = (float(line.split("loss ")[1].split(";")[0]) for line in (lines[0], lines[-1]))
    assert last < 0.8 * first  # half of it, as measured
    again = GainNetwork.load(tmp_path / "gain.npz")
    for one, other in zip(jax.tree.leaves(trained), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(jnp.asarray(one), jnp.asarray(other))
