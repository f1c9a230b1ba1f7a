"""Playback followed by super-resolution of that single picture, the pipeline that the paper compares with.

The classical method here is Eq. 4 itself with one still picture, Y the playback:

    minimise over X   ½ ‖D_s X − Y‖² + λ TV(X)

(Marquina and Osher, "Image super-resolution by TV-regularization and Bregman iteration", 2008, without the Bregman
steps; Aly and Dubois, "Image up-sampling using total-variation regularization with a new observation model", 2005, has
the same D_s, the mean over a sensor pixel). Why this and not iterative back-projection (Irani and Peleg, 1991): that
minimises the first term alone from an interpolated start, and playback is noisy, so it has to be stopped by hand before
it fits the noise. It also differs from `reconstruct` with total variation in nothing but the data, so that the
difference between the two is what the many moments of a recording are worth.
"""

from typing import SupportsFloat, SupportsIndex

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.ndimage import convolve

from scsr_opt.baselines.inputs import clip_of
from scsr_opt.baselines.playbacks import stp_picture, tfi_picture, tfp_picture
from scsr_opt.baselines.settings import DEFAULT
from scsr_opt.baselines.solving import solved
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.samples import Samples
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators.sampling import place
from scsr_opt.pipeline.clip import Clip
from scsr_opt.report.figures import bicubic


def tfp_sr(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
) -> Float[np.ndarray, "H W"]:
    """Spikes counted over 21 frames, then super-resolved as a single picture (see the module).

    **Arguments**, **returns**, **raises:** as `tfp_bicubic`; bad pixels are left out instead of filled in.
    """
    clip, scale = clip_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=DEFAULT.searched_frames)
    return _super_resolved(tfp_picture(clip), clip, scale)


def tfi_sr(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
) -> Float[np.ndarray, "H W"]:
    """The interval that holds the key frame, then super-resolved as a single picture (see the module).

    **Arguments**, **returns**, **raises:** as `tfp_sr`.
    """
    clip, scale = clip_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=DEFAULT.searched_frames)
    return _super_resolved(tfi_picture(clip), clip, scale)


def stp_sr(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
) -> Float[np.ndarray, "H W"]:
    """Short-term plasticity, then super-resolved as a single picture (see the module).

    **Arguments**, **returns**, **raises:** as `tfp_sr`.
    """
    clip, scale = clip_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=DEFAULT.searched_frames)
    return _super_resolved(stp_picture(clip), clip, scale)


def _super_resolved(picture: Float[np.ndarray, "h w"], clip: Clip, scale: int) -> Float[np.ndarray, "H W"]:
    height, width = picture.shape
    row, column = (index.ravel().astype(np.int32) for index in np.indices(picture.shape))
    used = np.ones(picture.shape, np.float32) if clip.bad_pixels is None else (~clip.bad_pixels).astype(np.float32)
    now = np.zeros(picture.size, np.float32)
    samples = Samples(row=row, column=column, start=now, stop=now, value=picture.ravel(), weight=used.ravel())
    path = trajectory_of(Motion.none(height, width), key=0, start=0, stop=1)
    placed = place(
        jax.tree.map(jnp.asarray, samples.padded()), path, scale=scale, shape=(scale * height, scale * width)
    )
    strength = DEFAULT.single_image_noise_factor * noise_level(picture) * 2 / scale
    return solved(placed, bicubic(picture, scale), strength)


def noise_level(picture: Float[np.ndarray, "h w"]) -> float:
    """Standard deviation of a picture's noise: the mean absolute response to a filter that is blind to planes and edges
    along the grid (Immerkær, "Fast noise variance estimation", 1996). Fine texture counts as noise, too.

    A mean and not a median, because playbacks have few levels: the median of their differences may well be 0.
    """
    if min(picture.shape) < 3:
        return 0.0
    blind = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    response = convolve(picture, blind)[1:-1, 1:-1]
    return float(np.sqrt(np.pi / 2) * np.abs(response).mean() / 6)
