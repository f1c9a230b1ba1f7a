"""A recording of a spike camera, in memory or on disk, as one value.

The spikes themselves stay where they are (see `sources`); a `Recording` adds what is needed to make light of them: how
fast they were read out, how many of them are white, which pixels lie. Spikes are handed out upright, top row first,
whichever way the file has them.
"""

import dataclasses
import math
import operator
import warnings
from dataclasses import dataclass
from typing import Any, SupportsFloat, SupportsIndex

import numpy as np
from jaxtyping import Bool, UInt8

from scsr_opt._arrays import as_array
from scsr_opt.camera.plausibility import axis_regularity, contradiction
from scsr_opt.camera.sources import ArraySource, CroppedSource, SpikeSource, as_spikes, checked_shape
from scsr_opt.errors import InputError, shown

READOUT_RATE = 40_000.0
"""Spike frames per second, where nothing else is known."""
USUAL_FRAMES = 101
"""Frames around the key frame that are used by default (2.5 ms at 40 kHz): enough to see every sensor pixel through
many apertures, short enough for motion to be smooth."""
WHITE_RATE = 0.6
"""Spikes per frame of intensity 1, where nothing else is known: measured on the REDS set and on real recordings."""

# What a camera may have. White that fires less or more often than these would ask for intensities that single precision
# does not hold, or that nothing here can tell from black: from 10⁴ on no motion is found, at 10⁻²⁰ no picture.
_WHITE_RATES = (1e-6, 1e3)
_READOUT_RATES = (1e-3, 1e12)


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Binary frames of a spike camera, with the properties of the camera that are known.

    **Fields:**
    - `source`: where the (T, h, w) spikes are read from. Use `Recording.from_array` or `read_recording` rather than
      this.
    - `readout_rate`: spike frames per second, Hz.
    - `white_rate`: spikes per frame of a pixel that sees intensity 1 (white); the threshold θ is 1 / `white_rate`.
    - `bad_pixels`: (h, w), True where a pixel must not be used (dead, hot), upright; None where nothing is known of
      any.
    - `flipped`: whether the file has the rows bottom-up. Only a note: `window` and `spikes` are upright either way.
    - `name`: for titles and reports.

    **Raises:** `InputError` if `source` is no `SpikeSource`, `readout_rate` not a number from 1e-3 to 1e12,
    `white_rate` not one from 1e-6 to 1e3, or `bad_pixels` not a bool mask of shape (h, w).
    """

    source: SpikeSource
    readout_rate: float = READOUT_RATE
    white_rate: float = WHITE_RATE
    bad_pixels: Bool[np.ndarray, "h w"] | None = None
    flipped: bool = False
    name: str = "recording"

    def __post_init__(self):
        if not isinstance(self.source, SpikeSource):
            raise InputError(
                f"source is {shown(self.source)}; it must be a SpikeSource, as Recording.from_array and read_recording "
                f"make it."
            )
        for name, value in checked_settings(self.shape, self.readout_rate, self.white_rate, self.bad_pixels).items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_array(
        cls,
        array: Any,
        *,
        readout_rate: SupportsFloat = READOUT_RATE,
        white_rate: SupportsFloat = WHITE_RATE,
        bad_pixels: Any = None,
        name: str = "recording",
    ) -> "Recording":
        """A recording of spikes in memory.

        **Arguments:**
        - `array`: (T, h, w), bool or integer, 0 and 1 only, upright, time first. The recording keeps its own copy, a
          bit for each spike, so that `array` may be overwritten or let go afterwards.
        - the others: as the fields.

        If another axis than the first looks like time by its content, there is a warning.

        **Raises:** `InputError` if `array` has another number of dimensions, other values, a mask, or nothing in it.
        """
        spikes = as_array(array, "The array")
        checked_shape(spikes.shape, "The array")
        checked = as_spikes(spikes, "The array")
        source = ArraySource.of(checked)
        other = contradiction(axis_regularity(checked), axis=0)
        if other is not None:
            warnings.warn(
                f"The array of shape {spikes.shape} is taken for (frames, rows, columns), but its content looks as if "
                f"axis {other} were time: pass np.moveaxis(array, {other}, 0) if it is.",
                stacklevel=2,
            )
        return cls(source, name=name, **checked_settings(source.shape, readout_rate, white_rate, bad_pixels))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(T, h, w): frames, rows, columns."""
        return self.source.shape

    @property
    def frames(self) -> int:
        """T, the number of spike frames."""
        return self.shape[0]

    @property
    def height(self) -> int:
        """h, sensor rows."""
        return self.shape[1]

    @property
    def width(self) -> int:
        """w, sensor columns."""
        return self.shape[2]

    @property
    def duration(self) -> float:
        """Seconds."""
        return self.frames / self.readout_rate

    @property
    def spikes(self) -> UInt8[np.ndarray, "T h w"]:
        """All frames, upright, one byte a pixel. For a long recording take a `window`."""
        return self.source.read(0, self.frames)

    def window(self, start: SupportsIndex, stop: SupportsIndex) -> UInt8[np.ndarray, "n h w"]:
        """Frames `start` to `stop` − 1, upright, 0 and 1; from a file, only their bytes are read.

        **Raises:** `InputError` if it is empty or reaches outside the recording (counting from the end is not
        supported), or if the file turns out to hold other values there.
        """
        first, last = _index(start, "start"), _index(stop, "stop")
        if not 0 <= first < last <= self.frames:
            raise InputError(
                f"The window of frames {shown(first)} to {shown(last)} (stop excluded) does not lie in "
                f"{self.name}, which has frames 0 to {self.frames - 1}: choose 0 <= start < stop <= {self.frames}."
            )
        return self.source.read(first, last)

    def around(self, key: SupportsIndex | None = None, frames: SupportsIndex | None = None) -> tuple[int, int]:
        """(start, stop) of the `frames` frames around the key frame, for `window`.

        Where the key frame is near an end the window is moved, not shortened, so that it holds as many frames as asked
        for.

        **Arguments:**
        - `key`: the key frame, 0-based; the middle one if None.
        - `frames`: how many; all if None or if the recording has fewer.

        **Raises:** `InputError` if `key` is not a frame of the recording or `frames` is below 1.
        """
        middle = self.frames // 2 if key is None else _index(key, "key")
        if not 0 <= middle < self.frames:
            raise InputError(
                f"Key frame {shown(middle)} is not in {self.name}, which has {self.frames} frames: choose one "
                f"from 0 to {self.frames - 1}."
            )
        count = self.frames if frames is None else min(_index(frames, "frames"), self.frames)
        if count < 1:
            raise InputError(f"A window of {shown(frames)} frames holds nothing: ask for at least 1.")
        start = min(max(middle - count // 2, 0), self.frames - count)
        return (start, start + count)

    def crop(self, top: SupportsIndex, left: SupportsIndex, height: SupportsIndex, width: SupportsIndex) -> "Recording":
        """The recording of a rectangle of the sensor, still read from where it lies; `bad_pixels` are those in it.

        **Raises:** `InputError` if the rectangle is not of whole pixels, is empty or reaches outside the sensor.
        """
        top, left = _index(top, "top", "pixels"), _index(left, "left", "pixels")
        height, width = _index(height, "height", "pixels"), _index(width, "width", "pixels")
        if not (0 <= top < top + height <= self.height and 0 <= left < left + width <= self.width):
            raise InputError(
                f"The crop of {shown(height)} rows from {shown(top)} and {shown(width)} columns from {shown(left)} "
                f"does not lie in {self.name}, which has {self.height} rows and {self.width} columns: choose a height "
                f"and a width of at least 1, a top and a left of at least 0, top + height of at most {self.height} "
                f"and left + width of at most {self.width}."
            )
        mask = self.bad_pixels
        if mask is not None:
            mask = mask[top : top + height, left : left + width]
        return dataclasses.replace(
            self,
            source=CroppedSource(self.source, top, left, height, width),
            bad_pixels=mask,
            name=f"{self.name} (crop)",
        )

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("A Recording reads its spikes anew each time, so an array without a copy cannot be had.")
        return self.spikes if dtype is None else self.spikes.astype(dtype, copy=False)

    def __repr__(self) -> str:
        bad = "unknown" if self.bad_pixels is None else int(np.count_nonzero(self.bad_pixels))
        return (
            f"Recording({self.name!r}, {self.frames} frames of {self.width}x{self.height}, {self.duration * 1e3:.4g} "
            f"ms at {self.readout_rate:g} Hz, white_rate={self.white_rate:g}, bad pixels: {bad}, "
            f"{'stored bottom-up' if self.flipped else 'stored upright'})"
        )


def checked_settings(
    shape: tuple[int, int, int], readout_rate: Any, white_rate: Any, bad_pixels: Any
) -> dict[str, Any]:
    """The three settings of a recording of `shape` in the types of its fields, from anything that can mean them."""
    return {
        "readout_rate": _between(readout_rate, "readout_rate", *_READOUT_RATES, "in spike frames per second"),
        "white_rate": checked_white_rate(white_rate),
        "bad_pixels": None if bad_pixels is None else checked_mask(bad_pixels, shape[1:]),
    }


def checked_white_rate(value: Any) -> float:
    """`value` as spikes per frame of white. **Raises:** `InputError` if it is not a number from 1e-6 to 1e3."""
    return _between(value, "white_rate", *_WHITE_RATES, f"in spikes per frame of white ({WHITE_RATE:g} if not known)")


def _between(value: Any, name: str, least: float, most: float, unit: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not least <= number <= most:
        raise InputError(f"{name} is {shown(value)}, but it must be a number from {least:g} to {most:g}, {unit}.")
    return number


def _index(value: Any, name: str, counted: str = "frames") -> int:
    try:
        return operator.index(value)
    except TypeError:
        raise InputError(
            f"{name} is {shown(value)}, but {counted} are counted in whole numbers, the first one is 0."
        ) from None


def _held(array: np.ndarray) -> str:
    """Description of the values of an array that is no mask: their type, or their range."""
    if array.dtype.kind not in "iu":
        return f"values of type {array.dtype}"
    return f"values from {array.min()} to {array.max()}"


def checked_mask(mask: Any, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """A mask of bad pixels as a bool array of its own. **Raises:** `InputError` if it is none of this shape."""
    array = as_array(mask, "bad_pixels")
    if array.shape != shape:
        raise InputError(
            f"bad_pixels has shape {array.shape}, but the sensor has {shape[0]} rows and {shape[1]} columns: give a "
            f"mask of shape {shape}, True where a pixel is bad, top row first."
        )
    if array.dtype != np.bool_ and (array.dtype.kind not in "iu" or array.max() > 1 or array.min() < 0):
        raise InputError(
            f"bad_pixels holds {_held(array)}; give a bool mask, or whole numbers 0 and 1, True (or 1) where a pixel "
            "is bad, for example map > limit."
        )
    return array.astype(bool)  # a copy


def bad_pixels_of(recording: Recording, more: Any) -> Bool[np.ndarray, "h w"] | None:
    """Bad pixels of the recording and `more`; None if nothing is known of any. **Raises:** as `Recording`."""
    mask = checked_settings(recording.shape, recording.readout_rate, recording.white_rate, more)["bad_pixels"]
    if mask is None or recording.bad_pixels is None:
        return recording.bad_pixels if mask is None else mask
    return mask | recording.bad_pixels
