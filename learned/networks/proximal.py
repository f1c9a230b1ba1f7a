"""The proximal mapping module P (PMM) of SpikeSR-Net: the second line of Eq. 5 by residual blocks."""

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray

from learned.networks.layers import ResidualBlocks, convolution, fold, leaky, unfold


class ProximalModule(eqx.Module):
    """X^(t) = P(R^(t)): what the prior's proximal step is to an optimiser, a denoiser that has learned pictures.

    The picture is folded (`folding` pixels each way into channels; 1 as in the paper), goes through a convolution,
    residual blocks and a convolution, and the result is added to the picture: to change nothing is easy, and the start
    is near it.
    """

    entry: eqx.nn.Conv2d
    body: ResidualBlocks
    output: eqx.nn.Conv2d
    folding: int = eqx.field(static=True)

    def __init__(self, channels: int, blocks: int, folding: int = 1, *, key: PRNGKeyArray):
        entry, body, output = jax.random.split(key, 3)
        self.entry = convolution(folding**2, channels, key=entry)
        self.body = ResidualBlocks(channels, blocks, key=body)
        self.output = convolution(channels, folding**2, shrink=0.1, key=output)
        self.folding = folding

    def __call__(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """**Arguments:** `image`: R^(t), intensity. **Returns:** X^(t)."""
        folded = fold(image[None].astype(self.entry.weight.dtype), self.folding)
        change = self.output(leaky(self.body(leaky(self.entry(folded)))))
        return image + unfold(change, self.folding)[0].astype(image.dtype)
