"""Thresholds of the solvers that work on parts of a picture."""

from dataclasses import dataclass

from scsr_opt._settings import Settings


@dataclass(frozen=True, kw_only=True)
class TileSettings(Settings):
    """Iterations of the whole picture and of single tiles of it (`run_tiles`)."""

    side_px: int = 32
    """Side of a tile, sensor pixels. With half of it, the border of a window would be as large as its tile, and more
    tiles would have to wait for each other."""
    whole_tolerances: float = 4.0
    """Residual, in tolerances, to which the whole picture is iterated before single tiles are."""
    whole_similar_tolerances: float = 64.0
    """The same residual for a solve that starts from the solution of a similar problem, most of whose tiles are
    finished."""
    limit_tolerances: float = 10.0
    """Residual of a tile, in tolerances, above which it is iterated further."""
    finished_share: float = 0.6
    """Share of that limit below which a tile is finished."""
    batch: int = 4
    """Tiles that are iterated at once: of more, some would wait for the slowest."""
    most_iterations: int = 40
    """Iterations of a tile, at most, before the residual of the whole picture is calculated again."""
    most_visits: int = 12
    """Rounds of tile iterations, at most; after these the whole picture is iterated."""
