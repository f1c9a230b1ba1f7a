"""Stills as the simulator uses them: linear intensity from 0 to 1, readable between their pixels."""

import functools
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates, spline_filter

from scsr_opt._arrays import as_array
from scsr_opt.errors import InputError

_LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601, as the project's stills were made


def as_intensity(image: Any, what: str = "The picture") -> Float[np.ndarray, "H W"]:
    """`image` as intensity 0..1, float64.

    **Arguments:**
    - `image`: (H, W), or (H, W, 3) and (H, W, 4) in colour, which become luma (ITU-R BT.601; transparency is ignored).
      Floating-point values are taken as they are; uint8 and uint16 are divided by 255 and 65535.
    - `what`: its name in errors.

    **Raises:** `InputError` for another shape or type, and for values that are not finite or outside 0..1.
    """
    array = as_array(image, what)
    if array.ndim not in (2, 3) or 0 in array.shape or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise InputError(
            f"{what} has shape {array.shape}, but a picture is (rows, columns), or (rows, columns, 3) in RGB."
        )
    if array.dtype in (np.uint8, np.uint16):
        array = array / np.float64(np.iinfo(array.dtype).max)
    elif array.dtype.kind != "f":
        raise InputError(
            f"{what} holds values of type {array.dtype}, but a picture is floating-point from 0 to 1, or uint8 or "
            f"uint16: convert it first, for example with array / array.max()."
        )
    array = array.astype(np.float64)
    if array.ndim == 3:
        array = array[:, :, :3] @ _LUMA
    low, high = array.min(), array.max()
    rounding = 1e-6
    if not (low >= -rounding and high <= 1 + rounding):  # true for NaN as well
        raise InputError(
            f"{what} holds values from {low:g} to {high:g}, but intensity is from 0 (black) to 1 (white): scale it to "
            f"that."
        )
    return array.clip(0, 1)


class Picture:
    """A still that can be read anywhere: a cubic spline through the pixel centres, reflected at the edges, cut to 0..1.

    **Arguments:** `image`: see `as_intensity`.
    """

    values: Float[np.ndarray, "H W"]

    def __init__(self, image: Any, what: str = "The picture"):
        self.values = as_intensity(image, what)
        self.values.flags.writeable = False  # it is handed out by scenes that stand still

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.values.shape

    @functools.cached_property
    def _coefficients(self) -> Float[np.ndarray, "H W"]:
        return np.asarray(spline_filter(self.values, order=3, mode="mirror"))

    def at(self, rows: Float[np.ndarray, "*n"], columns: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Intensity at any positions, HR pixels."""
        # Whole frames pass through here: the spline's coefficients are found once, not at every call.
        where = np.stack([rows, columns])
        return map_coordinates(self._coefficients, where, order=3, mode="mirror", prefilter=False).clip(0, 1)

    def grid(self, rows: Float[np.ndarray, " n"], columns: Float[np.ndarray, " m"]) -> Float[np.ndarray, "n m"]:
        """Intensity at every pair of a row and a column: what `at` gives, several times faster."""
        down = _spline_along(self._coefficients, rows)
        return _spline_along(down.T, columns).T.clip(0, 1)


def _spline_along(coefficients: Float[np.ndarray, "n m"], where: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k m"]:
    whole = np.floor(where).astype(int)
    f = (where - whole)[:, None]
    weights = ((1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3)  # times 6
    last = coefficients.shape[0] - 1
    total = np.zeros((where.size, coefficients.shape[1]))
    for tap, weight in enumerate(weights):
        index = np.abs((whole + tap - 1 + last) % max(2 * last, 1) - last)  # reflected about the outermost centres
        total += weight / 6 * coefficients[index]
    return total
