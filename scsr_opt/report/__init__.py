"""What a reconstruction is shown with: pictures and films in files, the figure, the report, progress.

    figure(recording, solution, scale=4).savefig("figure.png")
    Report.of(recording, solution, scale=4, key=50).write("report.json")
    write_picture("picture.png", solution.image, bits=16)

Names are looked up in their modules when first asked for: who only writes a picture need not wait for matplotlib.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scsr_opt.report.colours import colour_wheel, full_speed, motion_colours
    from scsr_opt.report.figures import bicubic, compare, detailed_part, figure, plan_figure
    from scsr_opt.report.files import check_writable, whole_file
    from scsr_opt.report.pictures import PictureFormat, check_film, quantise, read_picture, write_film, write_picture
    from scsr_opt.report.progress import RichProgress
    from scsr_opt.report.summary import Report, versions

_MODULES = {
    "figures": ("bicubic", "compare", "detailed_part", "figure", "plan_figure"),
    "files": ("check_writable", "whole_file"),
    "colours": ("colour_wheel", "full_speed", "motion_colours"),
    "pictures": ("PictureFormat", "check_film", "quantise", "read_picture", "write_film", "write_picture"),
    "progress": ("RichProgress",),
    "summary": ("Report", "versions"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "PictureFormat",
    "Report",
    "RichProgress",
    "bicubic",
    "check_film",
    "check_writable",
    "colour_wheel",
    "compare",
    "detailed_part",
    "figure",
    "full_speed",
    "motion_colours",
    "plan_figure",
    "quantise",
    "read_picture",
    "versions",
    "whole_file",
    "write_film",
    "write_picture",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
