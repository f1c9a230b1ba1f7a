"""Super-resolved pictures from spike camera recordings, by solving the imaging model directly.

`reconstruct` solves for the picture of one moment, `reconstruct_sequence` for those of many; `assemble` gives the
problem alone, for a solver or a prior of one's own. `scsr_opt.camera` reads recordings and simulates them.
"""

import lazy_loader

from scsr_opt._kernels import forks as _forks  # noqa: F401  registers its handlers before a script can fork

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
