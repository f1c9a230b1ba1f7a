from .camera.recording import Recording
from .errors import InputError
from .pipeline.reconstruct import reconstruct
from .pipeline.sequence import sequence
from .solvers.solution import Result, Solution, Stage

__all__ = [
    "InputError",
    "Recording",
    "Result",
    "Solution",
    "Stage",
    "reconstruct",
    "sequence",
]
