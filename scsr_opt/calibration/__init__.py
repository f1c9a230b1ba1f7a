"""Properties of the camera that a recording shows: gains of its pixels, blur of its lens.

Names are imported when they are first used, so that reading a recording does not wait for JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
