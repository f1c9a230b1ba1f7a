"""A network that restores solutions of Eq. 4, for a prior to be centred at.

A convex prior cannot tell an edge that a solution has lost from one that was never there. A network that was trained on
many solutions and their truths sometimes can. Its picture X̂ is not the result: it becomes the centre of the ridge
regulariser (`scsr_opt.priors.Centred`), and Eq. 4 is solved once more,

    minimise over X of f(X) + λ Ψ(X − X̂),

a convex problem with the guarantees that it had, whatever the network returns: contradicting the data costs, and the
network decides only what the data leave open. `reconstruct(…, quality="best")` is both solves.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from learned.networks.layers import ResidualBlocks, check_sizes, convolution, fold, leaky, unfold
from scsr_opt.errors import InputError
from scsr_opt.pipeline.restoration import Solved


@dataclasses.dataclass(frozen=True)
class RestorationConfig:
    """Sizes of a `RestorationNet`.

    **Fields:**
    - `scale`: of the solutions that it was trained on.
    - `channels`, `blocks`: features, and residual blocks that work on them, at each level.
    - `levels`: resolutions at which features are worked on; each further one has half as many rows and columns, and
      twice the channels.
    - `folding`: a block of `folding` × `folding` pixels becomes channels of one, at the first level.
    - `views`: 1, 2 or 4 mirror images of a solution (itself included) whose pictures `restored` averages. Training uses
      the solution alone.
    - `sees_data`: the network sees `Solved.change` and `Solved.weight` beside the picture.
    - `contrast`: of pictures, `usual_change`: of `Solved.change` (both intensity), and `usual_strength`, a common λ:
      inputs are divided by them to be about 1.
    - `least_strength`: the smallest share of `usual_strength` that the network can distinguish from 0, and of the
      weight of a pixel that was seen all the time.

    **Raises:** `InputError` for a value that is not allowed, with the name of its field.
    """

    scale: int
    channels: int = 48
    blocks: int = 6
    levels: int = 1
    folding: int = 4
    views: int = 1
    sees_data: bool = False
    contrast: float = 0.25
    usual_change: float = 0.05
    usual_strength: float = 4e-4
    least_strength: float = 1e-3

    def __post_init__(self):
        check_sizes(self, scale=1, channels=1, blocks=0, levels=1, folding=1, views=1)
        if self.views not in (1, 2, 4):
            raise InputError(f"views is {self.views}; it must be 1, 2 or 4.")


# Whether rows, and columns, of a view are in reverse order.
_MIRRORED = ((False, False), (True, True), (False, True), (True, False))


class Pyramid(eqx.Module):
    """Residual blocks at several resolutions: down by convolutions with a stride of 2, back up by folded pixels, each
    level added to what it was before (as Ronneberger, Fischer, Brox, 2015, and with sums as Zhang et al., 2021).

    **Arguments:** `channels`, of the first level; `blocks`, at each level on the way down and up; `levels`, 2 or more.
    """

    before: tuple[ResidualBlocks, ...]
    down: tuple[eqx.nn.Conv2d, ...]
    lowest: ResidualBlocks
    up: tuple[eqx.nn.Conv2d, ...]
    after: tuple[ResidualBlocks, ...]

    def __init__(self, channels: int, blocks: int, levels: int, *, key: PRNGKeyArray):
        wide = [channels * 2**level for level in range(levels)]
        keys = iter(jax.random.split(key, 4 * levels))
        self.before = tuple(ResidualBlocks(width, blocks, key=next(keys)) for width in wide[:-1])
        self.down = tuple(convolution(width, 2 * width, size=2, stride=2, key=next(keys)) for width in wide[:-1])
        self.lowest = ResidualBlocks(wide[-1], blocks, key=next(keys))
        self.up = tuple(convolution(2 * width, 4 * width, size=1, key=next(keys)) for width in wide[:-1])
        self.after = tuple(ResidualBlocks(width, blocks, key=next(keys)) for width in wide[:-1])

    def __call__(self, x: Float[Array, "c h w"]) -> Float[Array, "c h w"]:
        """`h` and `w` are multiples of 2^(levels − 1)."""
        kept = []
        for blocks, down in zip(self.before, self.down, strict=True):
            x = blocks(x)
            kept.append(x)
            x = down(x)
        x = self.lowest(x)
        for up, blocks, there in zip(self.up[::-1], self.after[::-1], kept[::-1], strict=True):
            x = blocks(there + unfold(up(x), 2))
        return x


class RestorationNet(eqx.Module):
    """X̂: a solution plus what a convolution, residual blocks and a convolution make of it, of what the data would
    change of it, and of the λ it has.

    The picture is folded, so that the convolutions are cheap and see far (as Lim et al., 2017, work at low resolution).
    It starts near the identity.

    **Arguments:** `config`: the sizes; `key`: of the random first weights.
    """

    entry: eqx.nn.Conv2d
    body: ResidualBlocks | Pyramid
    output: eqx.nn.Conv2d
    config: RestorationConfig = eqx.field(static=True)

    def __init__(self, config: RestorationConfig, *, key: PRNGKeyArray):
        entry, body, output = jax.random.split(key, 3)
        pixels, (channels, blocks, levels) = config.folding**2, (config.channels, config.blocks, config.levels)
        pictures = 3 if config.sees_data else 1
        self.entry = convolution(pictures * pixels + 1, channels, key=entry)
        several = levels > 1
        self.body = (
            Pyramid(channels, blocks, levels, key=body) if several else ResidualBlocks(channels, blocks, key=body)
        )
        self.output = convolution(channels, pixels, shrink=0.1, key=output)
        self.config = config

    def __call__(self, solved: Solved) -> Float[Array, "H W"]:
        """X̂, (H, W), intensity."""
        config, image = self.config, solved.image
        (rows, columns), factor = image.shape, config.folding
        pictures = [(image - jnp.mean(image)) / config.contrast]
        if config.sees_data:
            weight = jnp.maximum(solved.weight, config.least_strength)
            pictures += [solved.change / config.usual_change, jnp.log(weight)]
        unit = factor * 2 ** (config.levels - 1)
        whole = jnp.pad(jnp.stack(pictures), ((0, 0), (0, -rows % unit), (0, -columns % unit)), mode="edge")
        folded = fold(whole, factor)
        share = jnp.maximum(jnp.asarray(solved.strength, image.dtype) / config.usual_strength, config.least_strength)
        noise = jnp.full_like(folded[:1], jnp.log(share))
        known = jnp.concatenate([folded, noise]).astype(self.entry.weight.dtype)
        change = self.output(leaky(self.body(leaky(self.entry(known)))))
        return image + config.contrast * unfold(change, factor)[0, :rows, :columns].astype(image.dtype)


@dataclasses.dataclass(frozen=True)
class NetworkRestoration:
    """A network in the place that `scsr_opt` has for one (`scsr_opt.pipeline.restoration.Restoration`).

    **Fields:** `net`; `strength_ratio`, λ of the second solve over that of the first: 1 to 4 differ by 0.01 dB, as the
    restored picture agrees with the data.
    """

    net: RestorationNet
    strength_ratio: float = 2.0

    def __call__(self, solved: Solved) -> Float[Array, "H W"]:
        """X̂, (H, W), intensity."""
        return restored(self.net, solved)


def restored(net: RestorationNet, solved: Solved) -> Float[Array, "H W"]:
    """The mean of the pictures that `net` makes of a solution and of its mirror images, each mirrored back.

    A mirrored scene is as likely as the scene, but the network treats the two a little differently. Errors in which the
    pictures differ are averaged: by 2 views 0.04 to 0.05 dB are gained, by 4 views 0.06 to 0.09 dB.
    """
    pictures = [_mirrored(net, solved, np.array(axes)) for axes in _MIRRORED[: net.config.views]]
    return sum(pictures[1:], pictures[0]) / len(pictures)


@eqx.filter_jit
def _mirrored(net: RestorationNet, solved: Solved, turned: Bool[Array | np.ndarray, "2"]) -> Float[Array, "H W"]:
    """`net` of the solution with its rows, columns, or both, in reverse order, put back into order.

    All views use one program, called once for each: in a loop of JAX's, XLA's convolutions took 200 times as long on a
    CPU, and side by side the views need as much more memory.
    """

    def mirror(picture: Float[Array, "H W"]) -> Float[Array, "H W"]:
        for axis, turn in enumerate(turned):
            picture = jnp.where(turn, jnp.flip(picture, axis), picture)
        return picture

    image, change, weight, strength = solved
    return mirror(net(Solved(mirror(image), mirror(change), mirror(weight), strength)))


def restoration_loss(picture: Float[Array, "H W"], truth: Float[Array, "H W"], border: int) -> Float[Array, ""]:
    """ln of the mean square error without `border` pixels at each side: every scene counts by its decibels.

    Errors below 60 dB do not count any more.
    """
    inner = slice(border, -border or None)
    error = (picture - truth.astype(picture.dtype))[inner, inner]
    return jnp.log(jnp.mean(error**2) + 1e-6)
