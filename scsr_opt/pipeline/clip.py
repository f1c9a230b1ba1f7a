"""The frames around a key frame: what a reconstruction sees of a recording."""

from typing import NamedTuple, SupportsFloat, SupportsIndex

import numpy as np
from jaxtyping import Bool, Float, Shaped
from numpy.typing import ArrayLike

from scsr_opt._validation import whole
from scsr_opt.camera.light import Light
from scsr_opt.camera.recording import USUAL_FRAMES, Recording, bad_pixels_of, checked_white_rate


class Clip(NamedTuple):
    """Consecutive frames of a recording with their key frame.

    **Fields:**
    - `spikes`: (T, h, w), 0 and 1; all 0 in bad pixels.
    - `key`: index of the key frame in `spikes`.
    - `white_rate`: spikes per frame of a pixel at intensity 1.
    - `bad_pixels`: (h, w), true where nothing is known; None if nothing is known of any.
    - `start`: frame of the recording that `spikes[0]` is.
    - `dark`: (h, w), intensity that each pixel shows without any light; None for 0.
    - `light`: of each moment, where it changes.
    """

    spikes: Shaped[np.ndarray, "T h w"]
    key: int
    white_rate: float
    bad_pixels: Bool[np.ndarray, "h w"] | None
    start: int = 0
    dark: Float[np.ndarray, "h w"] | None = None
    light: Light | None = None

    @classmethod
    def around(
        cls,
        recording: Recording,
        key: SupportsIndex | None = None,
        *,
        frames: SupportsIndex = USUAL_FRAMES,
        white_rate: SupportsFloat | None = None,
        bad_pixels: ArrayLike | None = None,
    ) -> "Clip":
        """The `frames` frames around the key frame, or all, if the recording has fewer.

        **Arguments:** `key`: a frame of the recording, the middle one if None. `white_rate`: the recording's if None.
        `bad_pixels`: (h, w), added to the recording's own.

        **Raises:** `InputError` if one of them cannot be used.
        """
        key = recording.frames // 2 if key is None else whole(key, "key", 0, recording.frames - 1)
        start, stop = recording.around(key, whole(frames, "frames", 1))
        rate = recording.white_rate if white_rate is None else checked_white_rate(white_rate)
        bad = bad_pixels_of(recording, bad_pixels)
        spikes = recording.window(start, stop)
        if bad is not None:
            spikes[:, bad] = 0  # no later stage reads what a bad pixel fired
        return cls(spikes, key - start, rate, bad, start)

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w) of the sensor."""
        return self.spikes.shape[1], self.spikes.shape[2]

    @property
    def key_frame(self) -> int:
        """The key frame, counted from the recording's first frame."""
        return self.start + self.key

    def without(self, bad: Bool[np.ndarray, "h w"]) -> "Clip":
        """Clip in which these pixels are bad, too."""
        known = bad if self.bad_pixels is None else bad | self.bad_pixels
        spikes = self.spikes.copy()
        spikes[:, bad] = 0
        return self._replace(spikes=spikes, bad_pixels=known)

    def part(self, rows: slice, columns: slice) -> "Clip":
        """Clip of a rectangle of the sensor, with these frames."""
        bad = None if self.bad_pixels is None else self.bad_pixels[rows, columns]
        dark = None if self.dark is None else self.dark[rows, columns]
        light = None if self.light is None else self.light.part(rows, columns)
        return self._replace(spikes=self.spikes[:, rows, columns], bad_pixels=bad, dark=dark, light=light)
