"""Regularisation by denoising: a function whose gradient is what a denoiser takes away."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from scsr_opt._kernels.programs import compiled
from scsr_opt._validation import iteration_count, positive
from scsr_opt.priors.denoisers import Denoiser, check_denoiser, denoised
from scsr_opt.priors.prior import Prior


class RED(Prior[Array]):
    """Ψ(X) = ½ ⟨X, X − D_σ(X)⟩, D a denoiser (Romano, Elad, Milanfar, 2017, "The little engine that could:
    regularization by denoising").

    Where D is locally homogeneous (D(cX) = cD(X) for c near 1), has a symmetric Jacobian and does not increase the
    norm, ∇Ψ = X − D(X) and Ψ is convex. Few denoisers have a symmetric Jacobian (Reehorst and Schniter, 2019,
    "Regularization by denoising: clarifications and new interpretations"); for others the proximal step still solves
    its fixed-point equation, but `value` is then not what it descends on.

    The proximal step is the solution of X − f + λ(X − D(X)) = 0 by `iterations` of X ← (f + λD(X)) / (1 + λ), from the
    result of the last call. Where D is non-expansive, each brings it nearer by λ/(1 + λ) at least, so it is inexact
    for large λ and nearly exact for small. One denoising each, and one more in `value`.

    Unlike in `PlugAndPlay`, σ is chosen apart from λ (a number without unit here), and the result does not depend on a
    solver's step size. For mild denoisers that are to be trusted a little. Where the scene moves, give a strength:
    solves with a small one lose over hundreds of iterations what they seem to have won at first, so that those
    by which λ is validated ask for a quarter of it or less with non-local means (brick by day, a pan: 20 dB; with four
    times as much 32, and Huber-TV 33).

    **Arguments:**
    - `denoiser`: a callable (image, σ) → image, written in JAX, or a `NumpyDenoiser` of `scsr_opt.priors.denoisers`.
    - `sigma`: σ > 0, in the picture's unit; Romano et al. take 0.01 to 0.02.
    - `iterations`: in each proximal step, ≥ 1.

    **Errors:** `InputError` for a σ that is not positive and finite, or fewer than one iteration; from `check`, or when
    it is used, for a denoiser that cannot be called so or gives no picture.
    """

    denoiser: Denoiser
    sigma: float = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    def __init__(self, denoiser: Denoiser, sigma: float | int = 0.02, iterations: int = 2):
        self.denoiser = denoiser
        self.sigma = positive("RED", "sigma", sigma)
        self.iterations = iteration_count("RED", iterations, "iterations")

    @property
    def relative_strength(self) -> float:
        """1.5/σ: λ has no unit here, and the smaller the noise level of a denoiser, the less it takes away. Strengths
        that gave the best pictures were 0.7 to 0.9 times that with the bilateral filter and 1.4 to 2.5 times with
        non-local means, σ from 0.01 to 0.05 (docs/decisions/0015)."""
        return 1.5 / self.sigma

    @compiled
    def value(self, image: Float[Array, "H W"]) -> Float[Array, ""]:
        """½ ⟨image, image − D(image)⟩."""
        return jnp.sum(image * (image - self._denoised(image))) / 2

    def check(self, shape: tuple[int, int]) -> None:
        """Tries the denoiser. **Raises:** as `check_denoiser`."""
        check_denoiser(self.denoiser, shape)

    def initial_state(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """The image: where the fixed-point iteration starts."""
        return image

    @compiled
    def prox(
        self, image: Float[Array, "H W"], strength: Float[ArrayLike, ""], state: Float[Array, "H W"]
    ) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
        """X with X − image + strength·(X − D(X)) = 0, to the accuracy of `iterations` from `state`; and X again."""
        strength = jnp.asarray(strength, image.dtype)

        def advance(_: int | Array, picture: Array) -> Array:
            return (image + strength * self._denoised(picture)) / (1 + strength)

        result = jax.lax.fori_loop(0, self.iterations, advance, state)
        return result, result

    def _denoised(self, image: Array) -> Array:
        return denoised(self.denoiser, image, jnp.asarray(self.sigma, image.dtype))
