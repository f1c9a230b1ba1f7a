"""Super-resolved pictures from spike camera recordings, by solving the imaging model directly.

`reconstruct` is the door, `sequence` that of many moments; `scsr_opt.camera` reads recordings and simulates them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
