"""`PipelineSettings`: all numbers that a reconstruction hinges on, by stage."""

from dataclasses import dataclass, field

from scsr_opt._settings import Settings
from scsr_opt.motion.settings import MotionSettings


@dataclass(frozen=True, kw_only=True)
class PipelineSettings(Settings):
    """Thresholds of every stage; each has a default that needs no tuning (`python -m benchmarks.sensitivity`)."""

    motion: MotionSettings = field(default_factory=MotionSettings)
    """Estimation of motion, where no estimator is given."""
