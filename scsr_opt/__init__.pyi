from .camera.recording import Recording
from .errors import InputError, SolveError
from .motion.estimators.automatic import estimate_motion
from .pipeline.options import Options, Shortcuts
from .pipeline.reconstruct import assemble, reconstruct
from .pipeline.sequence import reconstruct_sequence
from .pipeline.settings import PipelineSettings
from .pipeline.solution import Diagnostics, Solution
from .solvers.record import Stage, Status

__all__ = [
    "Diagnostics",
    "InputError",
    "Options",
    "PipelineSettings",
    "Recording",
    "Shortcuts",
    "Solution",
    "SolveError",
    "Stage",
    "Status",
    "assemble",
    "estimate_motion",
    "reconstruct",
    "reconstruct_sequence",
]
