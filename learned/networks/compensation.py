"""Moments brought to the key frame along the estimated motion, and sharpened: the base of X^(0) of a network.

Where something moves, its samples fall between those of the key frame, so that several moments together are finer than
any of them: an enlargement without aliasing, blurred by the pixels' aperture and by what fills the gaps
between samples. `compensated` brings moments together, once with few gaps and once with little blur; `Deblurring`
sharpens, as much as motion, noise and light allow.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from learned.networks.encoder import check_blocks
from learned.networks.layers import check_sizes, convolution, leaky
from learned.networks.velocity import Moments, VelocityEstimator, base_moments, refined


class Compensated(NamedTuple):
    """Means and spread of the moments at each point of the key frame.

    **Fields:** all of the picture's size; in intensity but for the last two,
    - `mean`: of the moments, each enlarged (cubic, Keys 1981) at the places where the point was then.
    - `spread`: their standard deviation there: noise, and what the motion does not explain.
    - `near`: mean of the samples around, weighted by how near the middle of their pixel passed the point (a Gaussian of
      0.2 sensor pixels): less blurred than `mean`, but noisy, and like blocks where nothing moves.
    - `nearness`: the sum of these weights; a sample exactly there adds 1.
    - `way`: how far the point moves from the first moment to the last, sensor pixels along each axis.
    """

    mean: Float[Array, "H W"]
    spread: Float[Array, "H W"]
    near: Float[Array, "H W"]
    nearness: Float[Array, "H W"]
    way: Float[Array, "2 H W"]


def compensated(seen: Moments, velocity: Float[Array, "2 h w"], scale: int, reach: float = 0.2) -> Compensated:
    """Moments read where the key frame's points were then: Y_i(q + v(q)·t_i).

    What has left the sensor is left out, but at the moment nearest to the key frame, whose edge is repeated; and so are
    moments that are the same as the one before, at a recording's ends (`spike_blocks`).

    **Arguments:** `velocity`: sensor pixels per frame. `reach`: standard deviation of `Compensated.near`, sensor
    pixels; at ×4 0.35 loses 0.1 dB where a scene turns.

    **Returns:** arrays of (s·h, s·w).
    """
    _, rows, columns = seen.rates.shape
    size = (scale * rows, scale * columns)
    fine = jax.image.resize(velocity, (2, *size), "linear")
    down = (jnp.arange(size[0], dtype=jnp.float32)[:, None] + 0.5) / scale - 0.5
    right = (jnp.arange(size[1], dtype=jnp.float32)[None, :] + 0.5) / scale - 0.5
    nothing = jnp.zeros(size, jnp.float32)

    def read(sums: tuple[Array, ...], moment: tuple[Array, ...]) -> tuple[tuple[Array, ...], None]:
        rate, time, new, nearest = moment
        row, column = down + fine[0] * time, right + fine[1] * time
        inside = (row > -0.5) & (row < rows - 0.5) & (column > -0.5) & (column < columns - 0.5)
        top, left = jnp.floor(row), jnp.floor(column)
        value = light = weight = nothing
        for i in range(-1, 3):
            r = jnp.clip(top + i, 0, rows - 1)
            across = nothing
            for j in range(-1, 3):
                c = jnp.clip(left + j, 0, columns - 1)
                sample = rate.reshape(-1)[r.astype(jnp.int32) * columns + c.astype(jnp.int32)]
                across = across + _keys(column - left - j) * sample
                if i in (0, 1) and j in (0, 1):
                    there = (r == top + i) & (c == left + j)  # the edge repeated is no sample
                    close = jnp.where(there, jnp.exp(-0.5 * ((row - r) ** 2 + (column - c) ** 2) / reach**2), 0.0)
                    light, weight = light + close * sample, weight + close
            value = value + _keys(row - top - i) * across
        here = (new & (inside | nearest)).astype(jnp.float32)
        # Mean and variance by Welford (1962): what is left of a square less a square would be rounding.
        count, mean, squares, near, nearness = sums
        count, apart = count + here, value - mean
        mean = mean + here * apart / jnp.maximum(count, 1.0)
        squares = squares + here * apart * (value - mean)
        return (count, mean, squares, near + here * light, nearness + here * weight), None

    away = jnp.abs(seen.times)
    new = jnp.concatenate([jnp.ones_like(seen.times[:1], bool), seen.times[1:] != seen.times[:-1]])
    # A moment after the other, so that 5 pictures are kept and not 5 of each.
    moments = (*seen, new, away == jnp.min(away))
    (count, mean, squares, light, nearness), _ = jax.lax.scan(read, (nothing,) * 5, moments)
    spread = jnp.sqrt(jnp.maximum(squares, 0.0) / jnp.maximum(count, 1.0))
    # Where there is any sample nearness is 0.007 at least.
    near = light / jnp.maximum(nearness, 1e-6)
    way = jnp.abs(fine) * (seen.times[-1] - seen.times[0])
    return Compensated(mean, spread, near, nearness, way)


def _keys(x: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """The cubic convolution kernel of Keys (1981), a = −½, at |x| ≤ 2, as in `jax.image.resize`."""
    x, a = jnp.abs(x), -0.5
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = ((a * x - 5 * a) * x + 8 * a) * x - 4 * a
    return jnp.where(x <= 1, near, far)


class Deblurring(eqx.Module):
    """`Compensated` to a sharp picture: four convolutions of the two means, gated by motion, noise and light.

    How much can be sharpened depends on the place: along a fast motion samples lie close, at rest nothing between the
    pixels was seen, and noise must not be sharpened. So the features of the first and the last layer but
    one are multiplied by 1 + g(way, spread, nearness, spikes per frame), g two small layers: worth 0.4 dB over all
    scenes and lights (docs/decisions/0018).

    It works at the picture's resolution, since blur is the same at each of its pixels: the other modules see s×s of
    them as channels of one. It reaches 6 pixels each way and starts as no change.
    """

    first: eqx.nn.Conv2d
    second: eqx.nn.Conv2d
    third: eqx.nn.Conv2d
    output: eqx.nn.Conv2d
    gating: tuple[eqx.nn.Conv2d, eqx.nn.Conv2d]

    def __init__(self, channels: int, gating: int = 16, *, key: PRNGKeyArray):
        keys = jax.random.split(key, 6)
        self.first = convolution(2, channels, size=7, key=keys[0])
        self.second = convolution(channels, channels, key=keys[1])
        self.third = convolution(channels, channels, key=keys[2])
        self.output = convolution(channels, 1, shrink=0, key=keys[3])
        self.gating = (
            convolution(5, gating, key=keys[4]),
            convolution(gating, 2 * channels, size=1, key=keys[5]),
        )

    def __call__(self, seen: Compensated, white_rate: Float[Array, ""] | float | int) -> Float[Array, "H W"]:
        """**Arguments:** `white_rate`: as of `SpikeSRNet`."""
        dtype = self.first.weight.dtype
        begin, end = jnp.split(self._gates(seen, white_rate), 2)
        x = leaky(self.first(jnp.stack([seen.mean, seen.near]).astype(dtype))) * begin
        x = leaky(self.third(leaky(self.second(x)))) * end
        return seen.mean + self.output(x)[0].astype(seen.mean.dtype)

    def _gates(self, seen: Compensated, white_rate: Float[Array, ""] | float | int) -> Float[Array, "d H W"]:
        """1 + g. Numbers without a bound are brought to about −2 to 1 first, so that no light is foreign."""
        spikes = jnp.maximum(seen.mean, 0.01) * jnp.asarray(white_rate, jnp.float32)
        known = [jnp.log(seen.spread + 1e-3), jnp.log(seen.nearness + 1e-2), jnp.log(spikes)]
        inputs = jnp.concatenate([seen.way / (1 + seen.way), jnp.stack(known) / 3])
        first, second = self.gating
        return 1 + second(leaky(first(inputs.astype(first.weight.dtype))))


@dataclasses.dataclass(frozen=True)
class CompensationConfig:
    """Sizes of a `CompensationNet`, by the names that they have in `SpikeSRConfig`.

    **Raises:** `InputError` for a value below 1, or an even number of moments.
    """

    scale: int
    velocity_channels: int = 32
    deblur_channels: int = 32
    moments: int = 21

    def __post_init__(self):
        check_sizes(self, scale=1, velocity_channels=1, deblur_channels=1)
        check_blocks(self.moments, 3, 3)


class CompensationNet(eqx.Module):
    """Spikes to the base of X^(0) alone, to be trained before the network that it is a part of
    (`learned.networks.spikesr`).

    Within the whole network the stages take over before the sharpening has learned anything: after 1,200 steps the base
    was no sharper than before. The estimator of velocity does not learn here.
    """

    velocity: VelocityEstimator
    deblurring: Deblurring
    config: CompensationConfig = eqx.field(static=True)

    def __init__(self, config: CompensationConfig, *, key: PRNGKeyArray):
        velocity, deblurring = jax.random.split(key)
        self.velocity = VelocityEstimator(config.velocity_channels, key=velocity)
        self.deblurring = Deblurring(config.deblur_channels, key=deblurring)
        self.config = config

    def __call__(
        self,
        spikes: Shaped[Array, "T h w"],
        key_frame: Int[Array, ""] | int,
        white_rate: Float[Array, ""] | float | int,
    ) -> Float[Array, "H W"]:
        """**Arguments:** as of `SpikeSRNet`."""
        velocity = jax.lax.stop_gradient(self.velocity(spikes, key_frame, white_rate))
        seen = base_moments(spikes, key_frame, white_rate, self.config.moments)
        together = compensated(seen, refined(seen, velocity), self.config.scale)
        return self.deblurring(together, white_rate)


def base_loss(base: Float[Array, "H W"], truth: Float[Array, "H W"]) -> Float[Array, ""]:
    """Mean error of what X^(0) starts from, intensity."""
    return jnp.mean(jnp.abs(base - truth))
