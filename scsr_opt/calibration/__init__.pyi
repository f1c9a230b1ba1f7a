from .gain import blind_gain, flat_gain, with_gain
from .gain_network import gain_at_rest
from .optics import GaussianOptics, estimate_gaussian_optics

__all__ = [
    "GaussianOptics",
    "blind_gain",
    "estimate_gaussian_optics",
    "flat_gain",
    "gain_at_rest",
    "with_gain",
]
