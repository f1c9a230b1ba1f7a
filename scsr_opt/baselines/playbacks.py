"""Playback, enlarged: what one has of a spike recording without super-resolution."""

from typing import SupportsFloat, SupportsIndex

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from scsr_opt.baselines.inputs import clip_of, repaired
from scsr_opt.baselines.settings import DEFAULT
from scsr_opt.camera.playback import stp, tfi, tfp
from scsr_opt.camera.recording import Recording
from scsr_opt.pipeline.clip import Clip
from scsr_opt.report.figures import bicubic


def tfp_bicubic(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
) -> Float[np.ndarray, "H W"]:
    """Spikes counted over 21 frames (`tfp`; Zhu et al. 2019), enlarged by bicubic interpolation.

    **Arguments:**
    - `spikes`: (T, h, w) of 0 and 1, or a `Recording`, whose bad pixels are filled in from their neighbours.
    - `scale`: s ≥ 1, any integer.
    - `key`: frame whose picture is wanted, 0 … T−1; the middle one if not given.
    - `white_rate`: spikes per frame of a pixel at intensity 1; that of the recording, or 0.6, if not given.

    **Returns:** (s·h, s·w) float32, intensity 1 = white; not cut at 0 or 1.

    **Raises:** `InputError` if an argument cannot be used.
    """
    clip, scale = clip_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=DEFAULT.searched_frames)
    return bicubic(tfp_picture(clip), scale)


def tfi_bicubic(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
) -> Float[np.ndarray, "H W"]:
    """The interval that holds the key frame (`tfi`; Zhu et al. 2019), enlarged by bicubic interpolation.

    **Arguments**, **returns**, **raises:** as `tfp_bicubic`. At most 1001 frames around the key frame are searched.
    """
    clip, scale = clip_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=DEFAULT.searched_frames)
    return bicubic(tfi_picture(clip), scale)


def stp_bicubic(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
) -> Float[np.ndarray, "H W"]:
    """Short-term plasticity (`stp`; Zheng et al. 2021), enlarged by bicubic interpolation.

    **Arguments**, **returns**, **raises:** as `tfi_bicubic`.
    """
    clip, scale = clip_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=DEFAULT.searched_frames)
    return bicubic(stp_picture(clip), scale)


def tfp_picture(clip: Clip) -> Float[np.ndarray, "h w"]:
    """`tfp` over 21 frames, or all that there are."""
    return repaired(clip, tfp(clip.spikes, clip.key, white_rate=clip.white_rate))


def tfi_picture(clip: Clip) -> Float[np.ndarray, "h w"]:
    """`tfi`."""
    return repaired(clip, tfi(clip.spikes, clip.key, white_rate=clip.white_rate))


def stp_picture(clip: Clip) -> Float[np.ndarray, "h w"]:
    """`stp`."""
    return repaired(clip, stp(clip.spikes, clip.key, white_rate=clip.white_rate))
