"""Playback: the picture that a spike camera's viewer shows of a moment, at the sensor's own resolution.

Three ways to read intensity off the spikes around a key frame. All return intensity, 1 = white, linear, not cut at 1.

- `tfp` counts spikes in a window: steady, blurred by motion.
- `tfi` measures the one interval that holds the key frame: sharp in time, coarse in intensity (θ over a whole number).
- `stp` lets a model synapse with short-term plasticity listen to each pixel and reads the rate off its state: between
  the two.

TFP and TFI: Zhu, Dong, Huang, Tian, "A retina-inspired sampling method for visual texture reconstruction", ICME 2019.
"""

import math
import operator
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from scsr_opt._arrays import as_array
from scsr_opt.camera.recording import WHITE_RATE, checked_white_rate
from scsr_opt.camera.sources import as_spikes, checked_shape
from scsr_opt.errors import InputError, shown

WINDOW = 21
"""Frames that `tfp` averages over, where nothing else is said and the recording has as many."""


def tfp(
    spikes: Any, key: int, *, window: int | None = None, white_rate: float | int = WHITE_RATE
) -> Float[np.ndarray, "h w"]:
    """Texture from playback: spikes counted in a window around the key frame, over its length (Zhu et al. 2019).

    The count of n frames is off by up to one spike, the intensity by up to θ/n; whatever moves during the window is
    blurred.

    **Arguments:**
    - `spikes`: (T, h, w), bool or integer 0 and 1; a `Recording` will do.
    - `key`: key frame, 0 to T − 1.
    - `window`: frames, centred on the key frame (an even one has one more before it than after); 21 if not given, or
      all of a shorter recording. Where it reaches over an end of the recording, the frames that are there are used and
      divided by.
    - `white_rate`: spikes per frame of a pixel at intensity 1.

    **Returns:** (h, w) float32, intensity.

    **Raises:** `InputError` if `spikes` are not such an array, `key` is outside, the recording has no `window` of so
    many frames, or `white_rate` cannot be used.
    """
    recording, key, rate = _checked(spikes, key, white_rate)
    length = min(WINDOW, len(recording)) if window is None else _index(window, "window")
    if not 1 <= length <= len(recording):
        raise InputError(
            f"window is {window}, but it must be a whole number of frames, from 1 to the {len(recording)} that there "
            f"are."
        )
    start = key - length // 2
    part = recording[max(start, 0) : start + length]
    return (part.sum(0, dtype=np.float64) / (len(part) * rate)).astype(np.float32)


def tfi(spikes: Any, key: int, *, white_rate: float | int = WHITE_RATE) -> Float[np.ndarray, "h w"]:
    """Texture from interval: θ over the length of the interval between spikes that holds the key frame (Zhu et al.
    2019).

    The interval is (a, b] with a the last spike before the key frame and b the first one in it or after it; its light
    was θ. Where there is no such pair, nothing measured the intensity at the key frame; the value is then θ over the
    longest gap that is known: the larger of the gap without a spike that holds the key frame, cut off by the
    recording's end, and the nearest whole interval (the cut-off gap on the other side where there is none). The cut-off
    gap bounds the intensity from above: a pixel that never fired has θ/T, which is as much as it can have seen.

    **Arguments:** as `tfp`.

    **Returns:** (h, w) float32, intensity.

    **Raises:** `InputError` if `spikes` are not such an array, `key` is outside, or `white_rate` cannot be used.
    """
    recording, key, rate = _checked(spikes, key, white_rate)
    before, after = _spikes_around(recording, key)
    gap = (after - before).astype(np.float64)
    open_ended = (before < 0) | (after == len(recording))
    gap[open_ended] = _longest_known_gap(recording[:, open_ended], key)
    return (1 / (gap * rate)).astype(np.float32)


def stp(
    spikes: Any,
    key: int,
    *,
    white_rate: float | int = WHITE_RATE,
    history: int = 200,
    base_release: float | int = 0.15,
    facilitation: float | int = 0.15,
    depression_time: float | int = 1.0,
    facilitation_time: float | int = 10.0,
) -> Float[np.ndarray, "h w"]:
    """Short-term plasticity: the spike rate read off the state of a model synapse at each pixel (Zheng et al. 2021).

    Each spike releases a part u of a synapse's resources R and raises the part that the next will release; both recover
    in between (Tsodyks–Markram). From one spike to the next, Δ frames later (Maass and Markram 2002):

        R ← 1 − (1 − R (1 − u)) exp(−Δ/τ_D),        u ← u₀ + (u + f (1 − u) − u₀) exp(−Δ/τ_F).

    At a constant rate 1/Δ both settle, and either settled value gives the rate back:

        1/Δ = −1 / (τ_D ln[(1 − R) / (1 − R (1 − u))]) = −1 / (τ_F ln[(u − u₀) / (u − u₀ + f (1 − u))]).

    The intensity is the mean of the two rates times θ. With the default times R knows little more than the last
    interval, as `tfi`, and u the last few of a bright pixel: the noise of the whole-numbered intervals is averaged over
    about 10 frames, and motion blurs less than in a window.

    *What was read and what was assumed.* The method is that of Y. Zheng, L. Zheng, Yu, Shi, Tian and Huang, "High-speed
    Image Reconstruction through Short-term Plasticity for Spiking Cameras", CVPR 2021. Read were the abstract of its
    extended version (TPAMI 2023), and the equations and constants (u₀ = 0.15, f = 0.15, τ_D = 0.05·20, τ_F = 0.5·20, in
    frames) as the authors' public implementation (SpikeCV, class TFSTP) states them; not the full text. That shows the
    sum of the two rates, stretched to the full range, its histogram equalised; here the sum becomes an absolute
    intensity. Assumed here: a synapse starts settled at its pixel's first interval (from rest it would take some spikes
    to get there); the last interval it hears is the one that holds the key frame, as in `tfi`; a pixel without such an
    interval has what the synapse says, but no more than the gap without a spike allows, and a synapse that has heard no
    interval gives way to `tfi`. The second model of the extended version, with a synapse each for moving and resting
    regions, is not here.

    **Arguments:**
    - `spikes`, `key`, `white_rate`: as `tfp`.
    - `history`: frames before the key frame whose spikes are listened to. The synapse forgets with τ_F: more than 20
      τ_F changes nothing.
    - `base_release`: u₀, in (0, 1).
    - `facilitation`: f, in (0, 1).
    - `depression_time`, `facilitation_time`: τ_D, τ_F, spike frames.

    **Returns:** (h, w) float32, intensity.

    **Raises:** `InputError` if `spikes` are not such an array, `key` is outside, or a parameter is out of range.
    """
    recording, key, rate = _checked(spikes, key, white_rate)
    if _index(history, "history") < 0:
        raise InputError(f"history is {history}, but it must be a whole number of frames, 0 or more.")
    synapse = _Synapse(
        recording.shape[1] * recording.shape[2],
        _between("base_release", base_release, 1.0, "a part of the resources"),
        _between("facilitation", facilitation, 1.0, "a part of what is left to facilitate"),
        _between("depression_time", depression_time, math.inf, "in spike frames"),
        _between("facilitation_time", facilitation_time, math.inf, "in spike frames"),
    )
    last = np.full(synapse.size, -1)
    for t in range(max(key - operator.index(history), 0), key):
        fired = np.flatnonzero(recording[t])
        known = fired[last[fired] >= 0]
        synapse.hear(known, (t - last[known]).astype(np.float64))
        last[fired] = t
    before, after = (a.ravel() for a in _spikes_around(recording, key))
    closed = np.flatnonzero((before >= 0) & (after < len(recording)))
    synapse.hear(closed, (after - before)[closed].astype(np.float64))
    heard = np.flatnonzero(synapse.settled)
    image = tfi(recording, key, white_rate=rate).ravel()
    told = synapse.rate(heard)
    unfinished = after[heard] == len(recording)
    silence = np.maximum(len(recording) - 1 - before[heard], 1)
    image[heard] = np.where(unfinished, np.minimum(told, 1 / silence), told) / rate
    return image.reshape(recording.shape[1:])


class _Synapse:
    """`size` synapses, each with its own spikes.

    What is stored are the logarithms of R's and u's distances from rest, 1 − R and u − u₀: they fall exponentially with
    the interval, and their ratio to what they were before it holds the rate. 1 − R itself is lost in rounding after 37
    frames.
    """

    def __init__(self, size: int, u0: float, f: float, tau_d: float, tau_f: float):
        self.size, self._u0, self._f, self._tau_d, self._tau_f = size, u0, f, tau_d, tau_f
        self.settled = np.zeros(size, bool)
        self._log_lack = np.full(size, -np.inf)  # ln(1 − R)
        self._log_lift = np.full(size, -np.inf)  # ln(u − u₀)

    def _after_spike(
        self, log_lack: Float[np.ndarray, " n"], log_lift: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """1 − R and u − u₀ just after a spike that found the given state."""
        lack, lift = np.exp(log_lack), np.exp(log_lift)
        u = self._u0 + lift
        return u + lack * (1 - u), lift + self._f * (1 - u)

    def hear(self, which: Int[np.ndarray, " n"], interval: Float[np.ndarray, " n"]) -> None:
        """A spike at each of the synapses `which`, `interval` frames after the one before it."""
        new = ~self.settled[which]
        first, waited = which[new], interval[new]
        decay_d, decay_f = np.exp(-waited / self._tau_d), np.exp(-waited / self._tau_f)
        f, u0 = self._f, self._u0
        log_lift = np.log(f * (1 - u0)) - waited / self._tau_f - np.log1p(-(1 - f) * decay_f)
        u = u0 + np.exp(log_lift)
        self._log_lift[first] = log_lift
        self._log_lack[first] = np.log(u) - waited / self._tau_d - np.log1p(-(1 - u) * decay_d)
        self.settled[first] = True
        old, waited = which[~new], interval[~new]
        lack, lift = self._after_spike(self._log_lack[old], self._log_lift[old])
        self._log_lack[old] = np.log(lack) - waited / self._tau_d
        self._log_lift[old] = np.log(lift) - waited / self._tau_f

    def rate(self, which: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Spikes per frame that would have settled at the present state."""
        log_lack, log_lift = self._log_lack[which], self._log_lift[which]
        lack, lift = self._after_spike(log_lack, log_lift)
        by_resources = 1 / (self._tau_d * (np.log(lack) - log_lack))
        by_release = 1 / (self._tau_f * (np.log(lift) - log_lift))
        return (by_resources + by_release) / 2


def _spikes_around(
    recording: UInt8[np.ndarray, "T h w"], key: int
) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """The last spike before `key` (−1 where there is none), and the first one in it or after it (T where there is
    none)."""
    frames = len(recording)
    before = _search(recording, range(key - 1, -1, -1), -1)
    after = _search(recording, range(key, frames), frames)
    return before, after


def _search(recording: UInt8[np.ndarray, "T h w"], times: range, missing: int) -> Int[np.ndarray, "h w"]:
    """The first of `times` at which each pixel fires. Frame by frame: most pixels are done after a few."""
    found = np.full(recording.shape[1:], missing)
    flat = found.ravel()  # a view: `found` is contiguous
    waiting = np.arange(flat.size)
    for t in times:
        fired = recording[t].ravel()[waiting] > 0
        flat[waiting[fired]] = t
        waiting = waiting[~fired]
        if waiting.size == 0:
            break
    return found


def _longest_known_gap(trains: UInt8[np.ndarray, "T n"], key: int) -> Float[np.ndarray, " n"]:
    """Frames by which to bound pixels that have no spike before `key`, or none from it on."""
    frames, number = trains.shape
    if number == 0:
        return np.zeros(0)
    silent_after = ~trains[key:].any(0)
    seen_from_end = np.where(silent_after, trains[::-1], trains)  # as if the key always lay in the first, cut-off gap
    first, second = _first_two(seen_from_end > 0)
    nearest = np.where(second < frames, second - first, frames - 1 - first)
    gap = np.where(first < frames, np.maximum(first, nearest), frames)
    return np.maximum(gap, 1).astype(np.float64)


def _first_two(trains: Bool[np.ndarray, "T n"]) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """When each train fires for the first and for the second time; T where it does not."""
    frames = len(trains)
    count = np.cumsum(trains, 0, dtype=np.int32)
    first, second = (np.where(count[-1] >= n, np.argmax(count >= n, 0), frames) for n in (1, 2))
    return first, second


def _checked(spikes: Any, key: Any, white_rate: Any) -> tuple[UInt8[np.ndarray, "T h w"], int, float]:
    array = as_array(spikes, "The array of spikes")
    checked_shape(array.shape, "The array of spikes")
    recording = as_spikes(array, "The array of spikes")
    frame = _index(key, "key")
    if not 0 <= frame < len(recording):
        raise InputError(
            f"Key frame {frame} is not in the recording of {len(recording)} frames: choose one from 0 to "
            f"{len(recording) - 1}."
        )
    return recording, frame, checked_white_rate(white_rate)


def _index(value: Any, name: str) -> int:
    try:
        return operator.index(value)
    except TypeError:
        raise InputError(f"{name} is {shown(value)}, but frames are counted in whole numbers.") from None


def _between(name: str, value: Any, below: float, unit: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not 0 < number < below:
        limit = "above 0" if below == math.inf else f"between 0 and {below:g}"
        raise InputError(f"{name} is {shown(value)}, but it must be a finite number {limit}, {unit}.")
    return number
