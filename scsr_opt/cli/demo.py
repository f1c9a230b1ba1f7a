"""`scsr demo`: the whole path on a simulated recording."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from scsr_opt._files import as_path, refuse_url
from scsr_opt.cli.options import Overwrite, Quiet, check_outputs, progress, say_failure
from scsr_opt.errors import InputError


def demo(
    *,
    output: Annotated[
        Path, Parameter(name=["--output", "-o"], help="Folder to write to; it is made if it is not there.")
    ] = Path("demo_output"),
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Simulate a moving scene, solve it at four times the resolution, and show both side by side.

    Takes about a minute. Writes the recording, the picture, a report and a figure.
    """
    refuse_url(as_path(output))
    from scsr_opt._kernels.programs import ready

    ready()  # before there is a folder
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"The folder {output} cannot be made: {(error.strerror or str(error)).lower()}.") from error
    from scsr_opt.cli.demo_scene import FILES, run

    check_outputs([], overwrite, **{f"output/{name}": output / name for name in FILES})
    outcome = run(output, progress=progress(quiet))
    if not outcome.solution.status.usable:
        say_failure("No picture was written", outcome.solution.status.message)
        return 1
    if not quiet:
        print("\n".join(outcome.lines))
    return 0
