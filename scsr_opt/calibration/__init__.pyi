from .bad_pixels import BadPixels, PixelKind, isolated_pixels, resting_pixels
from .gain import blind_gain, flat_gain, with_gain
from .gain_network import gain_at_rest
from .maps import Calibration
from .optics import GaussianOptics, estimate_gaussian_optics

__all__ = [
    "BadPixels",
    "Calibration",
    "GaussianOptics",
    "PixelKind",
    "blind_gain",
    "estimate_gaussian_optics",
    "flat_gain",
    "gain_at_rest",
    "isolated_pixels",
    "resting_pixels",
    "with_gain",
]
