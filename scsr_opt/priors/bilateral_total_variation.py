"""Differences to more distant neighbours too, the prior that multi-frame super-resolution began with."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scsr_opt._kernels.programs import compiled
from scsr_opt._validation import iteration_count, positive
from scsr_opt.priors.analysis import Analysis


class BilateralTotalVariation(Analysis[Array]):
    """Ψ(X) = Σ_(l,m) α^(|l|+|m|) ‖X − S_lm X‖₁, S_lm the shift by l rows and m columns (Farsiu, Robinson, Elad,
    Milanfar, 2004, "Fast and robust multiframe super resolution").

    (l, m) runs over all shifts with |l|, |m| ≤ radius, each direction once (not also its opposite, which has the same
    differences; the paper's sum leaves some directions out). Pairs of which one pixel is outside the picture do not
    count. Edges of any direction cost about the same. It costs 2·radius·(radius + 1) differences in a dual step, 12 at
    radius 2, each with a dual variable of the size of the picture. Radius 1 with a small α is near anisotropic total
    variation (times α).

    K X are the weighted differences; φ is the ℓ1 norm; ‖K‖² ≤ 4 Σ α^(2|l|+2|m|). The proximal step is inexact, by dual
    steps (`Analysis`).

    **Arguments:**
    - `radius`: of the window of shifts, in pixels, ≥ 1.
    - `decay`: α in (0, 1], the weight of a difference per pixel of its distance.
    - `iterations`: dual steps in each proximal step, ≥ 1.

    **Errors:** `InputError` for other values.
    """

    radius: int = eqx.field(static=True)
    decay: float = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    def __init__(self, radius: int = 2, decay: float | int = 0.6, iterations: int = 10):
        self.radius = iteration_count("BilateralTotalVariation", radius, "pixels of radius")
        self.decay = positive("BilateralTotalVariation", "the decay", decay, most=1)
        self.iterations = iteration_count("BilateralTotalVariation", iterations, "iterations")

    @property
    def _shifts(self) -> list[tuple[int, int, float]]:
        """l ≥ 0, m, and the weight."""
        reach = range(-self.radius, self.radius + 1)
        half = [(rows, columns) for rows in reach for columns in reach if (rows, columns) > (0, 0)]
        return [(rows, columns, self.decay ** (rows + abs(columns))) for rows, columns in half]

    @property
    def relative_strength(self) -> float:
        """One over 2/π Σ α^(|l|+|m|) |(l, m)|, the cost of a straight edge, mean over its directions: 0.25 at radius 2
        and α = 0.6. Strengths that gave the best pictures were 1.1 to 1.5 times as much (docs/decisions/0015)."""
        return math.pi / 2 / sum(weight * math.hypot(rows, columns) for rows, columns, weight in self._shifts)

    @property
    def norm_squared(self) -> float:
        return 4 * sum(weight**2 for _, _, weight in self._shifts)

    def analysis(self, image: Float[Array, "H W"]) -> Float[Array, "shifts H W"]:
        """The weighted differences of each pixel to the one l rows below and m columns to the right; 0 where none."""
        height, width = image.shape

        def difference(rows: int, columns: int, weight: float) -> Array:
            down, right, left = min(rows, height), min(max(columns, 0), width), min(max(-columns, 0), width)
            here = image[: height - down, left : width - right]
            there = image[down:, right : width - left]
            return jnp.pad(weight * (there - here), ((0, down), (left, right)))

        return jnp.stack([difference(*shift) for shift in self._shifts])

    @compiled
    def adjoint(self, field: Float[Array, "shifts H W"]) -> Float[Array, "H W"]:
        """K* field, relying on the zeros of pixels without a partner."""
        reach, shape = self.radius, field.shape[1:]
        rows, columns, weights = (np.asarray(column) for column in zip(*self._shifts, strict=True))

        def add(total: Array, shift: tuple[Array, Array, Array, Array]) -> tuple[Array, None]:
            plane, down, right, weight = shift
            wide = jnp.pad(plane, ((reach, 0), (reach, reach)))
            return total + weight * (jax.lax.dynamic_slice(wide, (reach - down, reach - right), shape) - plane), None

        # A loop, because the compiler would compute a plain sum anew within each of the differences that `analysis`
        # takes of it: 15 times slower at radius 2.
        shifts = (field, jnp.asarray(rows), jnp.asarray(columns), jnp.asarray(weights, field.dtype))
        total, _ = jax.lax.scan(add, jnp.zeros(shape, field.dtype), shifts)
        return total

    def penalties(self, field: Float[Array, "shifts H W"]) -> Float[Array, "shifts H W"]:
        """|field|."""
        return jnp.abs(field)

    def conjugates(self, dual: Float[Array, "shifts H W"]) -> Float[Array, "shifts H W"]:
        """0: φ is a norm."""
        return jnp.zeros_like(dual)

    def conjugate_prox(self, field: Float[Array, "shifts H W"], step: Float[Array, ""]) -> Float[Array, "shifts H W"]:
        """The nearest field with values in [−1, 1]."""
        return jnp.clip(field, -1, 1)
