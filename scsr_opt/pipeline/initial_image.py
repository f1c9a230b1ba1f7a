"""X^(0): the picture that a solve starts from, by playback."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scsr_opt.camera.rates import interval_rates
from scsr_opt.motion.estimators.frames import filled
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.settings import SamplingSettings


def initial_image(
    clip: Clip, shape: tuple[int, int], *, sharp: bool = False, settings: SamplingSettings = SamplingSettings()
) -> Float[Array, "H W"]:
    """The firing rate around the key frame, intensity, enlarged to `shape`.

    Enlarged linearly, as the networks were trained with, or by Lanczos' interpolation if `sharp`: what lies between
    sensor pixels is found slowly, and such a start has some of it.
    """
    frames, bad = len(clip.spikes), clip.bad_pixels
    if frames > 1:
        half = (settings.initial_image_frames - 1) / 2
        edges = np.clip(np.array([clip.key - half, clip.key + half]), 0, frames - 1)
        rate = interval_rates(clip.spikes, edges, white_rate=clip.white_rate)
    else:
        rate = clip.spikes / np.float32(clip.white_rate)
    picture = jnp.asarray(rate, jnp.float32)
    if bad is not None and bad.any():
        picture = filled(picture, ~bad)
    return jax.image.resize(picture[0], shape, "lanczos3" if sharp else "linear")
