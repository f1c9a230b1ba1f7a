"""Fixtures that the tests of several networks have in common."""

import equinox as eqx
import jax
import optax
import pytest
from skimage import data

from scsr_opt.camera import Recording, Sensor, simulate
from scsr_opt.camera.scenes import Static


@pytest.fixture(scope="session")
def recording() -> Recording:
    """A scene at rest: exposures need no correction, so that f is one quadratic."""
    made = simulate(Static(data.camera()[90:130, 150:198]), scale=2, frames=41, sensor=Sensor(photons=1000.0), seed=3)
    return Recording.from_array(made.spikes)


@pytest.fixture
def overfitted():
    """(net, loss and its slopes as a function of the net, steps) → the losses on the way."""

    def train(net, loss_and_slopes, steps):
        optimiser = optax.adam(1e-2)

        @eqx.filter_jit
        def step(net, state):
            loss, slopes = loss_and_slopes(net)
            with jax.numpy_dtype_promotion("standard"):  # optax counts its steps in integers
                updates, state = optimiser.update(slopes, state)
            return eqx.apply_updates(net, updates), state, loss

        state, losses = optimiser.init(eqx.filter(net, eqx.is_inexact_array)), []
        for _ in range(steps):
            net, state, loss = step(net, state)
            losses.append(float(loss))
        return losses

    return train
