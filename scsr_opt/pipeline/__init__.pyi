from .restoration import Restoration, Solved
from .settings import (
    BadPixelSettings,
    GainSettings,
    MotionSettings,
    OpticsSettings,
    OuterLoopSettings,
    PipelineSettings,
    RefinementSettings,
    SamplingSettings,
    SceneSummarySettings,
    SequenceSettings,
    StrengthSettings,
    TileSettings,
    WhiteSettings,
)

__all__ = [
    "BadPixelSettings",
    "GainSettings",
    "MotionSettings",
    "OpticsSettings",
    "OuterLoopSettings",
    "PipelineSettings",
    "RefinementSettings",
    "Restoration",
    "SamplingSettings",
    "SceneSummarySettings",
    "SequenceSettings",
    "Solved",
    "StrengthSettings",
    "TileSettings",
    "WhiteSettings",
]
