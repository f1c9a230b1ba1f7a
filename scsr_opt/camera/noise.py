"""Errors of samples: quantisation, shot noise, fixed pattern (derived in docs/data-term.md).

An interval of light I that lasts n frames and gathers cθ is a sample Y of variance

    I²/(6 n²)  +  (I + I₀)/(N n)  +  g² I²

- **Quantisation.** Both ends are known to a frame each: the true duration is that read out plus the difference of two
  uniform numbers on [−½, ½], variance 1/6, hence the light I·n has variance I²/6. Neighbours share an end, with
  opposite signs: over several intervals it does not add up.
- **Shot noise.** N photons (electrons) per frame of white; the light of n frames, dark charge I₀ included, has variance
  n (I + I₀)/N.
- **Fixed pattern.** Gains of relative spread g; the same for all samples of a pixel, so it does not average out.

The end of a recording (see `samples`) has (θ²/12)/n² in the place of the first term.
"""

import math
from numbers import Real

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from scsr_opt.camera.samples import Samples, spike_intervals
from scsr_opt.errors import InputError, shown


class Noise(eqx.Module):
    """Sources of error of a camera's samples, beside quantisation.

    **Fields:**
    - `photons`: N, photons per frame of a pixel at intensity 1; infinite for no shot noise.
    - `fixed_pattern`: g, standard deviation of the gains that are left in the samples.
    - `dark_rate`: I₀, dark charge per frame, as an intensity.

    **Raises:** `InputError` if one is out of range.
    """

    photons: float | int = math.inf
    fixed_pattern: float | int = 0.0
    dark_rate: float | int = 0.0

    def __check_init__(self):
        if not (isinstance(self.photons, Real) and self.photons > 0):
            raise InputError(
                f"photons is {shown(self.photons)}, but it must be above 0, in photons per frame of white."
            )
        for name in ("fixed_pattern", "dark_rate"):
            if not (isinstance(getattr(self, name), Real) and 0 <= getattr(self, name) < math.inf):
                raise InputError(f"{name} is {shown(getattr(self, name))}, but it must be a finite number, 0 or more.")

    def variance(
        self, duration: Float[np.ndarray | Array, "..."] | float, level: Float[np.ndarray | Array, "..."] | float
    ) -> Float[np.ndarray | Array, "..."] | float:
        """Variance of intervals (formula above).

        **Arguments:** `duration` n, frames; `level` I, the light that was there, not that which was measured: a
        variance made from the sample's own value trusts those most that came out dark by chance.
        """
        shot = (level + self.dark_rate) / (duration * self.photons)
        return level**2 / (6 * duration**2) + shot + (self.fixed_pattern * level) ** 2

    def deviation(
        self, duration: Float[np.ndarray | Array, "..."] | float, level: Float[np.ndarray | Array, "..."] | float
    ) -> Float[np.ndarray | Array, "..."] | float:
        """Standard deviation of intervals."""
        return self.variance(duration, level) ** 0.5

    def weights(self, samples: Samples, level: Float[np.ndarray, "h w"]) -> Float[np.ndarray, " n"]:
        """ω from the model, in the place of duration: ω_j / v, v the variance of all that the pixel gathered.

        Over a whole recording of T frames the errors of neighbouring intervals cancel, v = `variance(T, I)`. A factor
        that is the same for all samples of a pixel keeps what duration weights are good for: no bias from intervals
        that are short by chance. Σω stays as it was.

        **Arguments:** `samples`, weighted by duration; `level` I of each pixel, smoothed over its neighbours.
        """
        span = float(samples.stop.max() - samples.start.min()) if samples.stop.size else 1.0
        # Light that is not distinguishable from none would get any weight.
        darkest = max(float(np.median(level)), 1e-3) / 20
        factor = 1 / np.maximum(self.variance(span, np.maximum(level, darkest)), 1e-12)
        weight = np.asarray(samples.weight) * factor[samples.row, samples.column]
        total = weight.sum()
        return (weight * (samples.weight.sum() / total) if total > 0 else weight).astype(np.float32)


def estimate_photons(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    white_rate: float | int = 0.6,
    bad_pixels: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Estimates N of `Noise` from the irregularity of the intervals.

    Of three neighbouring intervals, d₁ − 2 d₂ + d₃ is free of even changes of the light. Read-out in whole frames alone
    gives it variance 20/12; shot noise adds 6 n² / (N θ) for intervals of n frames. Summed over the quarter of the
    pixels whose rate changed least from the first to the second half of the recording, so that passing edges are
    not taken for noise. Texture that passes a pixel within a few intervals still is: N is a lower bound where things
    move fast.

    **Returns:** photons per frame of intensity 1; infinite where quantisation explains all, or no pixel fired often
    enough to say.
    """
    samples = spike_intervals(spikes, white_rate=white_rate, bad_pixels=bad_pixels, ends=0)
    pixel = samples.row * spikes.shape[2] + samples.column
    duration = np.asarray(samples.weight, np.float64)
    together = pixel[2:] == pixel[:-2]
    bend = (duration[:-2] - 2 * duration[1:-1] + duration[2:])[together]
    length = ((duration[:-2] + duration[1:-1] + duration[2:]) / 3)[together]
    middle = pixel[1:-1][together]
    if middle.size == 0:
        return math.inf
    long = 4.0  # frames from which on an interval's fraction of a frame is as good as random
    half = spikes.shape[0] // 2
    change = np.abs(spikes[:half].sum(0, dtype=np.int64) - spikes[-half:].sum(0, dtype=np.int64)).ravel()
    relative = change / np.maximum(spikes.sum(0, dtype=np.int64).ravel(), 1)
    steady = (relative[middle] <= np.quantile(relative[np.unique(middle)], 0.25)) & (length >= long)
    # Σ bend² − 20/12 against Σ 6 n² / θ; long intervals, whose squares scatter most, at less weight.
    weight = 1 / (1 + length[steady] ** 2)
    shot = float((weight * (bend[steady] ** 2 - 20 / 12)).sum())
    reference = float((weight * 6 * length[steady] ** 2 * white_rate).sum())
    return reference / shot if shot > 0 else math.inf
