"""Rules that make samples of a recording: the choice that `reconstruct` offers as `samples`."""

import abc
from numbers import Integral, Real

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Int, Shaped

from scsr_opt._validation import check_type
from scsr_opt.camera.noise import Noise
from scsr_opt.camera.samples import END_WEIGHT, RUN_FRAMES, Samples, spike_intervals, windows
from scsr_opt.errors import InputError, shown


class SamplingRule(eqx.Module):
    """A way to make intensity samples Y_i with exposures from spikes (Eq. 4; `scsr_opt.camera.samples`)."""

    @abc.abstractmethod
    def __call__(
        self,
        spikes: Shaped[np.ndarray, "T h w"],
        *,
        white_rate: float | int,
        still_for: Int[np.ndarray, "h w"],
        run: int | Int[np.ndarray, "*blocks h w"] = RUN_FRAMES,
        bad_pixels: Bool[np.ndarray, "h w"] | None = None,
    ) -> Samples:
        """The samples of a recording.

        **Arguments:** `spikes`, `white_rate`, `bad_pixels` as of `spike_intervals`; `still_for`: frames, at least 1,
        during which what a pixel sees hardly moves; `run`: as of `spike_intervals`, frames over which a saturated
        pixel is taken together.
        """


class Intervals(SamplingRule):
    """The light between two spikes of a pixel, Y = cθ / n; merged while nothing moves (`spike_intervals`).

    **Fields:**
    - `ends`: weight of the time before a pixel's first and after its last spike, from 0 to 1.
    - `noise`: of the camera, by which samples are weighted (`Noise.weights`): dark pixels count for more. By their
      duration if not given, which was as good or better on nearly all stills tried (docs/data-term.md).

    **Raises:** `InputError` for other weights, or for a `noise` that is none.
    """

    ends: float | int = END_WEIGHT
    noise: Noise | None = None

    def __check_init__(self):
        if not (isinstance(self.ends, Real) and 0 <= self.ends <= 1):
            raise InputError(f"Intervals was given ends={shown(self.ends)}; it is a weight from 0 to 1.")
        check_type(self.noise, Noise, "noise", "Noise(photons=100.0)")

    def __call__(
        self,
        spikes: Shaped[np.ndarray, "T h w"],
        *,
        white_rate: float | int,
        still_for: Int[np.ndarray, "h w"],
        run: int | Int[np.ndarray, "*blocks h w"] = RUN_FRAMES,
        bad_pixels: Bool[np.ndarray, "h w"] | None = None,
    ) -> Samples:
        return spike_intervals(
            spikes, white_rate=white_rate, shortest=still_for, run=run, bad_pixels=bad_pixels, ends=self.ends
        )


class Windows(SamplingRule):
    """Spikes counted in windows of `length` frames, one after the other, Y = cθ / n (`windows`).

    A count is wrong by up to θ, an interval by a frame's light: windows need 4 to 64 times the strength of the prior
    and are 0.8 to 6 dB behind (docs/data-term.md). For comparison, and for frames that were summed up before they came.

    **Fields:** `length`: frames, at least 1 and at most those that are used.

    **Raises:** `InputError` for a length below 1; when it is called, for one that does not fit the recording.
    """

    length: int

    def __check_init__(self):
        if not (isinstance(self.length, Integral) and self.length >= 1):
            found = f"Windows was given a length of {shown(self.length)}"
            raise InputError(f"{found}; it is a whole number of frames, 1 or more.")

    def __call__(
        self,
        spikes: Shaped[np.ndarray, "T h w"],
        *,
        white_rate: float | int,
        still_for: Int[np.ndarray, "h w"],
        run: int | Int[np.ndarray, "*blocks h w"] = RUN_FRAMES,
        bad_pixels: Bool[np.ndarray, "h w"] | None = None,
    ) -> Samples:
        return windows(spikes, length=self.length, white_rate=white_rate, bad_pixels=bad_pixels)
