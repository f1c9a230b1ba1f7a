"""What every baseline is handed, checked once and for all in the same way."""

from typing import NamedTuple, SupportsFloat, SupportsIndex

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import ArrayLike

from scsr_opt._kernels.programs import ready
from scsr_opt._validation import picture_shape, whole
from scsr_opt.camera.recording import Recording, checked_white_rate
from scsr_opt.motion.estimators.frames import filled


class Part(NamedTuple):
    """The part of a recording around its key frame that a baseline looks at.

    **Fields:**
    - `spikes`: (T, h, w), 0 and 1; all 0 in bad pixels.
    - `key`: index of the key frame in `spikes`.
    - `scale`: s ≥ 1.
    - `white_rate`: spikes per frame of a pixel at intensity 1.
    - `readout_rate`: spike frames per second.
    - `bad_pixels`: (h, w), true where nothing is known; None if all pixels are good.
    """

    spikes: UInt8[np.ndarray, "T h w"]
    key: int
    scale: int
    white_rate: float
    readout_rate: float
    bad_pixels: Bool[np.ndarray, "h w"] | None

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the picture."""
        return self.scale * self.spikes.shape[1], self.scale * self.spikes.shape[2]

    def repaired(self, picture: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """A playback with its bad pixels filled in from their neighbours."""
        if self.bad_pixels is None or not self.bad_pixels.any():
            return picture
        ready()
        return np.array(filled(jnp.asarray(picture)[None], ~self.bad_pixels)[0])


def part_of(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None,
    white_rate: SupportsFloat | None,
    frames: SupportsIndex,
) -> Part:
    """The `frames` frames around the key frame (fewer, if the recording has fewer), checked.

    **Arguments:** as those of `scsr_opt.reconstruct`; the defaults of `key` and `white_rate`, too.

    **Raises:** `InputError` if one of them cannot be used.
    """
    ready()
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
    scale = whole(scale, "scale", 1)
    picture_shape((recording.height, recording.width), scale)  # fits into memory
    key = recording.frames // 2 if key is None else whole(key, "key", 0, recording.frames - 1)
    rate = recording.white_rate if white_rate is None else checked_white_rate(white_rate)
    start, stop = recording.around(key, whole(frames, "frames", 1))
    stream, bad = recording.window(start, stop), recording.bad_pixels
    if bad is not None:
        stream[:, bad] = 0  # whatever they fired, nothing after this line knows
    return Part(stream, key - start, scale, rate, recording.readout_rate, bad)
