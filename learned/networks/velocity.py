"""Motion as a network sees it: one velocity per pixel, learned from the true motion of simulated scenes.

In the few dozen frames around a key frame, a thousandth of a second, what is seen at a point moves along a straight
line. So one velocity per pixel of the key frame gives its place at every moment. The offsets of a deformable
convolution give it, too, but each alignment has to find its own from an input that hardly shows the motion (the
residual of a gradient step least of all where it is aligned best), and a picture's loss alone teaches offsets slowly:
Chan et al., "Understanding deformable alignment in video super-resolution", AAAI 2021, hold them to an optical flow.
The motion of a simulated scene is known, so the estimate is trained on it, once for all alignments, and offsets start
there.

The estimate is a sweep: for each of a grid of velocities the moments are shifted back by it, and where they then agree
the velocity is right. What "agree" means, and which neighbours to believe, is learned. That comes near enough for a
classical estimate, which needs no learning, to be exact (`refined`).
"""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from learned.networks.encoder import block_times, check_blocks, spike_blocks
from learned.networks.layers import check_sizes, convolution, leaky


@dataclasses.dataclass(frozen=True)
class VelocitySearch:
    """The grid and the moments of a `VelocityEstimator`, for which its weights were trained.

    **Fields:**
    - `fastest`: end of the grid of velocities along either axis, sensor pixels per frame. Training has 0.3.
    - `steps`: velocities along an axis; 0.09 apart, so that one step moves the outer moments by 1.35 pixels.
    - `moments`, `length`, `spacing`: how many moments, of how many frames, and the frames from one to the next.
    - `features`: channels in which moments are compared.
    """

    fastest: float = 0.36
    steps: int = 9
    moments: int = 7
    length: int = 9
    spacing: int = 5
    features: int = 4

    def grid(self) -> Float[Array, " steps"]:
        """The velocities along an axis."""
        return jnp.linspace(-self.fastest, self.fastest, self.steps, dtype=jnp.float32)


class Moments(NamedTuple):
    """Firing rates of short times around a key frame.

    **Fields:** `rates`: (m, h, w), intensity; `times`: (m,), of their middles, spike frames after the key frame.
    """

    rates: Float[Array, "m h w"]
    times: Float[Array, " m"]


def moments(
    spikes: Shaped[Array, "T h w"],
    key_frame: Int[Array, ""] | int,
    white_rate: Float[Array, ""] | float | int,
    *,
    count: int,
    length: int,
    spacing: int,
) -> Moments:
    """`count` moments, each of `length` frames, `spacing` apart as far as the recording goes (`spike_blocks`)."""
    length = min(length, spikes.shape[0])
    blocks = spike_blocks(spikes, key_frame, count, length, spacing)
    rates = jnp.mean(blocks.astype(jnp.float32), axis=1) / jnp.asarray(white_rate, jnp.float32)
    return Moments(rates, block_times(spikes.shape[0], key_frame, count, length, spacing))


def base_moments(
    spikes: Shaped[Array, "T h w"],
    key_frame: Int[Array, ""] | int,
    white_rate: Float[Array, ""] | float | int,
    count: int,
) -> Moments:
    """Moments of 3 frames from the intervals between spikes, for `learned.networks.compensation`.

    A count over 3 frames is wrong by up to a spike, and where things move the errors of neighbouring moments, read from
    other pixels, no longer cancel. An interval is wrong by a frame at either end only.
    """
    rates = interval_rates(spikes) / jnp.asarray(white_rate, jnp.float32)
    seen = moments(spikes, key_frame, white_rate, count=count, length=3, spacing=3)
    return seen._replace(rates=jnp.mean(spike_blocks(rates, key_frame, count, 3, 3), axis=1))


def interval_rates(spikes: Shaped[Array, "T h w"]) -> Float[Array, "T h w"]:
    """1/n in each frame of an interval of n frames between two spikes of a pixel: spikes per frame.

    The intervals that the recording's ends cut are taken as long as what is seen of them, and at least as long as the
    next whole one.
    """
    frames = spikes.shape[0]
    number = jnp.arange(frames, dtype=jnp.int32)[:, None, None]
    fired = spikes.astype(bool)
    upto = jax.lax.cummax(jnp.where(fired, number, -1), axis=0)
    before = jnp.concatenate([jnp.full_like(upto[:1], -1), upto[:-1]])
    after = jax.lax.cummin(jnp.where(fired, number, frames), axis=0, reverse=True)
    first, last = after[0], upto[-1]
    second = jnp.take_along_axis(after, jnp.minimum(first + 1, frames - 1)[None], axis=0)[0]
    last_but_one = jnp.take_along_axis(before, jnp.maximum(last, 0)[None], axis=0)[0]
    at_start = jnp.where((second < frames) & (second > first), second - first, 0)
    at_end = jnp.where(last_but_one >= 0, last - last_but_one, 0)
    length = after - before
    length = jnp.where(before < 0, jnp.maximum(length, at_start[None]), length)
    length = jnp.where(after == frames, jnp.maximum(length, at_end[None]), length)
    return 1 / length.astype(jnp.float32)


class VelocityEstimator(eqx.Module):
    """Spikes to the velocity of what each pixel sees in the key frame, (2, h, w), down and right, pixels per frame.

    Each of seven moments goes through two small convolutions. For each of 9×9 velocities the features are read where
    they would have moved to, and their variance over the moments, against its mean over all velocities, is the cost.
    Convolutions of growing reach (16 pixels in all) turn costs into a distribution over the grid, and its mean is the
    velocity. (Numbers: `VelocitySearch`.)
    """

    first: eqx.nn.Conv2d
    second: eqx.nn.Conv2d
    entry: eqx.nn.Conv2d
    body: tuple[eqx.nn.Conv2d, ...]
    output: eqx.nn.Conv2d
    search: VelocitySearch = eqx.field(static=True)

    def __init__(self, channels: int, search: VelocitySearch | None = None, *, key: PRNGKeyArray):
        self.search = search = VelocitySearch() if search is None else search
        keys = jax.random.split(key, 7)
        self.first = convolution(1, 2 * search.features, size=5, key=keys[0])
        self.second = convolution(2 * search.features, search.features, key=keys[1])
        grid = search.steps**2
        self.entry = convolution(grid + 1, channels, key=keys[2])
        self.body = tuple(
            eqx.nn.Conv2d(channels, channels, 3, padding=d, dilation=d, key=k)
            for d, k in zip((2, 4, 8), keys[3:6], strict=True)
        )
        self.output = convolution(channels, grid, size=1, shrink=0.1, key=keys[6])

    def __call__(
        self,
        spikes: Shaped[Array, "T h w"],
        key_frame: Int[Array, ""] | int,
        white_rate: Float[Array, ""] | float | int,
    ) -> Float[Array, "2 h w"]:
        """**Arguments:** as of `SpikeSRNet`. The result is float32 at least."""
        dtype, search = self.first.weight.dtype, self.search
        rates, times = moments(
            spikes, key_frame, white_rate, count=search.moments, length=search.length, spacing=search.spacing
        )
        features = jax.vmap(lambda rate: self.second(leaky(self.first(rate[None]))))(rates.astype(dtype))
        cost = _sweep(features.astype(jnp.float32), times, search)
        mean = jnp.mean(cost, axis=0, keepdims=True) + 1e-6
        relative = cost / mean
        seen = jnp.concatenate([relative, jnp.log(mean)]).astype(dtype)
        seen = leaky(self.entry(seen))
        for layer in self.body:
            seen = seen + leaky(layer(seen))
        likely = jax.nn.softmax(self.output(seen).astype(jnp.float32) - 4 * relative, axis=0)
        likely, grid = likely.reshape(search.steps, search.steps, *likely.shape[1:]), search.grid()
        return jnp.stack([jnp.einsum("ijhw,i->hw", likely, grid), jnp.einsum("ijhw,j->hw", likely, grid)])


def _sweep(
    features: Float[Array, "m c h w"], times: Float[Array, " m"], search: VelocitySearch
) -> Float[Array, "grid h w"]:
    """For each velocity of the grid, the variance over the moments of what is read at p + velocity·time."""
    rows, columns = features.shape[2:]
    # The recording's ends can bring a moment this far from the key frame, twice as far as in its middle.
    reach = math.ceil(search.fastest * (search.moments - 1) * search.spacing) + 1
    padded = jnp.pad(features, ((0, 0), (0, 0), (reach, reach), (reach, reach)), mode="edge")
    grid = search.grid()

    def shifted(x: Array, by: Float[Array, ""], axis: int, size: int) -> Array:
        by = jnp.clip(by, -reach, reach - 1)
        whole = jnp.floor(by)
        part = by - whole
        seen = jax.lax.dynamic_slice_in_dim(x, reach + whole.astype(jnp.int32), size + 1, axis)
        before, after = (jax.lax.slice_in_dim(seen, n, n + size, axis=axis) for n in (0, 1))
        return (1 - part) * before + part * after

    def along(x: Array, speed: Float[Array, ""], axis: int, size: int) -> Array:
        return jax.vmap(lambda moment, time: shifted(moment, speed * time, axis, size))(x, times)

    def of_row(down: Float[Array, ""]) -> Float[Array, "grid h w"]:
        moved = along(padded, down, 1, rows)

        def of_column(right: Float[Array, ""]) -> Float[Array, "h w"]:
            both = along(moved, right, 2, columns)
            return jnp.sum(jnp.var(both, axis=0), axis=0)

        return jax.vmap(of_column)(grid)

    return jax.vmap(of_row)(grid).reshape(-1, rows, columns)


@dataclasses.dataclass(frozen=True)
class VelocityRefinement:
    """Numbers of `refined`.

    **Fields:**
    - `steps` of Gauss and Newton.
    - `blur`: standard deviation by which moments are smoothed, and `window`: of what is summed around a pixel, pixels.
    - `flat`: squared slope, (intensity per pixel)², below which texture counts less than the velocities around.
    - `limit`: largest speed along an axis, sensor pixels per frame.
    """

    steps: int = 3
    blur: float = 1.0
    window: float = 3.0
    flat: float = 3e-5
    limit: float = 0.5


def refined(
    seen: Moments, velocity: Float[Array, "2 h w"], numbers: VelocityRefinement | None = None
) -> Float[Array, "2 h w"]:
    """A velocity that is near the true one made exact: three steps of Gauss and Newton (Lucas and Kanade 1981).

    Read along their tracks, p + v·t, the moments change in time by ∇Y·(v − u) where u is the true velocity; u is that
    which explains the change best around a pixel, in a Gaussian window of 3 pixels. Where there is no texture the mean
    velocity around is kept. Nothing is learned here: what learning is needed for is to come near enough.
    """
    numbers = VelocityRefinement() if numbers is None else numbers
    smooth = _blurred(seen.rates, numbers.blur)
    for _ in range(numbers.steps):
        velocity = _corrected(Moments(smooth, seen.times), velocity, numbers)
    return jnp.clip(velocity, -numbers.limit, numbers.limit)


def _corrected(seen: Moments, velocity: Float[Array, "2 h w"], numbers: VelocityRefinement) -> Float[Array, "2 h w"]:
    tracks, inside = jax.vmap(lambda rate, time: _along_track(rate, velocity * time))(*seen)
    time = seen.times[:, None, None]
    count = jnp.maximum(jnp.sum(inside, axis=0), 1.0)
    apart = inside * (time - jnp.sum(inside * time, axis=0, keepdims=True) / count[None])
    spread = jnp.sum(apart**2, axis=0)
    slope = jnp.sum(apart * tracks, axis=0) / jnp.maximum(spread, 1e-6)
    mean = jnp.pad(jnp.sum(inside * tracks, axis=0) / count, 1, mode="edge")
    down, right = (mean[2:, 1:-1] - mean[:-2, 1:-1]) / 2, (mean[1:-1, 2:] - mean[1:-1, :-2]) / 2
    known = down * velocity[0] + right * velocity[1] - slope
    # A pixel whose track stays on the sensor for longer has more weight.
    trust = spread / jnp.maximum(jnp.max(spread), 1e-6)
    parts = jnp.stack([down * down, down * right, right * right, down * known, right * known])
    a, b, d, y, x = _blurred(parts * trust[None], numbers.window)
    around, flat = _blurred(velocity, numbers.window), numbers.flat
    a, d, y, x = a + flat, d + flat, y + flat * around[0], x + flat * around[1]
    return jnp.stack([d * y - b * x, a * x - b * y]) / (a * d - b * b)[None]


def _along_track(rate: Float[Array, "h w"], away: Float[Array, "2 h w"]) -> tuple[Array, Array]:
    """`rate` read so far away from each pixel (linear), and 1 where that lies on the sensor."""
    rows, columns = rate.shape
    row = jnp.arange(rows, dtype=jnp.float32)[:, None] + away[0]
    column = jnp.arange(columns, dtype=jnp.float32)[None, :] + away[1]
    inside = (row >= 0) & (row <= rows - 1) & (column >= 0) & (column <= columns - 1)
    read = jax.scipy.ndimage.map_coordinates(rate, [row, column], order=1, mode="nearest")
    return read, inside.astype(jnp.float32)


def _blurred(pictures: Float[Array, "n h w"], spread: float) -> Float[Array, "n h w"]:
    """Each by a Gaussian of this standard deviation, pixels; the edge is repeated."""
    reach = math.ceil(3 * spread)
    kernel = jnp.exp(-0.5 * (jnp.arange(-reach, reach + 1, dtype=jnp.float32) / spread) ** 2)
    kernel = kernel / jnp.sum(kernel)
    padded = jnp.pad(pictures, ((0, 0), (reach, reach), (reach, reach)), mode="edge")[:, None]
    for shape in ((1, 1, -1, 1), (1, 1, 1, -1)):
        # To the last bit: the 10 bits of a GPU's usual products are not enough for what a difference is taken of.
        padded = jax.lax.conv_general_dilated(
            padded, kernel.reshape(shape), (1, 1), "VALID", precision=jax.lax.Precision.HIGHEST
        )
    return padded[:, 0]


@dataclasses.dataclass(frozen=True)
class VelocityConfig:
    """Sizes of a `VelocityNet`: `channels` of the estimator; `moments` of 3 frames in the picture that shows its worth.

    **Raises:** `InputError` for a value below 1, or an even number of moments.
    """

    channels: int = 32
    moments: int = 21

    def __post_init__(self):
        check_sizes(self, channels=1)
        check_blocks(self.moments, 3, 3)


class VelocityNet(eqx.Module):
    """The estimator alone, to be trained before the network that it is a part of (`learned.networks.spikesr`).

    A step takes a tenth of the whole network's, and the place that the estimator has in it, `velocity`, is the same.
    """

    velocity: VelocityEstimator

    def __init__(self, channels: int, *, key: PRNGKeyArray):
        self.velocity = VelocityEstimator(channels, key=key)


def velocity_loss(found: Float[Array, "2 h w"], truth: Float[Array, "2 h w"]) -> Float[Array, ""]:
    """Mean error along an axis, sensor pixels per frame, where the truth is known (not NaN); 0 if it is nowhere."""
    known = jnp.isfinite(truth)
    errors = jnp.where(known, jnp.abs(found - jnp.where(known, truth, 0.0)), 0.0)
    return jnp.sum(errors) / jnp.maximum(jnp.sum(known.astype(jnp.float32)), 1.0)
