from .settings import (
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
)

__all__ = [
    "GainSettings",
    "MotionSettings",
    "OpticsSettings",
    "OuterLoopSettings",
    "PipelineSettings",
    "RefinementSettings",
    "SamplingSettings",
    "SceneSummarySettings",
    "SequenceSettings",
    "StrengthSettings",
    "TileSettings",
]
