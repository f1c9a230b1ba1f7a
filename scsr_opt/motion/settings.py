"""`MotionSettings`: the numbers that motion estimation hinges on."""

from dataclasses import dataclass

from scsr_opt._settings import Settings


@dataclass(frozen=True, kw_only=True)
class MotionSettings(Settings):
    """Thresholds of motion estimation, by stage."""
