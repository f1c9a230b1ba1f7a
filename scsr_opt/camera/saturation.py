"""Pixels that saw more light than they can measure: at most one spike a frame is read out."""

import numpy as np
from jaxtyping import Bool, Int, Shaped

from scsr_opt.camera.spike_times import BYTE_FRAMES, as_bytes

SATURATED_SHARE = 0.9
"""Share of the frames in which a saturated pixel fires: it is as bright as can be measured, or brighter."""


def spike_counts(spikes: Shaped[np.ndarray, "T h w"]) -> Int[np.ndarray, "h w"]:
    """Number of spikes of each pixel, (h, w)."""
    count = np.zeros(spikes.shape[1:], np.int32)
    for start in range(0, len(spikes), BYTE_FRAMES):
        count += np.add.reduce(as_bytes(spikes[start : start + BYTE_FRAMES]), axis=0, dtype=np.uint8)
    return count


def saturated(
    count: Int[np.ndarray, "*shape"], frames: int, bad_pixels: Bool[np.ndarray, "*shape"] | None = None
) -> Bool[np.ndarray, "*shape"]:
    """True where the light is known from below only: pixels that fired in 90 % of the frames or more.

    One spike of the count is the charge that was there before the first frame. Without it a pixel of intensity 1 that
    happens to fire in all of a few frames would be called saturated; in under 10 frames none is.

    **Arguments:** `count`: spikes of each pixel in `frames` frames; `bad_pixels`: true where they are not used.
    """
    many = count - 1 >= SATURATED_SHARE * frames
    return many if bad_pixels is None else many & ~bad_pixels


def share_saturated(
    count: Int[np.ndarray, "*shape"], frames: int, bad_pixels: Bool[np.ndarray, "*shape"] | None = None
) -> float:
    """The share of the pixels, without the bad ones, that are `saturated`; 0 if there are no others."""
    good = count.size if bad_pixels is None else int(np.count_nonzero(~bad_pixels))
    return int(np.count_nonzero(saturated(count, frames, bad_pixels))) / max(good, 1)


def said_of(share: float) -> str:
    """In words, for people, what a share of saturated pixels above 0 means."""
    percent = f"{100 * share:.{0 if share >= 0.1 else 1}f} %" if share >= 1e-3 else "under 0.1 %"
    return (
        f"{percent} of the pixels fired in {100 * SATURATED_SHARE:g} % of the frames or more, and may have seen more "
        f"light than they can tell: brightness there is a lower bound"
    )
