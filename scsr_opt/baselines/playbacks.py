"""Playback, enlarged: what one has of a spike recording without super-resolution."""

from typing import SupportsFloat, SupportsIndex

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from scsr_opt.baselines.inputs import Part, part_of
from scsr_opt.camera.playback import stp, tfi, tfp
from scsr_opt.camera.recording import Recording
from scsr_opt.report.figures import bicubic

# Frames that a playback is given: enough to find the spikes next to the key frame of a pixel that fires 300 times less
# often than white.
SEARCHED = 1001


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

    **Raises:** `InputError` if something handed in cannot be used.
    """
    part = part_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=SEARCHED)
    return bicubic(tfp_picture(part), part.scale)


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
    part = part_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=SEARCHED)
    return bicubic(tfi_picture(part), part.scale)


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
    part = part_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=SEARCHED)
    return bicubic(stp_picture(part), part.scale)


def tfp_picture(part: Part) -> Float[np.ndarray, "h w"]:
    """`tfp` over 21 frames, or all that there are."""
    return part.repaired(tfp(part.spikes, part.key, white_rate=part.white_rate))


def tfi_picture(part: Part) -> Float[np.ndarray, "h w"]:
    """`tfi`."""
    return part.repaired(tfi(part.spikes, part.key, white_rate=part.white_rate))


def stp_picture(part: Part) -> Float[np.ndarray, "h w"]:
    """`stp`."""
    return part.repaired(stp(part.spikes, part.key, white_rate=part.white_rate))
