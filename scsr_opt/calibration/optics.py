"""The lens from the recording: how wide a Gaussian explains pixels that were not used.

Blur and picture are separated by prediction. Some sensor pixels are held out, the picture is solved for from the
others with the blur H(σ), and its value at the held-out pixels is compared with what they measured (cross-validation;
Reeves & Mersereau, 1992, chose blurs like that). A σ that is too large cannot reproduce edges, and its error rises
steeply; one that is too small leaves the blur to the picture, which only makes the picture a little harder to
interpolate, and its error hardly rises. So not the smallest error is taken but the largest σ whose error is not
significantly above it (one standard error of the paired differences; Breiman et al., 1984).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scsr_opt.calibration.settings import OpticsSettings
from scsr_opt.errors import InputError
from scsr_opt.operators.blur import Blur
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.losses import residuals
from scsr_opt.operators.sampling import PlacedSamples, accumulate


class GaussianOptics(NamedTuple):
    """Result of `estimate_gaussian_optics`.

    **Fields:**
    - `sigma`: standard deviation of the lens's blur, SENSOR pixels; times the scale for `Blur.gaussian`.
    - `tried`: the standard deviations that were tried. `errors`: mean squared prediction error of each, relative to the
      smallest. `significant`: its standard error, in the same unit.
    """

    sigma: float
    tried: Float[np.ndarray, " n"]
    errors: Float[np.ndarray, " n"]
    significant: Float[np.ndarray, " n"]


def estimate_gaussian_optics(
    placed: PlacedSamples,
    pixel: Array,
    solve: Callable[[DataTerm], Float[Array, "H W"]],
    *,
    tried: Sequence[float | int] = OpticsSettings().sigmas_px,
    share: float = OpticsSettings().held_out_share,
    seed: int = 0,
) -> GaussianOptics:
    """The Gaussian blur of the lens, from samples of one recording.

    The scene has to move by a few sensor pixels, or the pixels beside a held-out one have not seen what it saw, and it
    has to have edges. One solve for each σ that is tried.

    **Arguments:**
    - `placed`: samples and where they were taken.
    - `pixel`: (n,), a number for the sensor pixel of each sample (row · w + column).
    - `solve`: the picture from a data term, `lambda term: run(FISTA(), Problem(term, prior, λ), start).image`.
    - `tried`: standard deviations, SENSOR pixels, ascending, at least two.
    - `share` of the pixels that is held out. `seed`: which ones.

    **Returns:** `GaussianOptics`.

    **Raises:** `InputError` if `tried` is not ascending or `share` not between 0 and 1.
    """
    sigmas = np.asarray(tried, np.float64)
    if sigmas.size < 2 or sigmas[0] < 0 or np.any(np.diff(sigmas) <= 0):
        raise InputError(f"tried is {tuple(tried)}, but it must be two or more rising standard deviations from 0 up.")
    if not 0 < share < 1:
        raise InputError(f"share is {share!r}, but it must be between 0 and 1, a share of the pixels.")
    number = np.asarray(pixel)
    out = np.random.default_rng(seed).random(int(number.max(initial=0)) + 1) < share
    held = jnp.asarray(out[number], placed.value.dtype)
    weight = np.asarray(placed.weight * held, np.float64)
    widest = Blur.gaussian(placed.shape, float(sigmas[-1]) * placed.scale)
    error = []
    for sigma in sigmas:
        optics = _gaussian(widest, float(sigma) * placed.scale)
        term = accumulate(placed, robust=1 - held, optics=optics)
        squared = np.asarray(residuals(placed, term.blurred(jnp.asarray(solve(term)))), np.float64) ** 2
        error.append(np.bincount(number, weight * squared)[np.bincount(number, weight) > 0])
    # By pixel, since the samples of a pixel share what is wrong with them.
    errors = np.stack(error)
    mean = errors.mean(1)
    best = int(mean.argmin())
    significant = (errors - errors[best]).std(1) / np.sqrt(max(errors.shape[1], 1))
    excess = (mean - mean[best]) - significant
    above = np.flatnonzero(excess[best + 1 :] > 0)
    if above.size == 0:
        sigma = sigmas[-1]
    else:
        # Between the last σ that is good enough and the next, where the excess becomes significant.
        after = best + 1 + int(above[0])
        share_of_way = -excess[after - 1] / (excess[after] - excess[after - 1])
        sigma = sigmas[after - 1] + share_of_way * (sigmas[after] - sigmas[after - 1])
    unit = mean[best] if mean[best] > 0 else 1.0
    return GaussianOptics(float(sigma), sigmas, mean / unit, significant / unit)


def _gaussian(widest: Blur, sigma: float) -> Blur:
    """A Gaussian in kernels as large as the widest one's, so that nothing is compiled anew for another width."""

    def kernel(of: Float[Array, "kh kw"]) -> Float[Array, "kh kw"]:
        offset = np.arange(of.size) - of.size // 2
        values = np.exp(-0.5 * (offset / max(sigma, 1e-3)) ** 2).reshape(of.shape)
        return jnp.asarray(values / values.sum(), of.dtype)

    return eqx.tree_at(lambda b: b.kernels, widest, tuple(kernel(k) for k in widest.kernels))
