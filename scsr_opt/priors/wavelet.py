"""Few large wavelet coefficients: the undecimated Haar transform and the ℓ1 norm of its details."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scsr_opt._validation import iteration_count
from scsr_opt.priors.analysis import Analysis


class WaveletL1(Analysis[Array]):
    """Ψ(X) = Σ_j 4^(−j) ‖W_j X‖₁ over the levels j = 1 … J, W_j the 3 detail bands of the undecimated Haar transform.

    The transform (Coifman and Donoho, 1995, "Translation-invariant de-noising"; à trous: Holschneider et al., 1989)
    compares on level j the means over neighbouring squares of 2^(j−1) pixels, so this also smooths what is rough on
    scales that total variation, which knows neighbouring pixels alone, does not see. With weights 2^(−j) it would be
    the ℓ1 norm of the orthonormal transform averaged over all shifts of its grid; denoising a photograph with three
    levels, that is 0.5 dB worse at its best λ (the coarse levels then flatten what the fine ones need not touch).
    Against `TotalVariation` it has a term for checkered differences, and no preferred corner.

    The picture is continued past its borders by its mirror image, so that a border is not an edge. Of what then repeats
    one copy counts, and half of what lies on an axis. K X holds it by its square roots, so that K with the last means
    is exactly Parseval (‖K X‖² + ‖means‖² = ‖X‖²) and ‖K‖ ≤ 1. Bands have one row and one column more than the picture.

    The proximal step is inexact, by dual steps (`Analysis`); the dual variable is 3·levels pictures.

    **Arguments:**
    - `levels`: J ≥ 1.
    - `iterations`: dual steps in each proximal step, ≥ 1.

    **Errors:** `InputError` for fewer than one level or iteration.
    """

    levels: int = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    def __init__(self, levels: int = 2, iterations: int = 5):
        self.levels = iteration_count("WaveletL1", levels, "levels")
        self.iterations = iteration_count("WaveletL1", iterations, "iterations")

    @property
    def relative_strength(self) -> float:
        """π / (1 − 2^(−J)): a straight edge along rows or columns costs 2^(−j−2) on level j, and 4/π of that in the
        mean over its directions, but for the bands of both. Strengths that gave the best pictures were 0.9 to 1.1 times
        as much (docs/decisions/0015)."""
        return math.pi / (1 - 0.5**self.levels)

    @property
    def norm_squared(self) -> float:
        return 1.0

    def analysis(self, image: Float[Array, "H W"]) -> Float[Array, "levels 3 H+1 W+1"]:
        """The detail bands W_j: across rows, across columns, across both."""
        height, width = image.shape
        border = _border(height, width, image.dtype)
        means, bands = image, []
        for level in range(1, self.levels + 1):
            mean_rows, rough_rows = _halves(means, level, axis=0)
            means, columns = _halves(mean_rows, level, axis=1)
            rows, both = _halves(rough_rows, level, axis=1)
            bands.append(jnp.stack([border * band for band in (rows, columns, both)]))
        return jnp.stack(bands)

    def adjoint(self, field: Float[Array, "levels 3 rows columns"]) -> Float[Array, "rows-1 columns-1"]:
        """W* field."""
        *_, height, width = field.shape
        picture = jax.ShapeDtypeStruct((height - 1, width - 1), field.dtype)
        (image,) = jax.linear_transpose(self.analysis, picture)(field)
        return image

    def penalties(self, field: Float[Array, "levels 3 rows columns"]) -> Float[Array, "levels 3 rows columns"]:
        """4^(−j)·|field|, with the other square root of a half at either end of a row or column."""
        return jnp.abs(field) * self._weights(field)

    def conjugates(self, dual: Float[Array, "levels 3 rows columns"]) -> Float[Array, "levels 3 rows columns"]:
        """0: φ is a norm."""
        return jnp.zeros_like(dual)

    def conjugate_prox(
        self, field: Float[Array, "levels 3 rows columns"], step: Float[Array, ""]
    ) -> Float[Array, "levels 3 rows columns"]:
        """The nearest field with values within ± the weights of `penalties`."""
        weights = self._weights(field)
        return jnp.clip(field, -weights, weights)

    def _weights(self, field: Array) -> Float[np.ndarray, "levels 1 rows columns"]:
        *_, height, width = field.shape
        levels = 0.25 ** np.arange(1, self.levels + 1)
        return levels.astype(field.dtype)[:, None, None, None] * _border(height - 1, width - 1, field.dtype)


def _halves(values: Array, level: int, axis: int) -> tuple[Array, Array]:
    """Half the sum and half the difference of values 2^(level−1) apart along an axis, mirrored at its ends.

    A picture is mirrored between its pixels, beyond the last one. Level 1 leaves a row more, whose ends lie on the axes
    themselves, and from there on values are mirrored at those.
    """
    apart = 2 ** (level - 1)
    widths, mode = [(0, 0), (0, 0)], "symmetric" if level == 1 else "reflect"
    widths[axis] = (1, 1) if level == 1 else (apart // 2, apart // 2)
    mirrored = jnp.pad(values, widths, mode=mode)
    size = mirrored.shape[axis]
    first = jax.lax.slice_in_dim(mirrored, 0, size - apart, axis=axis)
    second = jax.lax.slice_in_dim(mirrored, apart, size, axis=axis)
    return (first + second) / 2, (second - first) / 2


def _border(height: int, width: int, dtype: np.dtype) -> Float[np.ndarray, "rows columns"]:
    """1, with √½ on each of the axes at the picture's borders."""
    weights = np.ones((height + 1, width + 1), dtype)
    weights[[0, -1]] *= 0.5**0.5
    weights[:, [0, -1]] *= 0.5**0.5
    return weights
