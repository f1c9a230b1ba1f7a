from .charts import (
    convergence,
    error_map,
    spike_raster,
    stage_grid,
    time_against_error,
    velocity_map,
    zoomed_crops,
)
from .colours import colour_wheel, full_speed, motion_colours
from .explore import explore
from .figures import bicubic, compare, detailed_part, figure, scene_figure
from .pictures import PictureFormat, check_film, film_rate, quantise, read_picture, write_film, write_picture
from .progress import LineProgress, RichProgress
from .shown import ShownFigure
from .summary import Report, versions
from .wipe import Wipe

__all__ = [
    "LineProgress",
    "PictureFormat",
    "Report",
    "RichProgress",
    "ShownFigure",
    "Wipe",
    "bicubic",
    "check_film",
    "colour_wheel",
    "compare",
    "convergence",
    "detailed_part",
    "error_map",
    "explore",
    "figure",
    "film_rate",
    "full_speed",
    "motion_colours",
    "scene_figure",
    "quantise",
    "read_picture",
    "spike_raster",
    "stage_grid",
    "time_against_error",
    "velocity_map",
    "versions",
    "write_film",
    "write_picture",
    "zoomed_crops",
]
