"""The weights that come with the project."""

import re

import numpy as np
import pytest
from skimage import data
from skimage.metrics import peak_signal_noise_ratio

from learned import load_model
from learned.training import checkpoint, configs
from learned.zoo import CHECKPOINTS, NETWORKS, Network, model
from scsr_opt.baselines import BASELINES
from scsr_opt.camera import simulate
from scsr_opt.camera.scenes import Translation

SHIPPED = sorted(CHECKPOINTS.glob("*.scsr"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_checkpoint_is_what_its_name_says(path):
    found = re.fullmatch(r"([a-z-]+)-x(\d)", path.stem)
    assert found is not None
    name, scale = found[1], int(found[2])
    assert name in NETWORKS and path.stat().st_size < checkpoint.LARGEST
    _, card = checkpoint.load(path)
    assert card.configuration["scale"] == scale
    assert card.steps > 0 and card.hardware and card.data and np.isfinite(card.scores["psnr"])
    assert model(name, scale=scale).name == name
    loaded = load_model(path.stem)
    assert loaded.id == path.stem and loaded.scale == scale and loaded.model.name == name
    assert path.stem in configs.names()  # the configuration that trains it


@pytest.mark.parametrize("shape", [(1, 1), (1, 12), (2, 3)])
def test_spikesr_on_a_sensor_smaller_than_its_reach_keeps_the_light(shape):
    """The zeros beyond the border made single pixels 17 % too dark, single rows 3 %; means of ten phases."""
    light, net = 0.5, model("spikesr-small", scale=2)
    assert isinstance(net, Network)
    phase = np.random.default_rng(0).random((10, 1, *shape))
    charge = np.floor(phase + 0.6 * light * np.arange(61)[:, None, None])
    spikes = np.diff(charge, axis=1).astype(np.uint8)
    means = [net(each, scale=2, white_rate=0.6, record=False).image.mean() for each in spikes]
    assert np.mean(means) == pytest.approx(light, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_network_sees_more_than_playback(path):
    """A picture that it was not trained on, moving by 0.1 pixels per frame: 2 dB at least (measured: 3.6)."""
    name, scale = path.stem.rsplit("-x", 1)
    scale = int(scale)
    size = 48 * scale
    picture = data.coins()[40 : 40 + size, 60 : 60 + size]
    made = simulate(Translation(picture, (0.06 * scale, -0.08 * scale)), scale=scale, seed=4)
    truth = np.clip(made.truth(50), 0, 1)

    def score(image: np.ndarray) -> float:
        inner = (slice(4 * scale, -4 * scale),) * 2
        return float(peak_signal_noise_ratio(truth[inner], np.clip(image, 0, 1)[inner], data_range=1.0))

    solution = model(name, scale=scale)(made.spikes, scale=scale, key=50)
    assert solution.status.usable
    playback = np.asarray(BASELINES["tfp_bicubic"](made.spikes, scale=scale, key=50))
    assert score(solution.image) > score(playback) + 2
