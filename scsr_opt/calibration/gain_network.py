"""Gains of pixels that saw one point of the scene only, by a network that tells fixed pattern from picture.

Where nothing moves, gain and picture are one (`scsr_opt.calibration.gain`), and only an assumption on pictures tells
them apart: edges and textures extend over pixels, gains do not. A prior makes it in the solve, on the
high-resolution picture; here a small network makes it at sensor resolution, where the gains are, and estimates how much
of each pixel's light is gain. It was trained (`learned.training.gain`) to miss ln g by little in the mean of
squares, over recordings with and without a fixed pattern: where a texture could be a pattern its estimate is small.
"""

import functools
import math
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Shaped
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from scsr_opt._kernels.device import on_device
from scsr_opt._kernels.programs import ready
from scsr_opt.calibration.settings import GainSettings
from scsr_opt.camera.recording import READOUT_RATE, checked_settings
from scsr_opt.camera.samples import mean_light
from scsr_opt.camera.saturation import spike_counts
from scsr_opt.camera.spike_times import SpikeTimes

WEIGHTS = Path(__file__).parent / "weights" / "gain_network.npz"
"""The trained network; a card beside it lists what it was trained on."""


class GainNetwork(eqx.Module):
    """ln g of each pixel from the rates of a still scene: convolutions of 3×3, each added to what was before it, as in
    networks that take noise from pictures (Zhang, Zuo, Chen, Meng, Zhang, 2017, "Beyond a Gaussian denoiser: residual
    learning of deep CNN for image denoising"), but in the logarithm of light, in which gains are added to the picture.

    **Arguments:**
    - `channels`, `layers`: features, and convolutions, 2 at least.
    - `key`: of the random first weights.
    """

    layers: tuple[eqx.nn.Conv2d, ...]
    # Numbers that it was trained with. The intensity at which the logarithm of a rate becomes linear: what is darker
    # hardly fires, and shows no gain.
    DARK: ClassVar[float] = 0.02
    # Offset and factors with which its input is about 0 in the mean, and its noise about 1 at most.
    LOG_OFFSET: ClassVar[float] = 1.2
    NOISE_FACTOR: ClassVar[float] = 10.0
    MOST_NOISE: ClassVar[float] = 3.0
    LEAK: ClassVar[float] = 0.1  # slope of activations below 0

    def __init__(self, channels: int, layers: int, *, key: PRNGKeyArray):
        sizes = [2, *[channels] * (layers - 1), 1]
        self.layers = tuple(
            eqx.nn.Conv2d(before, after, 3, padding=1, key=k)
            for before, after, k in zip(sizes, sizes[1:], jax.random.split(key, layers), strict=False)
        )

    def __call__(self, rate: Float[Array, "h w"], noise: Float[Array, "h w"]) -> Float[Array, "h w"]:
        """ln g from a still picture and the relative standard deviation of its pixels over time (`rates_at_rest`)."""
        seen = jnp.stack(
            [jnp.log(rate + self.DARK) + self.LOG_OFFSET, jnp.minimum(self.NOISE_FACTOR * noise, self.MOST_NOISE)]
        )
        first, *inner, last = self.layers
        x = _leaky(first(seen))
        for layer in inner:
            x = x + _leaky(layer(x))
        return last(x)[0]

    def save(self, path: Path) -> None:
        """Writes the network to an .npz file."""
        arrays: dict[str, Any] = {}
        for n, layer in enumerate(self.layers):
            arrays[f"weight{n}"], arrays[f"bias{n}"] = np.asarray(layer.weight), np.asarray(layer.bias)
        np.savez_compressed(path, **arrays)

    @staticmethod
    @functools.cache
    def load(path: Path = WEIGHTS) -> "GainNetwork":
        """The shipped network, or that of another file."""
        with np.load(path) as arrays:
            count = len(arrays.files) // 2
            weights = [on_device(arrays[f"{name}{n}"]) for name in ("weight", "bias") for n in range(count)]
        # Only the layout is needed: drawing first weights would compile five programs.
        network = eqx.filter_eval_shape(lambda: GainNetwork(weights[0].shape[0], count, key=jax.random.key(0)))
        return eqx.tree_at(
            lambda n: [getattr(layer, name) for name in ("weight", "bias") for layer in n.layers], network, weights
        )


def _leaky(x: Float[Array, "..."]) -> Float[Array, "..."]:
    return jnp.where(x >= 0, x, GainNetwork.LEAK * x)


def rates_at_rest(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    white_rate: float | int,
    bad_pixels: Bool[np.ndarray, "h w"] | None = None,
    settings: GainSettings = GainSettings(),
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Intensity of each pixel of a still scene, from all its intervals, and the relative standard deviation of that,
    as the two halves of the recording and the pixels around tell it; bad pixels take what is around them.
    `white_rate`: spikes per frame of a pixel at intensity 1."""
    good = np.ones(spikes.shape[1:], np.float32) if bad_pixels is None else (~bad_pixels).astype(np.float32)

    def around(of: Float[np.ndarray, "h w"], reach: float) -> Float[np.ndarray, "h w"]:
        return gaussian_filter(of * good, reach) / (gaussian_filter(good, reach) + np.float32(1e-6))

    frames, half = len(spikes), len(spikes) // 2
    first, second = SpikeTimes.of(spikes, 0, half), SpikeTimes.of(spikes, half)
    whole = mean_light(first.then(second), 0, frames, white_rate=white_rate)
    before, after = (
        mean_light(times, begin, end, white_rate=white_rate)
        for times, begin, end in ((first, 0, half), (second, half, frames))
    )
    differs = before - after
    whole = np.where(good > 0, whole, around(whole, settings.bad_pixel_smoothing_px))
    noise = np.sqrt(around(differs**2, settings.noise_smoothing_px)) / 2
    return whole, noise / (whole + np.float32(GainNetwork.DARK))


def gain_at_rest(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    white_rate: float | int,
    bad_pixels: ArrayLike | None = None,
    network: GainNetwork | None = None,
    sampled_gains: bool = True,
    settings: GainSettings = GainSettings(),
) -> Float[np.ndarray, "h w"]:
    """Gains of the pixels of a camera before a still scene, as far as the picture determines them.

    Of gains that spread by 5 % some 70 % of the variance are left in the mean of pictures and lights, and much less
    where they are plain. All gains are 1 unless they seem to spread by 1 % or more in nine tenths of the squares of 8×8
    pixels that show any, 25 at least. A scene that is fine texture all over may still be taken for a pattern: 1 in
    100 parts of 60×60 and 120×120 pixels of pictures without one.

    **Arguments:**
    - `spikes`: (T, h, w); what moves by less than a pixel is still enough.
    - `white_rate`: spikes per frame of a pixel at intensity 1.
    - `bad_pixels`: (h, w), true or 1 for pixels to be left out; they get gain 1.
    - `network`: the shipped one, if not given.
    - `sampled_gains`: whether windows of a large sensor that show no pattern stand for all of it (`Shortcuts`).
    - `settings`: when there is a pattern.

    **Returns:** (h, w), around 1.

    **Raises:** `InputError` if `white_rate` is not above 0, or `bad_pixels` no such mask.
    """
    ready()
    bad = checked_settings(spikes.shape, READOUT_RATE, white_rate, bad_pixels)["bad_pixels"]
    if len(spikes) < 2:
        return np.ones(spikes.shape[1:], np.float32)
    network = GainNetwork.load() if network is None else network
    bad = np.zeros(spikes.shape[1:], bool) if bad is None else bad
    if sampled_gains and _is_plain(network, spikes, white_rate, bad, settings):
        return np.ones(bad.shape, np.float32)
    rate, noise = rates_at_rest(spikes, white_rate=white_rate, bad_pixels=bad, settings=settings)
    rate = rate / max(float(np.quantile(rate, 1 - settings.brightest_share)), 1.0)
    found = _logarithm(network, rate, noise, bad, settings)
    spread = _spreads(found, rate, noise, settings)
    least = max(settings.least_squares, settings.least_squares_share * (rate.size // settings.square_px**2))
    if spread.size < least or np.quantile(spread, settings.rest_plainest_share) < settings.rest_pattern_spread:
        return np.ones_like(rate)
    return np.exp(found).astype(np.float32)


def _is_plain(
    network: GainNetwork,
    spikes: Shaped[np.ndarray, "T h w"],
    white_rate: float | int,
    bad: Bool[np.ndarray, "h w"],
    settings: GainSettings,
) -> bool:
    """True where windows of a sensor that is much larger than they are show that there is no pattern."""
    reach = len(network.layers)  # a convolution of 3×3 each: so far from its border a window is as the whole sensor
    side = settings.window_squares * settings.square_px + 2 * reach
    if 2 * math.prod(settings.windows) * side**2 > bad.size or min(bad.shape) < side:
        return False
    down, across = (np.linspace(0, n - side, k).astype(int) for n, k in zip(bad.shape, settings.windows, strict=True))
    white = np.quantile(spike_counts(spikes), 1 - settings.brightest_share) / (len(spikes) * white_rate)
    inner, plain, seen = np.s_[reach:-reach, reach:-reach], 0, 0
    for row, top in enumerate(down, 1):
        windows = [np.s_[top : top + side, left : left + side] for left in across]
        common: dict[str, Any] = {"white_rate": white_rate, "settings": settings}
        rates = [rates_at_rest(spikes[:, *w], bad_pixels=bad[w], **common) for w in windows]
        rate, noise = np.stack([one for one, _ in rates]) / max(float(white), 1.0), np.stack([one for _, one in rates])
        found = _logarithm(network, rate, noise, np.stack([bad[w] for w in windows]), settings)
        for each in zip(found, rate, noise, strict=True):
            spread = _spreads(*(one[inner] for one in each), settings=settings)
            plain += int(np.count_nonzero(spread < settings.rest_pattern_spread))
            seen += spread.size
        # The windows that follow may add this many squares: where the share is large enough with all of them, stop.
        most = seen + (len(down) - row) * len(across) * settings.window_squares**2
        if plain > settings.plain_share * most:
            return seen >= settings.least_squares
    return False


def _logarithm(
    network: GainNetwork,
    rate: Float[np.ndarray, "*n h w"],
    noise: Float[np.ndarray, "*n h w"],
    bad: Bool[np.ndarray, "*n h w"],
    settings: GainSettings,
) -> Float[np.ndarray, "*n h w"]:
    """ln g of one picture or several, 0 where a pixel is bad."""
    one_or_all = _found if rate.ndim == 2 else _all_found
    found = np.asarray(one_or_all(network, on_device(rate.astype(np.float32)), on_device(noise.astype(np.float32))))
    return np.where(bad, 0, np.clip(found, -settings.most_log_gain, settings.most_log_gain))


def _spreads(
    found: Float[np.ndarray, "h w"],
    rate: Float[np.ndarray, "h w"],
    noise: Float[np.ndarray, "h w"],
    settings: GainSettings,
) -> Float[np.ndarray, " n"]:
    """Standard deviation of ln g in each square that can show gains."""
    squares, light, noise = (_in_squares(values, settings.square_px) for values in (found, rate, noise))
    return squares.std(1)[(light.mean(1) > settings.least_light) & (noise.mean(1) < settings.most_noise)]


def _in_squares(values: Float[np.ndarray, "h w"], side: int) -> Float[np.ndarray, "n pixels"]:
    """The pixels of each whole square of side × side."""
    height, width = (length // side * side for length in values.shape)
    parts = values[:height, :width].reshape(height // side, side, width // side, side)
    return parts.transpose(0, 2, 1, 3).reshape(-1, side**2)


_found = eqx.filter_jit(GainNetwork.__call__)
_all_found = eqx.filter_jit(eqx.filter_vmap(GainNetwork.__call__, in_axes=(None, 0, 0)))
