"""Sequences of pictures on disk: a store that a killed run goes on with, workers that fill it, files made from it.

    plan = Plan.of(recording, range(60, 160, 10), scale=2)
    write_sequence(plan, "car.zarr")
    export("car.zarr", "car.mp4")

Needs the packages of the extra `sequence` (pip install 'scsr-opt[sequence]'), which are imported when they are used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
