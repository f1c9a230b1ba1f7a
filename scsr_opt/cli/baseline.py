"""`scsr baseline`: a recording to a picture by one of the simpler methods to compare `scsr solve` with."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from scsr_opt.cli.options import (
    File,
    Overwrite,
    Quiet,
    Reading,
    ShownWhite,
    Whole,
    check_outputs,
    key_frame,
    progress,
    shown_white,
    white_of_picture,
)
from scsr_opt.errors import InputError

Method = Literal[
    "conventional-camera",
    "tfp-bicubic",
    "tfi-bicubic",
    "stp-bicubic",
    "tfp-sr",
    "tfi-sr",
    "stp-sr",
    "shift-and-add",
    "mgsr",
]


def baseline(
    file: File,
    /,
    *,
    output: Annotated[
        Path,
        Parameter(
            name=["--output", "-o"],
            help="Picture to write: .png (8 or 16 bit), .tif (8, 16, or 32 bit float) or .npz (float).",
        ),
    ],
    method: Annotated[
        Method,
        Parameter(
            help="conventional-camera: one exposure of 1/120 s; tfp, tfi, stp: playback (see scsr play), enlarged "
            "(-bicubic) or by super-resolution of that one picture (-sr); shift-and-add: measurements averaged at "
            "their places along the motion; mgsr: the method MGSR (Zhao et al., 2021)."
        ),
    ] = "mgsr",
    scale: Annotated[
        Whole, Parameter(help="Pixels of the picture per sensor pixel, along each axis: 1, 2, 3, 4, …")
    ] = 4,
    key: Annotated[Whole | None, Parameter(help="Frame to show, from 0. Default: the middle one.")] = None,
    bits: Annotated[Whole | None, Parameter(help="Bits per pixel: 8 or 16; 32 (float) for .tif.")] = None,
    gamma: Annotated[
        float, Parameter(help="Store intensity^(1/gamma): 1 is linear; 2.2 is what viewers expect.")
    ] = 1.0,
    white: ShownWhite = None,
    reading: Reading | None = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Make a picture of one moment by a simpler method, to compare with that of `scsr solve`.

    Size, key frame and intensities of the picture are those of `scsr solve`.
    """
    from scsr_opt.report.pictures import PictureFormat, write_picture

    absolute = PictureFormat.of(output, bits=bits, gamma=gamma).absolute
    white_of_picture(output, bits, white)
    check_outputs([file], overwrite, output=output)
    if scale < 1:
        raise InputError(f"--scale is {scale}, but it must be at least 1.")
    recording = (reading or Reading()).open(file)
    moment = key_frame(recording, key)

    from scsr_opt.baselines import BASELINES

    meter = progress(quiet)
    meter.start(None, f"Making the picture by {method}")
    try:
        image = BASELINES[method.replace("-", "_")](recording, scale=scale, key=moment)
    finally:
        meter.finish()
    level = None if absolute else shown_white(recording, white, moment, moment)
    write_picture(output, image, bits=bits, gamma=gamma, white=1.0 if level is None else level.level)
    if not quiet:
        print(f"{output}: frame {moment} by {method}, {image.shape[1]}x{image.shape[0]}.")
        if level is not None:
            print(level.sentence)
    return 0
