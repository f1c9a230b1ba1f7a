"""Numbers of the baselines that their sources leave open."""

from dataclasses import dataclass

from scsr_opt._settings import Settings


@dataclass(frozen=True, kw_only=True)
class BaselineSettings(Settings):
    """Numbers that the sources of the baselines leave open; strengths were found on stills of scikit-image
    (docs/baselines.md)."""

    searched_frames: int = 1001
    """Frames that a playback is given: enough to find the spikes next to the key frame of a pixel that fires 300 times
    less often than white."""
    exposure_margin_frames: int = 50
    """Frames read on either side of a conventional camera's exposure, to find the spikes next to its ends."""
    single_image_noise_factor: float = 0.2
    """λ = single_image_noise_factor · σ · 2/s of one playback, σ the noise of the playback."""
    noise_factor: float = 0.08
    """λ = noise_factor · √(noise / frames) · 2/s of `mgsr`."""
    long_exposure_px: float = 0.75
    """Motion during an exposure, high-resolution pixels, from which on `mgsr` reads it at three positions."""
    corrections: int = 3
    """Corrections of `mgsr` for the motion during exposures."""
    pixel_least_frames: float = 0.5
    """Frames of exposure below which a pixel of `shift_and_add` rather takes what is around it."""
    neighbourhood_least_frames: float = 0.005
    """Mean frames of exposure below which a neighbourhood takes what is around it in turn."""
    neighbourhoods_px: tuple[float, float, float] = (4.0, 1.0, 0.4)
    """Widths of the neighbourhoods, sensor pixels, the widest first; what has nothing within the widest takes the mean
    of the whole picture."""


DEFAULT = BaselineSettings()
