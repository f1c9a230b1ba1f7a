"""A prior about another picture than a flat one."""

from typing import Any

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from scsr_opt._arrays import held
from scsr_opt.errors import InputError
from scsr_opt.priors.bounded import Bounded
from scsr_opt.priors.prior import Prior


class Centred(Prior[Any]):
    """Ψ(X − C): what differs from the picture C costs as much as the prior makes it cost on nothing.

    It is as convex and as steep as Ψ is, for every C, so that all guarantees of the solvers hold; and C is what it
    likes best, wherever C comes from: another exposure, an earlier key frame, a network's guess
    (`learned.networks.restoration`). The proximal step is that of Ψ, moved:

        argmin over X of ½‖X − f‖² + λΨ(X − C)  =  C + argmin over Z of ½‖Z − (f − C)‖² + λΨ(Z).

    It is used by that step alone, also where Ψ has a gradient. λ is not looked for (`reconstruct` needs `strength`), as
    what is left to tell from noise depends on how good C is.

    **Arguments:** `prior` Ψ; `centre` C, (H, W), intensity.

    **Errors:** `InputError` for a centre that is no picture, not finite or of another shape than what is solved for;
    for a prior with bounds, which would hold for X − C: `Bounded(Centred(prior, centre))` has them for X.
    """

    prior: Prior
    centre: Float[Array, "H W"]

    def __init__(self, prior: Prior, centre: ArrayLike):
        if isinstance(prior, Bounded):
            raise InputError(
                "Centred was given a prior that is Bounded, and would bound the difference from the centre; take "
                "Bounded(Centred(prior, centre)) instead."
            )
        picture = held(centre, "The centre")
        if not jnp.issubdtype(picture.dtype, jnp.floating):
            picture = picture.real.astype(jnp.float32)
        wrong = int(jnp.count_nonzero(~jnp.isfinite(picture)))
        if picture.ndim != 2 or wrong:
            raise InputError(
                f"Centred was given a centre of shape {picture.shape} with {wrong} values that are not finite; it "
                "needs a picture (H, W) of finite values."
            )
        self.prior, self.centre = prior, picture

    @property
    def relative_strength(self) -> None:
        """None: λ has to be given."""
        return None

    @property
    def separable(self) -> bool:
        """Whether the centred prior is separable."""
        return self.prior.separable

    def value(self, image: Float[Array, "H W"]) -> Float[Array, ""]:
        """Ψ(image − C)."""
        return self.prior.value(self._apart(image))

    def value_after(self, image: Float[Array, "H W"], state: Any) -> Float[Array, ""]:
        """`value`, where the proximal step has found it."""
        return self.prior.value_after(self._apart(image), state)

    @property
    def has_prox(self) -> bool:
        return self.prior.has_prox

    def check(self, shape: tuple[int, int]) -> None:
        self.prior.check(shape)

    def initial_state(self, image: Float[Array, "H W"]) -> Any:
        """State of Ψ, at image − C."""
        return self.prior.initial_state(self._apart(image))

    def prox(
        self, image: Float[Array, "H W"], strength: Float[ArrayLike, "*pixels"], state: Any
    ) -> tuple[Float[Array, "H W"], Any]:
        """argmin over X of ½‖X − image‖² + strength · Ψ(X − C), and the state of Ψ for the next call."""
        change, state = self.prior.prox(self._apart(image), strength, state)
        return self.centre + change, state

    def _apart(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """image − C. **Raises:** `InputError` if the two have different shapes."""
        if image.shape != self.centre.shape:
            raise InputError(
                f"Centred has a centre of shape {self.centre.shape}, but the picture has shape {image.shape}; give "
                "a centre of the picture's."
            )
        return image - self.centre
