"""White: the intensity that 8-bit PNG, figures and films show as the brightest grey level.

Intensity 1 is what fires at the recording's white rate. A camera is seldom set so that the brightest of a scene is just
that, so pictures for the eye have a white of their own: a quantile, almost the largest, of the light that is known.
A pixel that is bad, did not fire or is saturated is not known. Files of numbers (16 bit, TIFF, NPZ) stay absolute.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped

from scsr_opt._settings import Settings
from scsr_opt._validation import finite
from scsr_opt.camera.recording import Recording, bad_pixels_of
from scsr_opt.errors import InputError, shown

# Below, nothing is left of a picture but noise; above, nothing but black.
_LEVELS = (1e-6, 1e6)


@dataclass(frozen=True, kw_only=True)
class WhiteSettings(Settings):
    """Search for white (`find_white`)."""

    above_zero = frozenset({"windows", "window_frames", "known_pixels"})

    quantile: float = 0.997
    """Share of the known light that is below white: the rest are glints, and light that noise adds."""
    nominal_within: float = 0.1
    """Relative distance from 1 within which white stays 1."""
    least_of_median: float = 2.0
    """Least white, in medians of the known light (1 at most), so that a picture that is grey all over stays grey."""
    least_spikes: float = 4.0
    """Least white, as spikes of a pixel in all frames (intensity 1 at most): darker parts are mostly noise."""
    windows: int = 8
    """Windows of frames, at most, spread evenly, whose light is measured: a scene may be bright at one moment only."""
    window_frames: int = 25
    """Least number of frames of a window: in a mean over too many, small bright objects would be blurred by motion."""
    window_spikes: float = 16.0
    """Least number of spikes of a bright pixel in a window; in dim light a window has more frames."""
    saturating_share: float = 0.85
    """Share of the light that saturates a pixel from which on white is that light, if more pixels are saturated than
    may be above white: intensities between the two cannot be told apart."""
    known_pixels: int = 16
    """Pixels with known light, at least, for white to be found."""


@dataclass(frozen=True)
class White:
    """White of 8-bit pictures, figures and films.

    **Fields:** `level`: intensity shown as white; `found`: by the recording, or else given or nominal; `reason`: why,
    a clause for people.
    """

    level: float = 1.0
    found: bool = False
    reason: str = "nominal"

    @classmethod
    def given(cls, level: float | int) -> "White":
        """White that somebody chose. **Raises:** `InputError` if it is no number from 1e-6 to 1e6."""
        least, most = _LEVELS
        if not least <= finite(level) <= most:
            raise InputError(f"white is {shown(level)}, but it must be an intensity from {least:g} to {most:g}.")
        return cls(float(level), False, "as given")

    @property
    def sentence(self) -> str:
        """The white for people, in one line."""
        return f"Shown as white: intensity {self.level:.3g} ({self.reason})."


def find_white(
    read: Callable[[int, int], Shaped[np.ndarray, "n h w"]],
    frames: int,
    *,
    white_rate: float,
    bad_pixels: Bool[np.ndarray, "h w"] | None = None,
    settings: WhiteSettings = WhiteSettings(),
) -> White:
    """White of what `frames` frames show, from their spikes.

    **Arguments:** `read(start, stop)`: the spikes of frames `start` to `stop` − 1 (`Recording.window`); `white_rate`:
    spikes per frame of intensity 1; `bad_pixels`: (h, w), true where a pixel must not be used.
    """
    length = min(settings.window_frames, frames)
    light, bright, lost = _known_light(read, frames, length, white_rate, bad_pixels, settings)
    if 0 < bright * length < settings.window_spikes and length < frames:
        length = min(int(np.ceil(settings.window_spikes / bright)), frames)
        light, _, lost = _known_light(read, frames, length, white_rate, bad_pixels, settings)
    if light.size < settings.known_pixels:
        return White(1.0, True, "too few pixels measure light, so it is that of the white rate")
    found = white_of(light, least=settings.least_spikes / (frames * white_rate), settings=settings)
    full = 1 / white_rate
    if lost > 1 - settings.quantile and settings.saturating_share * full <= found.level < full and found.level != 1:
        # Without the share that is lost, which is that of the windows: `scsr info` and the report call another share
        # saturated, that of the recording.
        return White(full, True, "the most light that a pixel can measure")
    return found


def find_white_around(
    recording: Recording,
    first: int,
    last: int,
    frames: int,
    *,
    white_rate: float | None = None,
    bad_pixels: Bool[np.ndarray, "h w"] | None = None,
    settings: WhiteSettings = WhiteSettings(),
) -> White:
    """White of pictures of key frames `first` to `last`, from all that is between them and `frames` frames around.

    **Arguments:** `white_rate`: that of the recording if None; `bad_pixels`: more than those of the recording.
    """
    start, stop = recording.around(first, frames)[0], recording.around(last, frames)[1]
    return find_white(
        lambda begin, end: recording.window(start + begin, start + end),
        stop - start,
        white_rate=recording.white_rate if white_rate is None else white_rate,
        bad_pixels=bad_pixels_of(recording, bad_pixels),
        settings=settings,
    )


def white_of(
    light: Float[np.ndarray, " n"], *, least: float | int = 1e-3, settings: WhiteSettings = WhiteSettings()
) -> White:
    """White of known light, intensity: one of the windows of a recording, or of the pixels of a picture.

    **Arguments:** `least`: intensity below which light is mostly noise; white is not less, or 1.
    """
    high, median = float(np.quantile(light, settings.quantile)), float(np.median(light))
    below = f"{100 * settings.quantile:.4g} % of the measured light is"
    if abs(high - 1) <= settings.nominal_within:
        return White(1.0, True, f"{below} below {high:.3g}, close enough to 1")
    bound = min(max(settings.least_of_median * median, least), 1.0)
    if high < bound:
        return White(bound, True, f"{below} below {high:.3g}, but a plain or dim scene stays grey")
    return White(high, True, f"{below} below it")


def _known_light(
    read: Callable[[int, int], Shaped[np.ndarray, "n h w"]],
    frames: int,
    length: int,
    white_rate: float,
    bad_pixels: Bool[np.ndarray, "h w"] | None,
    settings: WhiteSettings,
) -> tuple[Float[np.ndarray, " n"], float, float]:
    """Light of the known pixels in each of some windows, one after the other; what a bright one fires per frame; the
    share that is saturated."""
    # Not at the top: they import JAX, which one who only writes a picture need not wait for.
    from scsr_opt.camera.samples import mean_light
    from scsr_opt.camera.saturation import saturated
    from scsr_opt.camera.spike_times import SpikeTimes

    number = max(1, min(settings.windows, frames // length))
    found, counts, lost = [], [], 0
    for start in np.linspace(0, frames - length, number).astype(int):
        times = SpikeTimes.of(read(int(start), int(start) + length))
        full = saturated(times.count, length, bad_pixels)
        known = (times.count > 0) & ~full
        if bad_pixels is not None:
            known &= ~bad_pixels
        lost += int(np.count_nonzero(full))
        found.append(mean_light(times, 0, length, white_rate=white_rate)[known])
        counts.append(times.count[known])
    fired = np.concatenate(counts)
    bright = float(np.quantile(fired, 0.99)) / length if fired.size else 0.0
    return np.concatenate(found), bright, lost / (lost + fired.size) if lost else 0.0
