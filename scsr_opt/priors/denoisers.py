"""Denoisers for `PlugAndPlay` and `RED`: NumPy functions made callable from a jitted loop, and some of scikit-image.

A denoiser is any callable (image, σ) → image, σ being the standard deviation of the noise to be removed, a scalar
array in the picture's unit. One written in JAX can be given as it is; if it is an Equinox module (a network) its
arrays are arguments of the compiled loop and may change without compiling anew.

The functions that make one remember what they made: the same settings give the same denoiser, and with it what has
been compiled for it.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scsr_opt._kernels.programs import compiled
from scsr_opt._validation import iteration_count, positive
from scsr_opt.errors import InputError

Denoiser = Callable[[Float[Array, "H W"], Float[Array, ""]], Float[Array, "H W"]]


class NumpyDenoiser(eqx.Module):
    """A denoiser that runs as a NumPy function on the host, called back from the compiled loop.

    It cannot be differentiated, and pictures that `jax.vmap` adds are denoised one after the other. What comes back is
    cast to the picture's dtype; axes of length 1 that the function dropped, as filters of scikit-image do, are put
    back.

    **Arguments:** `function`: (image, σ) → image of the same shape, free of side effects. Two denoisers are the same to
    the compiler if their functions are: make a function once, not anew for each call.

    **Errors:** `InputError` when a call is traced, for a function that raises an error or gives no picture: it is tried
    on a grey one, so that what is wrong is known before the loop runs, wherever in a denoiser the call stands.
    """

    function: Callable[[np.ndarray, float], np.ndarray] = eqx.field(static=True)

    @compiled
    def __call__(self, image: Float[Array, "H W"], sigma: Float[Array, ""]) -> Float[Array, "H W"]:
        def on_host(words: Array, of_sigma: Array) -> np.ndarray:
            picture, level = _numbers(words, image.dtype), _numbers(of_sigma, sigma.dtype)
            result = np.ascontiguousarray(self.on_numpy(picture, float(level)), dtype=image.dtype)
            return result[..., None].view(np.uint32) if result.dtype == np.float64 else result

        _try(lambda: self.on_numpy(np.full(image.shape, 0.5, image.dtype), 0.1), image.shape)
        words = _words(image)
        like = jax.ShapeDtypeStruct(words.shape, words.dtype)
        denoised = jax.pure_callback(on_host, like, words, _words(sigma), vmap_method="sequential")
        return jax.lax.bitcast_convert_type(denoised, image.dtype)

    def on_numpy(self, picture: Float[np.ndarray, "H W"], sigma: float) -> Float[np.ndarray, "H W"]:
        """The function's picture. **Raises:** `InputError` if it is no picture of this shape."""
        found = np.asarray(self.function(picture, sigma))
        if found.shape == np.squeeze(picture).shape:
            found = found.reshape(picture.shape)
        if found.shape != picture.shape or found.dtype.kind != "f":
            raise InputError(_no_picture(f"{found.dtype} of shape {found.shape}", picture.shape))
        return found


def check_denoiser(denoiser: Denoiser, shape: tuple[int, int]) -> None:
    """Tries a denoiser before a solve, on shapes alone but for a `NumpyDenoiser`, which tries its function.

    **Raises:** `InputError` if it cannot be called, raises an error, or gives no picture of this shape.
    """
    image, sigma = jax.ShapeDtypeStruct(shape, np.float32), jax.ShapeDtypeStruct((), np.float32)
    _try(lambda: jax.eval_shape(functools.partial(denoised, denoiser), image, sigma), shape)


def _try(call: Callable[[], object], shape: tuple[int, ...]) -> None:
    """Calls a denoiser. **Raises:** `InputError` for any error, on a picture of this shape."""
    try:
        call()
    except InputError:
        raise
    except Exception as error:  # whatever a function of the user raises
        raise InputError(
            f"The denoiser raised {type(error).__name__} for a picture of shape {shape} ({_reason(error)}); it must be "
            f"callable as denoiser(image, sigma) and give a float array of that shape."
        ) from error


def _reason(error: Exception) -> str:
    """First line of what an error says."""
    return str(error).strip().split("\n")[0].rstrip(".")


def denoised(denoiser: Denoiser, image: Float[Array, "H W"], sigma: Float[Array, ""]) -> Float[Array, "H W"]:
    """The picture, denoised, in the picture's dtype.

    **Errors:** `InputError` where it cannot be called with JAX arrays, or gives no picture of this shape.
    """
    try:
        result = denoiser(image, sigma)
    except TypeError as error:  # those of JAX for what it cannot trace are among them
        raise InputError(
            f"The denoiser cannot be called as denoiser(image, sigma) with arrays of JAX ({_reason(error)}); a "
            "function of NumPy arrays has to be wrapped: NumpyDenoiser(function)."
        ) from error
    shape, dtype = getattr(result, "shape", None), getattr(result, "dtype", None)
    if shape is None or dtype is None:
        raise InputError(_no_picture(type(result).__name__, image.shape))
    if shape != image.shape or not jnp.issubdtype(dtype, jnp.floating):
        raise InputError(_no_picture(f"{dtype} of shape {shape}", image.shape))
    return jnp.asarray(result, image.dtype)


def _no_picture(found: str, shape: tuple[int, ...]) -> str:
    return f"The denoiser gave {found} for a picture of shape {shape}; it must give a float array of that shape."


def _words(numbers: Array) -> Array:
    """Float64 as words of 32 bits, two for each number, and all else as it is.

    A call-back may have a thread of its own, where `jax.enable_x64` as a context does not hold, and JAX makes float32
    of float64 that goes in or out there. Of words it makes nothing else.
    """
    return jax.lax.bitcast_convert_type(numbers, np.uint32) if numbers.dtype == np.float64 else numbers


def _numbers(words: Array, dtype: np.dtype) -> np.ndarray:
    """The numbers that `_words` were made of."""
    array = np.ascontiguousarray(words)
    return array.view(dtype)[..., 0] if dtype == np.float64 else array.reshape(words.shape)


@functools.cache
def nl_means(patch_size: int = 5, patch_distance: int = 6, cut_off: float | int = 0.8) -> NumpyDenoiser:
    """Non-local means: each pixel becomes a mean of those whose surroundings look alike (Buades, Coll, Morel, 2005), by
    `skimage.restoration.denoise_nl_means` in its fast form (Darbon et al., 2008). For texture that repeats.

    **Arguments:** `patch_size` and `patch_distance` in pixels; `cut_off`: how unlike still counts, in units of σ.

    **Errors:** `InputError` for sizes that are not whole and positive, or a cut-off that is not positive.
    """
    size = iteration_count("nl_means", patch_size, "pixels of patch size")
    distance = iteration_count("nl_means", patch_distance, "pixels of patch distance")
    cut_off = positive("nl_means", "the cut-off", cut_off)

    def denoise(image: np.ndarray, sigma: float) -> np.ndarray:
        from skimage.restoration import denoise_nl_means

        return denoise_nl_means(image, size, distance, h=cut_off * sigma, sigma=sigma)

    return NumpyDenoiser(denoise)


@functools.cache
def bilateral(spread: float | int = 1.5, contrast: float | int = 2.0) -> NumpyDenoiser:
    """Bilateral filter: a mean over pixels near both in place and in intensity (Tomasi and Manduchi, 1998), by
    `skimage.restoration.denoise_bilateral`.

    **Arguments:** `spread`: standard deviation in place, pixels; `contrast`: that in intensity, in units of σ.

    **Errors:** `InputError` for values that are not positive.
    """
    spread = positive("bilateral", "the spread", spread)
    contrast = positive("bilateral", "the contrast", contrast)

    def denoise(image: np.ndarray, sigma: float) -> np.ndarray:
        from skimage.restoration import denoise_bilateral

        # It takes pictures that are nowhere negative only.
        lowest = image.min()
        filtered = denoise_bilateral(
            image - lowest, sigma_color=contrast * sigma, sigma_spatial=spread, mode="symmetric"
        )
        return filtered + lowest

    return NumpyDenoiser(denoise)


@functools.cache
def tv_chambolle(iterations: int = 200) -> NumpyDenoiser:
    """The proximal step of σ²·TV by `skimage.restoration.denoise_tv_chambolle` (Chambolle, 2004): what
    `PlugAndPlay` with it does is `TotalVariation` calculated by another library, much slower. For comparison.

    **Arguments:** `iterations` ≥ 1.

    **Errors:** `InputError` for fewer than one iteration.
    """
    iterations = iteration_count("tv_chambolle", iterations, "iterations")

    def denoise(image: np.ndarray, sigma: float) -> np.ndarray:
        from skimage.restoration import denoise_tv_chambolle

        return denoise_tv_chambolle(image, weight=sigma**2, eps=0, max_num_iter=iterations)

    return NumpyDenoiser(denoise)
