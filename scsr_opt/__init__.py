"""Super-resolved pictures from spike camera recordings, by solving the imaging model directly.

`reconstruct` is the door, `sequence` that of many moments; `scsr_opt.camera` reads recordings and simulates them.
"""

import importlib
from typing import TYPE_CHECKING, Any

from scsr_opt._kernels import forks as _forks  # noqa: F401  from the start on it takes note of forks

if TYPE_CHECKING:
    from scsr_opt.camera.recording import Recording
    from scsr_opt.errors import InputError
    from scsr_opt.key_frames import sequence
    from scsr_opt.reconstruction import reconstruct
    from scsr_opt.solvers.solution import Result, Solution, Stage

__all__ = ["InputError", "Recording", "Result", "Solution", "Stage", "reconstruct", "sequence"]

_HOME = {
    "InputError": "scsr_opt.errors",
    "Recording": "scsr_opt.camera.recording",
    "Result": "scsr_opt.solvers.solution",
    "Solution": "scsr_opt.solvers.solution",
    "Stage": "scsr_opt.solvers.solution",
    "reconstruct": "scsr_opt.reconstruction",
    "sequence": "scsr_opt.key_frames",
}


def __getattr__(name: str) -> Any:
    # Loaded on first use: reading a recording, or `scsr --help`, does not wait for JAX.
    if name not in _HOME:
        raise AttributeError(f"module 'scsr_opt' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)
