"""Networks that unroll the iteration of `scsr_opt` (paper, Eq. 5) up to SpikeSR-Net (Eq. 6-14).

`load_model("spikesr-small-x4")(recording, key=100)` is the door; `learned.zoo` lists all models. The learned ones are
functions of this package as well, from `spikes`, (frames, rows, columns) of 0 and 1 or a `Recording`, to a `Solution`.
Nothing is imported before one is called.
"""

import functools
from typing import Any


def load_model(model_id: str) -> Any:
    """The model of an id such as `spikesr-small-x4` (`learned.zoo.load_model`)."""
    from learned.zoo import load_model

    return load_model(model_id)


def ridge(spikes: Any, *, scale: int, key: int | None = None, white_rate: Any = None) -> Any:
    """Eq. 4 with the convex `scsr_opt.priors.RidgeRegulariser` as its prior."""
    return _rung("ridge", scale)(spikes, scale=scale, key=key, white_rate=white_rate)


def ridge_centred(spikes: Any, *, scale: int, key: int | None = None, white_rate: Any = None) -> Any:
    """`ridge`, and once more about what `learned.networks.restoration.RestorationNet` makes of that solution."""
    return _rung("ridge-centred", scale)(spikes, scale=scale, key=key, white_rate=white_rate)


def unrolled(spikes: Any, *, scale: int, key: int | None = None, white_rate: Any = None) -> Any:
    """`learned.networks.unrolled_ista.UnrolledISTA`."""
    return _picture("unrolled", spikes, scale=scale, key=key, white_rate=white_rate)


def unrolled_pase(spikes: Any, *, scale: int, key: int | None = None, white_rate: Any = None) -> Any:
    """`learned.networks.unrolled_ista_pase.UnrolledPASE`."""
    return _picture("unrolled-pase", spikes, scale=scale, key=key, white_rate=white_rate)


def spikesr_small(spikes: Any, *, scale: int, key: int | None = None, white_rate: Any = None) -> Any:
    """`learned.networks.spikesr.SpikeSRNet`, small."""
    return _picture("spikesr-small", spikes, scale=scale, key=key, white_rate=white_rate)


def spikesr_full(spikes: Any, *, scale: int, key: int | None = None, white_rate: Any = None) -> Any:
    """`learned.networks.spikesr.SpikeSRNet`, about as large as the paper's."""
    return _picture("spikesr-full", spikes, scale=scale, key=key, white_rate=white_rate)


def compare_stages(*given: Any, **options: Any) -> Any:
    """`learned.evaluation.compare.compare_stages`: optimizers and networks laid side by side, stage by stage."""
    from learned.evaluation.compare import compare_stages

    return compare_stages(*given, **options)


def _picture(name: str, spikes: Any, *, scale: int, **given: Any) -> Any:
    """Without a record of the network's stages, which takes time of its own."""
    return _rung(name, scale)(spikes, scale=scale, record=False, **given)


@functools.cache
def _rung(name: str, scale: int) -> Any:
    """A rung whose weights are read once, however often it is called."""
    from learned.zoo import model

    return model(name, scale)
