"""Arguments that all baselines share, checked, and playbacks repaired."""

from typing import SupportsFloat, SupportsIndex

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from scsr_opt._kernels.device import check_device
from scsr_opt._validation import picture_shape, whole
from scsr_opt.camera.recording import Recording
from scsr_opt.motion.estimators.frames import filled
from scsr_opt.pipeline.clip import Clip


def clip_of(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None,
    white_rate: SupportsFloat | None,
    frames: SupportsIndex,
) -> tuple[Clip, int]:
    """The `frames` frames around the key frame (fewer, if the recording has fewer), and the scale, checked.

    **Arguments:** as those of `scsr_opt.reconstruct`; the defaults of `key` and `white_rate`, too.

    **Raises:** `InputError` if one of them cannot be used.
    """
    check_device()
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
    scale = whole(scale, "scale", 1)
    picture_shape((recording.height, recording.width), scale)  # refuses pictures that do not fit into memory
    return Clip.around(recording, key, frames=frames, white_rate=white_rate), scale


def repaired(clip: Clip, picture: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """A playback of the clip with its bad pixels filled in from their neighbours."""
    if clip.bad_pixels is None or not clip.bad_pixels.any():
        return picture
    check_device()
    return np.array(filled(jnp.asarray(picture)[None], ~clip.bad_pixels)[0])
