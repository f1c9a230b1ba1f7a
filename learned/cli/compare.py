"""`scsr compare`: optimizers and networks side by side, stage by stage."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from scsr_opt._files import check_writable
from scsr_opt.cli.options import File, Overwrite, Quiet, Reading, Whole, key_frame, progress
from scsr_opt.errors import InputError


def compare(
    file: File,
    /,
    *,
    models: Annotated[
        str,
        Parameter(
            help="Names with commas between: ista-tv, fista-tv, fista-huber, ridge, ridge-weakly, ridge-centred "
            "(optimizers); unrolled, unrolled-pase, spikesr-small, spikesr-full (networks); or .scsr files that scsr "
            "train wrote."
        ),
    ],
    output: Annotated[
        Path,
        Parameter(
            name=["--output", "-o"],
            help="Folder for stages.txt (a table), stages.json (all stages) and stages.png; it is made if it is not "
            "there.",
        ),
    ],
    scale: Annotated[
        Whole, Parameter(help="Pixels of the picture per sensor pixel, along each axis: 1, 2, 3, 4, …")
    ] = 4,
    key: Annotated[Whole | None, Parameter(help="Frame to show, from 0. Default: the middle one.")] = None,
    truth: Annotated[
        Path | None,
        Parameter(
            help="The true picture, .png, .tif (8, 16 or 32 bits) or .npz, linear and of the size of the result: adds "
            "PSNR and SSIM."
        ),
    ] = None,
    strength: Annotated[
        float | None,
        Parameter(
            help="Strength (lambda) of Huber-TV, the prior of fista-huber; other priors take this number times their "
            "relative strength. Default: by cross-validation on held-out measurements. (scsr solve finds the strength "
            "of each prior anew.)"
        ),
    ] = None,
    costs: Annotated[
        bool, Parameter(help="Measure seconds and FLOPs; for this, each stage of a network is compiled separately.")
    ] = True,
    reading: Reading | None = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Compare optimizers and networks stage by stage on one moment of a recording.

    The picture after each stage of each model is measured alike: by the objective that fista-huber minimises (misfit to
    the spikes plus Huber-TV), by its distance from the converged solution, and by how much the stage changed it. The
    table says which objective each model itself minimises, and what each column means. Optimizer and network are
    also started at each other's picture.
    """
    names = [name.strip() for name in models.split(",") if name.strip()]
    if not names:
        raise InputError("--models names no model; give some with commas between, such as fista-tv,spikesr-small.")
    if scale < 1:
        raise InputError(f"--scale is {scale}, but it must be at least 1.")
    if strength is not None:
        from scsr_opt._validation import prior_strength

        prior_strength(strength, "--strength")
    from learned.evaluation.stage_report import FILES

    _check_folder(output, [file, *([] if truth is None else [truth])], FILES, overwrite)
    recording = (reading or Reading()).open(file)
    moment = key_frame(recording, key)

    from learned.evaluation.compare import compare_stages
    from learned.zoo import model
    from scsr_opt.report.pictures import read_picture

    chosen = [model(name, scale) for name in names]
    known = None if truth is None else read_picture(truth)
    meter = progress(quiet)
    compared = compare_stages(
        recording, chosen, scale=scale, key=moment, truth=known, strength=strength, costs=costs, progress=meter
    )
    paths = compared.write(output)
    if not quiet:
        print("\n".join([compared.table(), *(str(path) for path in paths)]))
    return 0


def _check_folder(output: Path, inputs: Sequence[Path | str], names: tuple[str, ...], overwrite: bool) -> None:
    """**Raises:** `InputError` if the outputs cannot be written there, or would replace a file that they may not."""
    if not output.exists():
        check_writable(output)
        return
    if not output.is_dir():
        raise InputError(f"--output {output} is a file; name a folder.")
    for name in names:
        path = output / name
        check_writable(path)
        if any(isinstance(read, Path) and read.is_file() and path.exists() and path.samefile(read) for read in inputs):
            raise InputError(f"{path} is a file that is read: give --output another folder.")
        if path.exists() and not overwrite:
            raise InputError(f"--output {output} holds {name} already: give --overwrite, or another folder.")
