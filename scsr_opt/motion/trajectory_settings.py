"""`TrajectorySettings`: the numbers that inverting a motion, and what is visible along it, hinge on.

Lengths are sensor pixels. `MotionSettings` holds them as its field `trajectory`.
"""

from dataclasses import dataclass

from scsr_opt._settings import Settings


@dataclass(frozen=True, kw_only=True)
class TrajectorySettings(Settings):
    """How a motion is inverted and what is visible along it (`trajectory_of`)."""

    inverse_steps: int = 8
    """Fixed-point iterations of the inverse, at most."""
    inverse_tolerance_px: float = 1e-4
    """Change below which these iterations end, and deviation up to which a motion is inverted as an affine one."""
    partial_share: float = 0.5
    """Share of a layer at a point between pixel centres from which on the point belongs to it."""
    whole_share: float = 0.9
    """Share of a layer from which on the point belongs to it alone; below, a pixel sees two surfaces at once."""
