"""Stages from a recording to a picture, in the order of Eq. 4, and their settings.

Names are imported when they are first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
