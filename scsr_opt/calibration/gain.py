"""Fixed pattern: every pixel has a gain of its own, and fires that much faster (real sensors: about 6 % spread).

A sample of pixel p measures Y = g(p)·I. Where g is known, Y / g is what counts. It can be known in two ways:

- from a recording of an evenly lit surface (`flat_gain`), once for a camera;
- from any recording in which the scene moves (`blind_gain`): a point of the scene is then seen by many pixels and a
  pixel sees many points, so that all others together predict what this pixel should have measured.
  A gain that varies slowly along the motion (over further than the scene moved) cannot be separated from the picture.

Where nothing moves, each pixel sees one point only and gain and picture are one: nothing but an assumption on pictures
tells them apart. `blind_gain` leaves such pixels as they are; `scsr_opt.calibration.gain_at_rest` makes the assumption.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped
from numpy.typing import ArrayLike
from scipy.ndimage import median_filter

from scsr_opt._arrays import as_array
from scsr_opt.calibration.settings import GainSettings
from scsr_opt.camera.recording import READOUT_RATE, WHITE_RATE, checked_settings
from scsr_opt.camera.samples import Samples, mean_light
from scsr_opt.camera.spike_times import SpikeTimes
from scsr_opt.errors import InputError


def with_gain(samples: Samples, gain: Float[np.ndarray, "h w"]) -> Samples:
    """The samples of a sensor without fixed pattern: Y / g.

    **Raises:** `InputError` if a gain is not above 0.
    """
    gain = as_array(gain, "gain").astype(np.float32)
    if not np.all(gain > 0):
        raise InputError(
            f"{np.count_nonzero(~(gain > 0))} gains are not above 0: mark such pixels as bad_pixels and give them "
            f"gain 1."
        )
    return eqx.tree_at(lambda s: s.value, samples, samples.value / gain[samples.row, samples.column])


def spread_of(gain: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]) -> float:
    """Standard deviation of the gains that are known; 0 if none is."""
    return float(gain[known].std()) if known.any() else 0.0


def gain_is_known(moved: Float[np.ndarray, "h w"], settings: GainSettings = GainSettings()) -> Bool[np.ndarray, "h w"]:
    """(h, w), true where the scene has `moved` by enough sensor pixels for `blind_gain` to tell the gain."""
    return moved >= settings.least_motion_px


def share_of_unknown_gain(
    samples: Samples, gain: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], noise: float | int
) -> Float[np.ndarray, "h w"]:
    """Share of its weight that a pixel keeps whose gain is not known, where others' gains spread; 1 where it is known.

    An unknown gain makes an error that all samples of the pixel share: it adds (spread · intensity)² to the variance of
    their mean, and the weight is the inverse of that variance. Gains spread there as they do where they are known; what
    was taken for gain at rest (`scsr_opt.calibration.gain_at_rest`) is a mean of what they may be, and their variance
    about it is less by its own.

    **Arguments:** `samples`, weighted so that a pixel's add up to about 1; `gain` where it is `known`, and what was
    taken for it elsewhere; `noise`, the standard deviation of a pixel's mean without that, intensity.
    """
    left = max(spread_of(gain, known) ** 2 - spread_of(gain, ~known) ** 2, 0.0) ** 0.5
    error = left * samples.mean_light((gain.shape[0], gain.shape[1]))
    return np.where(known, 1, 1 / (1 + (error / noise) ** 2)).astype(np.float32)


def flat_gain(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    bad_pixels: ArrayLike | None = None,
    even_over: int = 15,
    settings: GainSettings = GainSettings(),
) -> Float[np.ndarray, "h w"]:
    """Gains from a recording of an evenly lit, still surface: a pixel's rate over the median rate around it.

    The error is that of a rate from intervals: about 0.4 / T relative for T frames, plus shot noise.

    **Arguments:**
    - `spikes`: (T, h, w); the longer the better.
    - `bad_pixels`: (h, w), true or 1 for pixels to be left out; they get gain 1.
    - `even_over`: sensor pixels over which the light may be taken as even; what varies more slowly (vignetting) is left
      in.
    - `settings`: the range of gains that are believed.

    **Returns:** (h, w), around 1.

    **Raises:** `InputError` if `even_over` is less than 3, or `bad_pixels` no such mask.
    """
    if even_over < 3:
        raise InputError(f"even_over is {even_over}, but a median of neighbours needs at least 3 pixels.")
    shape = (spikes.shape[1], spikes.shape[2])
    known_bad = checked_settings(spikes.shape, READOUT_RATE, WHITE_RATE, bad_pixels)["bad_pixels"]
    rate = mean_light(SpikeTimes.of(spikes), 0, len(spikes), white_rate=WHITE_RATE)
    bad = np.zeros(shape, bool) if known_bad is None else known_bad
    return even_gain(rate, bad, even_over=even_over, settings=settings)


def even_gain(
    rate: Float[np.ndarray, "h w"],
    bad: Bool[np.ndarray, "h w"],
    *,
    even_over: int = 15,
    settings: GainSettings = GainSettings(),
) -> Float[np.ndarray, "h w"]:
    """Gains from the rates of pixels that see an even light (`flat_gain`); 1 where they are bad."""
    # Bad pixels take the median of the good ones, so that they do not change the median around their neighbours.
    filled = np.where(bad, np.median(rate[~bad]) if np.any(~bad) else 1.0, rate)
    around = median_filter(filled, size=even_over, mode="nearest")
    usable = ~bad & (around > 0)
    return np.where(usable, np.clip(filled / np.where(usable, around, 1), *settings.believed_range), 1.0).astype(
        np.float32
    )


def blind_gain(
    samples: Samples,
    predicted: Float[np.ndarray | Array, " n"],
    *,
    moved: Float[np.ndarray, "h w"],
    white_rate: float | int,
    weight: Float[np.ndarray | Array, " n"] | None = None,
    settings: GainSettings = GainSettings(),
) -> Float[np.ndarray, "h w"]:
    """Gains from samples and what the reconstructed picture predicts for them.

    A pixel's raw gain is Σ ω Y / Σ ω P, measured and predicted light, each with one spike's light added: a pixel that
    hardly fired stays near 1. Part of its deviation from 1 is not gain but what is wrong with the picture. That part is
    not the same in the first and in the second half of a pixel's samples, in which it sees different places: with a and
    b the deviations of the halves, gains spread by the root of cov(a, b) = (var(a + b) − var(a − b)) / 4, and errors of
    their mean by that of var(a − b) / 4. Both variances are robust ones, from the median of absolute deviations
    (Gnanadesikan and Kettenring, 1972, "Robust estimates, residuals, and outlier detection with multiresponse data"),
    as the picture is far more wrong at some pixels than at most. What is kept of a deviation is gain² / (gain² +
    error²), the error being that of most pixels or (a − b) / 2, the larger. Where the halves do not agree, nothing is.

    Use it in turns: picture from `with_gain(samples, gain)`, then gain from that picture; one turn finds most, two all.
    The samples are always those as measured.

    **Arguments:**
    - `samples`: as measured, not corrected.
    - `predicted`: (n,), what the picture predicts for each, `PlacedSamples.read(term.blurred(image))`.
    - `moved`: (h, w), how far the scene moves at each pixel during the recording, sensor pixels.
    - `white_rate`: spikes per frame of a pixel at intensity 1.
    - `weight`: (n,), instead of the samples' own: those of `PlacedSamples`, which know what has left the picture.
    - `settings`: the motion from which on a gain is known, and the range of gains that are believed.

    **Returns:** (h, w), 1 where the scene does not move by a pixel or nothing was measured.
    """
    shape = (moved.shape[0], moved.shape[1])
    row, column = np.asarray(samples.row), np.asarray(samples.column)
    used = np.asarray(samples.weight if weight is None else weight, np.float64)
    value, start, stop = (np.asarray(v, np.float64) for v in (samples.value, samples.start, samples.stop))
    pixel = (row * shape[1] + column).astype(np.intp)

    def sums(of: Float[np.ndarray, " n"]) -> Float[np.ndarray, "h w"]:
        return np.bincount(pixel, of, minlength=shape[0] * shape[1]).reshape(shape)

    total, duration = sums(used), sums(np.where(used > 0, stop - start, 0.0))
    seen = (total > 0) & gain_is_known(moved, settings)
    if not seen.any():
        return np.ones(shape, np.float32)
    spike = total / np.maximum(duration, 1) / white_rate
    halfway = sums(used * (start + stop) / 2) / np.where(total > 0, total, 1)
    early = (start + stop) / 2 < halfway[row, column]
    expected = np.maximum(np.asarray(predicted, np.float64), 0)

    def ratio(measured: Float[np.ndarray, "h w"], predicted: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        raw = np.clip((measured + spike) / np.maximum(predicted + spike, 1e-9), *settings.believed_range)
        return np.where(seen, raw - np.median(raw[seen]), 0)

    def halves(of: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
        late, soon = np.bincount(pixel + early * seen.size, of, minlength=2 * seen.size).reshape(2, *shape)
        return soon, late

    light = halves(used * value), halves(used * expected)
    first, second = (ratio(*half) for half in zip(*light, strict=True))
    differs = (first - second) / 2
    of_errors = _robust_variance(differs[seen])
    of_gains = max(_robust_variance(((first + second) / 2)[seen]) - of_errors, 0.0)
    if of_gains == 0:
        return np.ones(shape, np.float32)
    kept = of_gains / (of_gains + np.maximum(of_errors, differs**2))
    gain = 1 + kept * ratio(*(soon + late for soon, late in light))
    return np.clip(gain, *settings.believed_range).astype(np.float32)


def _robust_variance(values: Float[np.ndarray, " n"]) -> float:
    """Variance of a normal distribution with this median of absolute deviations."""
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) ** 2
