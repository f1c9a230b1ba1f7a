"""Thresholds of the solvers that work on parts of a picture."""

from dataclasses import dataclass

from scsr_opt._settings import Settings


@dataclass(frozen=True, kw_only=True)
class TileSettings(Settings):
    """Iterations of the whole picture and of single tiles of it (`run_tiles`)."""

    side_px: int = 32
    """Side of a tile, sensor pixels. With half of that, as large a part of the windows is border as tile, and more of
    the tiles wait for each other."""
    whole_tolerances: float = 4.0
    """Residual, in tolerances, to which the whole picture is iterated before its tiles."""
    whole_similar_tolerances: float = 64.0
    """That residual where the solve starts from that of a similar problem, which is finished in many places."""
    limit_tolerances: float = 10.0
    """Residual of a tile, in tolerances, above which it is iterated on."""
    finished_share: float = 0.6
    """Share of that limit below which a tile is finished."""
    batch: int = 4
    """Tiles that are iterated side by side: of more, some wait for the slowest."""
    most_iterations: int = 40
    """Iterations of a tile, at most, before the whole picture is looked at again."""
    most_visits: int = 12
    """Times that tiles are iterated, at most; what is left then is left to iterations of the whole picture."""
