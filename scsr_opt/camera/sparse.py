"""A sparse grid of a sensor's pixels that lies alike whichever way the sensor is mirrored or turned."""

import numpy as np
from jaxtyping import Int, Shaped


def sparse_pixels(values: Shaped[np.ndarray, "*n h w"], apart: int) -> Shaped[np.ndarray, "*n rows columns"]:
    """The values of one row and column in `apart`, counted from the border inwards on both sides.

    Counted from one side only, a mirrored recording would be judged by other pixels than the recording.
    """
    rows, columns = (_from_both_ends(length, apart) for length in values.shape[-2:])
    return values[..., rows, :][..., columns]


def _from_both_ends(length: int, apart: int) -> Int[np.ndarray, " n"]:
    half = np.arange(0, (length + 1) // 2, apart)
    return np.union1d(half, length - 1 - half)
