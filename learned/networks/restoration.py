"""Solution to sharper picture: what a network knows of the solutions of Eq. 4, for a prior to be centred at.

A convex prior that knows nothing of a scene cannot tell an edge that a solution has lost from one that was never there.
A network that has seen many solutions beside their truths can, at times. Its picture X̂ is not taken for the result: it
becomes the centre of the ridge regulariser (`scsr_opt.priors.Centred`), and Eq. 4 is solved once more,

    minimise over X of f(X) + λ Ψ(X − X̂),

a convex problem with the guarantees that it had, whatever the network says: what contradicts the data costs, and what
the data leave open is the network's. The rung `ridge-centred` of `learned.zoo` is both solves.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PRNGKeyArray

from learned.networks.layers import ResidualBlocks, convolution, fold, leaky, unfold
from scsr_opt.errors import InputError
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser

# A usual λ and the pictures' contrast, by which what the network sees is of the order of 1.
_USUAL, _CONTRAST = 4e-4, 0.25
# λ is told from 0 down to this share of the usual one.
_LEAST = 1e-3
# Mean square errors below this, 50 dB, are as good as none.
_FLOOR = 1e-5


def first_prior() -> Prior:
    """Ψ of the solutions that are restored: the convex ridge regulariser, at every scale."""
    return RidgeRegulariser.load("convex")


@dataclasses.dataclass(frozen=True)
class RestorationConfig:
    """Sizes of a `RestorationNet`.

    **Fields:**
    - `scale`: of the solutions that it was trained on.
    - `channels`, `blocks`: features, and residual blocks that work on them.
    - `folding`: so many pixels each way become channels of one.

    **Raises:** `InputError` for a value that is not allowed, with the name of its field.
    """

    scale: int
    channels: int = 48
    blocks: int = 6
    folding: int = 4

    def __post_init__(self):
        for name, least in (("scale", 1), ("channels", 1), ("blocks", 0), ("folding", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; it must be at least {least}.")


class RestorationNet(eqx.Module):
    """X̂: a solution plus what a convolution, residual blocks and a convolution make of it and of the λ it has.

    The picture is folded, so that the convolutions are cheap and see far (as Lim et al., 2017, work at low resolution).
    It starts near the identity.

    **Arguments:** `config`: the sizes; `key`: of the random first weights.
    """

    entry: eqx.nn.Conv2d
    body: ResidualBlocks
    output: eqx.nn.Conv2d
    config: RestorationConfig = eqx.field(static=True)

    def __init__(self, config: RestorationConfig, *, key: PRNGKeyArray):
        entry, body, output = jax.random.split(key, 3)
        pixels = config.folding**2
        self.entry = convolution(pixels + 1, config.channels, key=entry)
        self.body = ResidualBlocks(config.channels, config.blocks, key=body)
        self.output = convolution(config.channels, pixels, shrink=0.1, key=output)
        self.config = config

    def __call__(self, image: Float[Array, "H W"], strength: Float[ArrayLike, ""]) -> Float[Array, "H W"]:
        """**Arguments:** `image`, a solution, intensity; `strength`, its λ."""
        (rows, columns), factor = image.shape, self.config.folding
        whole = jnp.pad(image, ((0, -rows % factor), (0, -columns % factor)), mode="edge")
        folded = fold((whole - jnp.mean(image))[None] / _CONTRAST, factor)
        share = jnp.maximum(jnp.asarray(strength, image.dtype) / _USUAL, _LEAST)
        noise = jnp.full_like(folded[:1], jnp.log(share))
        known = jnp.concatenate([folded, noise]).astype(self.entry.weight.dtype)
        change = self.output(leaky(self.body(leaky(self.entry(known)))))
        return image + _CONTRAST * unfold(change, factor)[0, :rows, :columns].astype(image.dtype)


@eqx.filter_jit
def restored(net: RestorationNet, image: Float[Array, "H W"], strength: Float[ArrayLike, ""]) -> Float[Array, "H W"]:
    """`net(image, strength)`, compiled."""
    return net(image, strength)


def restoration_loss(picture: Float[Array, "H W"], truth: Float[Array, "H W"], border: int) -> Float[Array, ""]:
    """ln of the mean square error, a border of so many pixels left out: every scene counts by its decibels."""
    inner = slice(border, -border or None)
    error = (picture - truth.astype(picture.dtype))[inner, inner]
    return jnp.log(jnp.mean(error**2) + _FLOOR)
