"""Any denoiser in the place of a proximal step."""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from scsr_opt.priors.denoisers import Denoiser, check_denoiser, denoised
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.strengths import divisible


class PlugAndPlay(Prior[None]):
    """prox(f) := D_σ(f) with σ = √λ, D a denoiser (Venkatakrishnan, Bouman, Wohlberg, 2013, "Plug-and-play priors for
    model based reconstruction"; with proximal gradients Kamilov, Mansour, Wohlberg, 2017).

    A proximal step with strength λ is what a maximum-a-posteriori denoiser does with noise of variance λ; here a
    denoiser that is no such thing stands in for it. In general there is no Ψ: `value` is 0, so that an objective that
    is reported is the data term alone. It need not fall from step to step, and what comes out depends on the step size.
    Proximal-gradient iterations converge where D is averaged (non-expansive, nearly), for instance a filter whose
    weights are held fixed, or a network trained for it; stop others by their number.

    The step is exactly the denoiser. For what denoisers do best: texture that repeats, and pictures like those that a
    network was trained on.

    **Fields:** `denoiser`: a callable (image, σ) → image, written in JAX, or a `NumpyDenoiser` of
    `scsr_opt.priors.denoisers`.

    **Errors:** `InputError` for a denoiser that cannot be called so or gives no picture: from `check`, or when it is
    used.
    """

    denoiser: Denoiser

    @property
    def relative_strength(self) -> None:
        """None: λ is a variance, and how much a denoiser takes away for it is its own affair."""
        return None

    def value(self, image: Float[Array, "H W"]) -> Float[Array, ""]:
        """0: there is none."""
        return jnp.zeros((), image.dtype)

    def check(self, shape: tuple[int, int]) -> None:
        """Tries the denoiser. **Raises:** as `check_denoiser`."""
        check_denoiser(self.denoiser, shape)

    def initial_state(self, image: Float[Array, "H W"]) -> None:
        """Nothing is remembered."""
        return None

    def prox(
        self, image: Float[Array, "H W"], strength: Float[ArrayLike, ""], state: None
    ) -> tuple[Float[Array, "H W"], None]:
        """The image denoised by σ = √strength; as it is where the strength is 0 (below 1e-19 in float32)."""
        off, strength = divisible(strength, image.dtype)
        return jnp.where(off, image, denoised(self.denoiser, image, jnp.sqrt(strength))), None
