"""The optical point-spread function H of Eq. 2 as an explicit convolution."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from scsr_opt._arrays import as_array
from scsr_opt.errors import InputError
from scsr_opt.operators.operator import LinearOperator, picture_shape


class Blur(LinearOperator):
    """Convolution with a point-spread function (PSF): output(p) = Σ_q psf(q) input(p − q), q from the PSF's centre.

    A point of light becomes the PSF, unmirrored. The PSF is scaled to sum 1, so a constant picture keeps its value.
    Beyond its border the picture continues as its own mirror image (d c b a | a b c d | d c b a, numpy's `symmetric`):
    no dark frame, and no light is lost for a symmetric PSF. A PSF wider than the picture is allowed; the picture is
    then mirrored repeatedly.

    `Blur(shape, psf)` takes any PSF, `Blur.gaussian(shape, sigma)` makes a Gaussian one that runs as two
    one-dimensional passes. The adjoint is exact, mirror border included. For a PSF that is symmetric along both axes it
    equals the blur itself.

    **Arguments:**
    - `shape`: (H, W) of the picture.
    - `psf`: (kh, kw), both odd, finite, without negative values, with a positive sum; in high-resolution pixels.
      Kept in JAX's default precision.

    **Errors:** `InputError` for a PSF that is not two-dimensional, has an even side, has a negative value (no light
    is negative, and the step sizes of the solvers rest on it), or cannot be scaled to sum 1.
    """

    # Standard deviations: so far away a Gaussian is below 1e-21 of its top, nothing beside it in double precision.
    MOST_TRUNCATE: ClassVar[int] = 10
    # Standard deviation, pixels, that a Gaussian may have on the smallest pictures, too.
    LEAST_WIDEST: ClassVar[int] = 10

    kernels: tuple[Float[Array, "_ _"], ...]
    shape: tuple[int, int] = eqx.field(static=True)

    def __init__(self, shape: tuple[int, int], psf: ArrayLike):
        self.shape = picture_shape(shape, "Blur")
        self.kernels = (_unit_sum(psf),)

    @classmethod
    def gaussian(
        cls, shape: tuple[int, int], sigma: float | int | tuple[float | int, float | int], *, truncate: float | int = 4
    ) -> "Blur":
        """A Gaussian PSF of standard deviation `sigma` (high-resolution pixels; one, or one each for rows and columns).

        It is sampled at the pixel centres out to `truncate` standard deviations and scaled to sum 1, as
        `scipy.ndimage.gaussian_filter(mode="reflect")` does it. `sigma` 0 leaves the picture as it is.

        **Errors:** `InputError` for a `sigma` that is neither one number nor two, that is negative, or above 10 and the
        longer side of the picture (all of which then goes to every pixel alike), or a `truncate` that is not from 0
        (excluded) to 10 (beyond which nothing is left in double precision).
        """
        if np.shape(sigma) not in ((), (2,)):
            raise InputError(
                f"Blur.gaussian was given sigma of shape {np.shape(sigma)}; it is one number, or one each for rows and "
                "columns."
            )
        rows, columns = np.broadcast_to(np.asarray(sigma, float), 2).tolist()
        most = max(*picture_shape(shape, "Blur"), cls.LEAST_WIDEST)
        down, right = _gaussian(rows, truncate, most), _gaussian(columns, truncate, most)
        passes = [kernel for kernel in (down[:, None], right[None, :]) if kernel.size > 1]
        return cls._of_passes(shape, passes)

    @classmethod
    def _of_passes(cls, shape: tuple[int, int], kernels: Sequence[np.ndarray]) -> "Blur":
        blur = cls(shape, np.ones((1, 1)))
        return eqx.tree_at(lambda b: b.kernels, blur, tuple(_unit_sum(kernel) for kernel in kernels))

    @property
    def input_shape(self) -> tuple[int, int]:
        return self.shape

    @property
    def output_shape(self) -> tuple[int, int]:
        return self.shape

    def _forward(self, x: Float[Array, "H W"]) -> Float[Array, "H W"]:
        for kernel in self.kernels:
            x = _convolve(x, kernel.astype(x.dtype))
        return x

    def _adjoint(self, y: Float[Array, "H W"]) -> Float[Array, "H W"]:
        # Transposed by JAX: each tap becomes an addition in place, and the mirror border folds back by itself.
        (x,) = jax.linear_transpose(self._forward, jax.ShapeDtypeStruct(self.shape, y.dtype))(y)
        return x


def _convolve(x: Float[Array, "H W"], kernel: Float[Array, "kh kw"]) -> Float[Array, "H W"]:
    rows, columns = kernel.shape
    mirrored = jnp.pad(x, ((rows // 2, rows // 2), (columns // 2, columns // 2)), mode="symmetric")

    # Checkpointed, because a derivative in the kernel would otherwise keep one shifted picture per tap.
    @jax.checkpoint
    def add_tap(total: Float[Array, "H W"], tap: tuple[Array, Array, Array]):
        row, column, weight = tap
        return total + weight * jax.lax.dynamic_slice(mirrored, (row, column), x.shape), None

    # A loop over taps beats `lax.conv_general_dilated` (one channel, CPU) by 20 to 40 times, and its transpose is as
    # fast as itself, which is not so for an unrolled sum of slices.
    row, column = (index.reshape(-1).astype(np.int32) for index in np.indices(kernel.shape))
    total, _ = jax.lax.scan(add_tap, jnp.zeros_like(x), (row, column, kernel[::-1, ::-1].reshape(-1)))
    return total


def _gaussian(sigma: float | int, truncate: float | int, most: int) -> Float[np.ndarray, " k"]:
    if not 0 <= sigma <= most:
        raise InputError(
            f"Blur.gaussian was given sigma {sigma}; it is a standard deviation in pixels, for this picture from 0 to "
            f"{most}."
        )
    if not 0 < truncate <= Blur.MOST_TRUNCATE:
        raise InputError(
            f"Blur.gaussian was given truncate {truncate}; it is a number of standard deviations above 0 and at most "
            f"{Blur.MOST_TRUNCATE}."
        )
    radius = int(truncate * sigma + 0.5)
    offset = np.arange(-radius, radius + 1)
    kernel = np.exp(-0.5 * (offset / sigma) ** 2) if radius else np.ones(1)
    return kernel / kernel.sum()


def _unit_sum(psf: ArrayLike) -> Float[Array, "kh kw"]:
    kernel = as_array(psf, "The PSF").astype(np.float64)
    if kernel.ndim != 2 or any(size % 2 == 0 for size in kernel.shape):
        raise InputError(
            f"Blur was given a PSF of shape {kernel.shape}; it needs two odd sides, so that there is a centre: "
            "pad it with zeros."
        )
    total = kernel.sum()
    if not np.all(np.isfinite(kernel)) or not total > 0:
        raise InputError(f"Blur was given a PSF that sums to {total:g}; it needs finite values with a positive sum.")
    if kernel.min() < 0:
        raise InputError(
            f"Blur was given a PSF with a value of {kernel.min():g}; light is never negative: cut it off at 0."
        )
    return jnp.asarray(kernel / total)
