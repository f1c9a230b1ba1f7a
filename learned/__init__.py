"""Networks that unroll the iteration of `scsr_opt` (paper, Eq. 5) up to SpikeSR-Net (Eq. 6-14).

`load_model("spikesr-small-x4")(recording, key=100)` gives a `Solution`; `learned.zoo` lists all models. Models with
learned parts are also functions of this package: `learned.ridge_centred(spikes, scale=4, key=100, white_rate=0.6)` of
`spikes` (frames, rows, columns) of 0 and 1 or a `Recording`. Nothing is imported before one is called.
"""

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, SupportsFloat, SupportsIndex

if TYPE_CHECKING:
    from learned.evaluation.stage_report import Comparison
    from learned.zoo import LoadedModel, Model
    from scsr_opt.progress import Progress


def load_model(model_id: str) -> Any:
    """The model of an id such as `spikesr-small-x4`, to make pictures with (`learned.zoo.load_model`)."""
    from learned.zoo import load_model

    return load_model(model_id)


def compare_stages(
    spikes: Any,
    models: "Sequence[str | Model | LoadedModel]",
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    truth: Any = None,
    white_rate: SupportsFloat | None = None,
    gain: Any = None,
    strength: SupportsFloat | None = None,
    costs: bool = True,
    progress: "Progress | None" = None,
) -> "Comparison":
    """Optimizers and networks side by side, stage by stage, on one moment of a recording.

        recording = scsr_opt.camera.read_recording("coins.npz")
        truth = scsr_opt.report.read_picture("truth.tif")  # intensity, 1 = white; or None
        compared = learned.compare_stages(recording, ["fista-huber", "unrolled"], scale=2, truth=truth)
        print(compared.table())
        compared.write("compared")  # a folder with stages.txt, stages.json and stages.png

    `learned.evaluation.compare` says what the arguments are and what is measured; `costs=False` measures no seconds and
    operations, and takes less time.

    **Raises:** `InputError` if an argument cannot be used, or the recording holds no usable sample.
    """
    from learned.evaluation.compare import compare_stages

    return compare_stages(
        spikes,
        models,
        scale=scale,
        key=key,
        truth=truth,
        white_rate=white_rate,
        gain=gain,
        strength=strength,
        costs=costs,
        progress=progress,
    )


@functools.cache
def _model(name: str, scale: int) -> Any:
    """A model whose weights are read once, however often it is called."""
    from learned.zoo import model

    return model(name, scale)


def _function_of(name: str, description: str, **options: Any) -> Callable[..., Any]:
    def picture(spikes: Any, *, scale: int, key: int | None = None, white_rate: Any = None) -> Any:
        return _model(name, scale)(spikes, scale=scale, key=key, white_rate=white_rate, **options)

    picture.__name__ = picture.__qualname__ = name.replace("-", "_")
    picture.__doc__ = description
    return picture


ridge = _function_of("ridge", "Eq. 4 with the convex `scsr_opt.priors.RidgeRegulariser` as its prior.")
ridge_centred = _function_of("ridge-centred", "`ridge` twice, the second time centred at a network's restoration.")
# The stages of networks are not recorded here, which takes longer than the network itself.
unrolled = _function_of("unrolled", "`learned.networks.unrolled_ista.UnrolledISTA`.", record=False)
unrolled_pase = _function_of("unrolled-pase", "`learned.networks.unrolled_ista_pase.UnrolledPASE`.", record=False)
spikesr_small = _function_of("spikesr-small", "`learned.networks.spikesr.SpikeSRNet`, small.", record=False)
spikesr_full = _function_of(
    "spikesr-full", "`learned.networks.spikesr.SpikeSRNet`, as large as the paper's.", record=False
)
