from .colours import colour_wheel, full_speed, motion_colours
from .figures import bicubic, compare, detailed_part, figure, scene_figure
from .pictures import PictureFormat, check_film, quantise, read_picture, write_film, write_picture
from .progress import RichProgress
from .summary import Report, versions

__all__ = [
    "PictureFormat",
    "Report",
    "RichProgress",
    "bicubic",
    "check_film",
    "colour_wheel",
    "compare",
    "detailed_part",
    "figure",
    "full_speed",
    "motion_colours",
    "scene_figure",
    "quantise",
    "read_picture",
    "versions",
    "write_film",
    "write_picture",
]
