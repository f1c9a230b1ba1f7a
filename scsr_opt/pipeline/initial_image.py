"""X^(0): the picture that a solve starts from, by playback."""

import numpy as np
from jaxtyping import Array, Float

from scsr_opt._kernels.device import on_device
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
        rate = interval_rates(clip.spikes, edges, white_rate=clip.white_rate, light=clip.light)
    else:
        rate = clip.spikes / np.float32(clip.white_rate)
    picture = rate[0].astype(np.float32)
    if bad is not None and bad.any():
        picture = np.asarray(filled(picture, ~bad))
    down, right = (_enlarging(*lengths, sharp=sharp) for lengths in zip(picture.shape, shape, strict=True))
    return on_device(down @ picture @ right.T)


def _enlarging(length: int, to: int, *, sharp: bool) -> Float[np.ndarray, "to length"]:
    """Weights of a row's pixels in those of the enlarged row: linear, or those of Lanczos' window of 3 pixels a side.
    By NumPy, as once for a picture, and the same as `jax.image.resize`, which compiles a program for each size."""
    distance = (np.arange(to)[:, None] + 0.5) * length / to - 0.5 - np.arange(length)
    if sharp:
        weights = np.where(np.abs(distance) < 3, np.sinc(distance) * np.sinc(distance / 3), 0)
    else:
        weights = np.maximum(1 - np.abs(distance), 0)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)
