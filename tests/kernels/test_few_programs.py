"""How many programs a first picture compiles, and a second one: counted, as no time is the same on two machines."""

import numpy as np
import pytest

from scsr_opt import reconstruct
from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.camera.simulator import simulate

pytestmark = pytest.mark.usefixtures("programs_stay")

MOST = 22
"""Programs of a first picture, at most. Each takes from a tenth of a second to two to compile."""


# Sizes of sensor that no other test has.
@pytest.mark.parametrize("size, velocity", [((29, 37), (0.0, 0.0)), ((31, 37), (0.12, -0.2))])
def test_reconstruct_compiles_few_programs_and_none_for_another_recording_of_the_size(heard, size, velocity):
    picture = np.random.default_rng(5).random([2 * length for length in size])
    scene = Translation(picture, velocity) if any(velocity) else Static(picture)
    heard.clear()
    reconstruct(simulate(scene, scale=2, seed=1).spikes, scale=2)
    assert 0 < len(heard) <= MOST, heard
    heard.clear()
    reconstruct(simulate(scene, scale=2, seed=2).spikes, scale=2)
    assert not heard
