"""`scsr train`: weights for one of the networks."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from scsr_opt.cli.options import Quiet, Whole, progress, say_error


def train(
    config: Annotated[
        str,
        Parameter(
            help="A .toml file, or a configuration of the package: the id of a model, NAME-x2 or NAME-x4 with NAME one "
            "of unrolled, unrolled-pase, spikesr-plain (as in the paper), spikesr-small and spikesr-full (with an "
            "estimate of velocity), ridge-centred (for --quality best; also ridge-centred-x1); a part of a model: "
            "velocity, compensation-x2 or compensation-x4; or smoke, a test of half a minute in which the network "
            "learns nothing."
        ),
    ],
    /,
    *,
    output: Annotated[
        Path | None,
        Parameter(
            name=["--output", "-o"],
            help="Folder of the run; it is made if it is not there. Default: run-CONFIG.",
        ),
    ] = None,
    pictures: Annotated[
        Path | None,
        Parameter(
            help="Folder of pictures to train on; a folder in it with three pictures or more is a video, each picture "
            "a frame. Default: that of the configuration, or else pictures that come with scikit-image."
        ),
    ] = None,
    steps: Annotated[Whole | None, Parameter(help="Steps to train for in all. Default: the configuration's.")] = None,
    quiet: Quiet = False,
) -> int:
    """Train a network on simulated recordings.

    A run of the same configuration in the folder is resumed: stop it at any moment, and give the command again. The
    folder has the weights (best.scsr, last.scsr), the losses and scores (.csv, curves.png) and sample pictures:
    playback, network and truth.
    """
    # `learned` builds on this package; it is known here by name only, and only while the command runs.
    from learned.training.configs import TrainingConfig
    from learned.training.loop import train as run

    chosen = TrainingConfig.read(config)
    if pictures is not None:
        chosen = chosen.changed(pictures=str(pictures))
    if steps is not None:
        chosen = chosen.changed(steps=steps)
    folder = Path(f"run-{Path(config).stem}") if output is None else output
    trained = run(chosen, folder, progress=progress(quiet))
    if not trained.status.usable:
        say_error(trained.status.message)
        return 1
    if not quiet:
        print("\n".join([*trained.lines(), str(folder)]))
    return 0
