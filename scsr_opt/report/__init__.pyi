from .colours import colour_wheel, full_speed, motion_colours
from .figures import bicubic, compare, detailed_part, figure, scene_figure
from .files import check_writable, whole_file
from .pictures import PictureFormat, check_film, quantise, read_picture, write_film, write_picture
from .progress import RichProgress
from .summary import Report, versions

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
    "scene_figure",
    "quantise",
    "read_picture",
    "versions",
    "whole_file",
    "write_film",
    "write_picture",
]
