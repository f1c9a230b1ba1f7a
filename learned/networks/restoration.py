"""A network that restores solutions of Eq. 4, for a prior to be centred at.

A convex prior cannot tell an edge that a solution has lost from one that was never there. A network that was trained on
many solutions and their truths sometimes can. Its picture X̂ is not the result: it becomes the centre of the ridge
regulariser (`scsr_opt.priors.Centred`), and Eq. 4 is solved once more,

    minimise over X of f(X) + λ Ψ(X − X̂),

a convex problem with the guarantees that it had, whatever the network returns: contradicting the data costs, and the
network decides only what the data leave open. The model `ridge-centred` of `learned.zoo` is both solves.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PRNGKeyArray

from learned.networks.layers import ResidualBlocks, check_sizes, convolution, fold, leaky, unfold
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser


def first_prior() -> Prior:
    """Ψ of the solutions that are restored: the convex ridge regulariser, at every scale."""
    return RidgeRegulariser.load("convex")


@dataclasses.dataclass(frozen=True)
class RestorationConfig:
    """Sizes of a `RestorationNet`.

    **Fields:**
    - `scale`: of the solutions that it was trained on.
    - `channels`, `blocks`: features, and residual blocks that work on them.
    - `folding`: a block of `folding` × `folding` pixels becomes channels of one.
    - `contrast`: of pictures (intensity), and `usual_strength`, a common λ: inputs are divided by them to be about 1.
    - `least_strength`: the smallest share of `usual_strength` that the network can distinguish from 0.

    **Raises:** `InputError` for a value that is not allowed, with the name of its field.
    """

    scale: int
    channels: int = 48
    blocks: int = 6
    folding: int = 4
    contrast: float = 0.25
    usual_strength: float = 4e-4
    least_strength: float = 1e-3

    def __post_init__(self):
        check_sizes(self, scale=1, channels=1, blocks=0, folding=1)


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
        (rows, columns), config, factor = image.shape, self.config, self.config.folding
        whole = jnp.pad(image, ((0, -rows % factor), (0, -columns % factor)), mode="edge")
        folded = fold((whole - jnp.mean(image))[None] / config.contrast, factor)
        share = jnp.maximum(jnp.asarray(strength, image.dtype) / config.usual_strength, config.least_strength)
        noise = jnp.full_like(folded[:1], jnp.log(share))
        known = jnp.concatenate([folded, noise]).astype(self.entry.weight.dtype)
        change = self.output(leaky(self.body(leaky(self.entry(known)))))
        return image + config.contrast * unfold(change, factor)[0, :rows, :columns].astype(image.dtype)


@eqx.filter_jit
def restored(net: RestorationNet, image: Float[Array, "H W"], strength: Float[ArrayLike, ""]) -> Float[Array, "H W"]:
    """`net(image, strength)`, compiled."""
    return net(image, strength)


def restoration_loss(picture: Float[Array, "H W"], truth: Float[Array, "H W"], border: int) -> Float[Array, ""]:
    """ln of the mean square error without `border` pixels at each side: every scene counts by its decibels.

    Errors below 50 dB do not count any more.
    """
    inner = slice(border, -border or None)
    error = (picture - truth.astype(picture.dtype))[inner, inner]
    return jnp.log(jnp.mean(error**2) + 1e-5)
