"""`MotionFrames`: short pictures along the recording, which all motion estimators move to the key frame and compare.

A recording is cut into stretches of a few frames; each gives a picture I_b at time τ_b from the key frame. With the
right motion d, the pictures J_b(q) = I_b(q + d(q, τ_b)) all show the key frame, and agree. If the velocity is wrong by
δ, they drift: J_b ≈ J̄ + τ_b ∇J̄·δ. So δ follows from the slope of J_b over τ_b, a regression over the whole recording
(Gauss–Newton on the variance along the motion), where two playbacks would use two of its moments only. Times far from
the key frame are included level by level: at 40,000 frames a second nothing moves far in the near ones, so that no
first guess is needed.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from scsr_opt._kernels.device import on_device
from scsr_opt.camera.light import Light
from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.saturation import spike_counts
from scsr_opt.camera.sparse import sparse_pixels
from scsr_opt.camera.spike_times import SpikeTimes
from scsr_opt.motion.inversion import Corner, corner_of, in_turn, interpolated
from scsr_opt.motion.settings import DEFAULTS, FrameSettings, MotionSettings

Value = TypeVar("Value")


def _cached(method: Callable[["MotionFrames", float], Value]) -> Callable[["MotionFrames", float], Value]:
    """`functools.cached_property` for a method with one number as argument: computed at the first call with it.

    The value must follow from the fields and that number alone.
    """

    @functools.wraps(method)
    def cached(self: "MotionFrames", number: float | int) -> Value:
        values: dict[tuple[str, float], Any] = vars(self).setdefault("_cached_values", {})
        key = (method.__name__, float(number))
        if key not in values:
            values[key] = method(self, float(number))
        return values[key]

    return cached


@dataclass(frozen=True, eq=False)
class MotionFrames:
    """Short pictures along a recording, by which motion is estimated.

    **Fields:**
    - `picture`: (n, h, w), intensity.
    - `after`: (n,), frames from the key frame.
    - `firing`: (h, w), spikes per frame of each pixel, mean over the recording; None if unknown. No picture shows
      changes that are faster than a pixel fires.
    - `counted`: gives (n, h, w), spikes per frame in each stretch; None if unknown. Counts are noisier than `picture`,
      whose intervals reach beyond a stretch, but two stretches never share a spike. They are needed rarely, so that
      they are counted on demand.
    - `cutoff`: standard deviations at which the Gaussian of `presmoothed` is cut off.
    - `known`: pictures presmoothed by the widths that are its keys, sensor pixels, where these are known already.

    The methods with one number as argument compute on demand and keep their result, which several stages use; it
    follows from the fields alone.
    """

    picture: Float[Array, "n h w"]
    after: Float[Array, " n"]
    firing: Float[Array, "h w"] | None = None
    counted: Callable[[], Float[Array, "n h w"]] | None = None
    cutoff: float = DEFAULTS.comparison.presmoothing_cutoff_sigmas
    known: Mapping[float, Float[Array, "n h w"]] = field(default_factory=dict)

    @_cached
    def presmoothed(self, sigma: float) -> Float[Array, "n h w"]:
        """The pictures blurred by a Gaussian of `sigma` sensor pixels, so that fine texture that has moved far is not
        mistaken for its neighbour."""
        if sigma in self.known:
            return self.known[sigma]
        # As a stack, which is worked on while other work goes on; `smoothed` waits for each picture.
        return smooth(self.picture, np.float32(sigma), np.float32(self.cutoff))

    @_cached
    def drift_at_rest(self, sigma: float) -> "Drift":
        """`Drift` without motion, of all pictures presmoothed by `sigma` sensor pixels."""
        return drift_of(self.presmoothed(sigma), np.asarray(self.after), None)

    @_cached
    def presmoothed_counts(self, sigma: float) -> Float[Array, "n h w"] | None:
        """Spikes per frame in each stretch, blurred by a Gaussian of `sigma` sensor pixels; None if unknown."""
        if self.counted is None:
            return None
        return smooth(self.counted(), np.float32(sigma), np.float32(self.cutoff))

    @_cached
    def firing_around(self, window: float) -> Float[np.ndarray, "h w"] | None:
        """Spikes per frame, averaged by a Gaussian of `window` sensor pixels; None if unknown."""
        return None if self.firing is None else smoothed(self.firing, window)

    def from_moment(self, after: float) -> "MotionFrames":
        """These pictures with times counted from the moment that is `after` frames from the key frame."""
        return MotionFrames(self.picture, self.after - after, self.firing, self.counted, self.cutoff, self.known)

    def part(self, rows: slice, columns: slice, presmoothed: tuple[float, ...] = ()) -> "MotionFrames":
        """The pictures of a part of the sensor.

        **Arguments:** `presmoothed`: widths, sensor pixels, whose presmoothed pictures are cut out of those of the
        whole sensor: the caller has computed them already, and they are exact at the part's border.
        """
        height, width = self.picture.shape[1:]
        if len(range(height)[rows]) == height and len(range(width)[columns]) == width:
            return self

        def cut(of: Array) -> Array:
            return on_device(np.asarray(of)[..., rows, columns])

        firing, counted = None if self.firing is None else cut(self.firing), self.counted
        of_part = None if counted is None else lambda: cut(counted())
        known = {sigma: cut(self.presmoothed(sigma)) for sigma in presmoothed}
        return MotionFrames(cut(self.picture), self.after, firing, of_part, self.cutoff, known)


def motion_frames(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    key: int,
    white_rate: float | int = 0.6,
    light: Light | None = None,
    settings: MotionSettings = DEFAULTS,
) -> MotionFrames:
    """The `MotionFrames` of a recording: stretches of equal length, about four frames or more, edge to edge.

    The ends of the recording, where many pixels have not fired yet or do not fire again, are left out: such gaps are
    filled with light of other times, which stands still. Included, they would pull a velocity towards zero by about 1 %
    and, where the key frame is at that end, by 5 % by day, up to all of it in dim light. So the key frame itself may be
    left out.

    **Arguments:** `key`: the key frame, counted from the first frame. `white_rate`: spikes per frame of a pixel at
    intensity 1. `light` of each moment, where it changes: the pictures show the scene at the mean light.
    """
    frames, limits = spikes.shape[0], settings.frames
    begin, end = _measured(spikes, limits)
    # By the length of the recording alone, so that one compiled program serves whatever is left out at the ends.
    most = limits.most_pictures
    number = min(max(frames // limits.frames_per_picture, 2), most) if frames > 2 else 1
    edges = np.linspace(begin, end, number + 1)
    middle = (edges[1:] + edges[:-1]) / 2 - key
    rates = interval_rates(spikes, edges, white_rate=white_rate, light=light)
    firing = spike_counts(spikes).astype(np.float32) / np.float32(frames)
    picture, after, firing = (on_device(each.astype(np.float32)) for each in (rates, middle, firing))
    cutoff = settings.comparison.presmoothing_cutoff_sigmas
    return MotionFrames(picture, after, firing, lambda: _counted(spikes, edges, light), cutoff)


def _counted(
    spikes: Shaped[np.ndarray, "T h w"], edges: Float[np.ndarray, " edges"], light: Light | None
) -> Float[Array, "n h w"]:
    """Spikes per frame of mean light in each stretch, between the whole frames nearest to its edges."""
    whole = np.rint(edges).astype(int)
    whole[1:] = np.maximum(whole[1:], whole[:-1] + 1)
    stretched = pairwise(whole.tolist())
    counts = np.stack([spike_counts(spikes[begin:end]) for begin, end in stretched])
    lasted = np.diff(whole)[:, None, None].astype(np.float32)
    if light is not None:
        lasted = lasted * light.over(whole - 0.5)  # frame t covers [t − ½, t + ½]
    return on_device(counts.astype(np.float32) / lasted)


def _measured(spikes: Shaped[np.ndarray, "T h w"], settings: FrameSettings) -> tuple[int, int]:
    """First and last frame between which most pixels lie between two of their spikes."""
    frames = spikes.shape[0]
    if frames < settings.trimmed_from_frames:
        return 0, frames - 1
    some = SpikeTimes.of(sparse_pixels(spikes, 2))
    fired = some.count > 0
    if not fired.any():
        return 0, frames - 1
    gaps = some.first[fired], frames - 1 - some.last[fired]
    share, most = settings.measured_pixels_share, int(settings.trimmed_share * frames)
    early, late = (int(np.quantile(gap, share, method="higher")) for gap in gaps)
    return min(early, most), frames - 1 - min(late, most)


def along(
    after: Float[Array, ""], velocity: Float[Array, "2 h w"], acceleration: Float[Array, "2 h w"], *, every: int = 1
) -> tuple[Corner, Float[Array, "rows columns"]]:
    """Positions of the key frame's points `after` frames later, along a motion (sensor pixels per frame and per
    frame²), and 1 where the position is in view, else 0; for each `every`-th row and column."""
    height, width = velocity.shape[1:]
    # Rows and columns apart: as one array of positions, a pass took five times as long.
    (down, right), (down_more, right_more) = (of[:, ::every, ::every] for of in (velocity, acceleration))
    row = jnp.arange(0, height, every, dtype=after.dtype)[:, None] + after * down + 0.5 * after**2 * down_more
    column = jnp.arange(0, width, every, dtype=after.dtype)[None] + after * right + 0.5 * after**2 * right_more
    inside = (row >= 0) & (column >= 0) & (row <= height - 1) & (column <= width - 1)
    return corner_of(row, column, height, width), inside.astype(after.dtype)


class Drift(NamedTuple):
    """Regression of the pictures J_b along a motion over time τ_b, for each point q of the key frame.

    **Fields:**
    - `mean`: (h, w), J̄ over the moments at which q is in view; `slope`: (2, h, w), its gradient.
    - `change`: (2, h, w), Σ_b (basis)(J_b − J̄), where the basis is τ and τ²/2 without their mean over these moments.
    - `spread`: (2, 2, h, w), Σ_b (basis)(basis)ᵀ.
    - `residual`: (h, w), Σ_b (J_b − J̄)².
    - `seen`: (h, w), the number of these moments.
    """

    mean: Float[Array | np.ndarray, "h w"]
    slope: Float[Array | np.ndarray, "2 h w"]
    change: Float[Array | np.ndarray, "2 h w"]
    spread: Float[Array | np.ndarray, "2 2 h w"]
    residual: Float[Array | np.ndarray, "h w"]
    seen: Float[Array | np.ndarray, "h w"]


@jax.jit
def drift(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    taking_part: Float[Array, " n"],
    motion: tuple[Float[Array, "2 h w"], Float[Array, "2 h w"]],
) -> Drift:
    """`Drift` of the pictures along a motion.

    **Arguments:** `after`: frames from the key frame. `taking_part`: 1, or 0 for moments that are left out. `motion`:
    velocity and acceleration.
    """
    # Sums of squares are taken about the key picture, so that little is lost when the mean is subtracted from them.
    about = pictures[jnp.argmin(jnp.abs(after))]

    def place(k: Array) -> tuple[Corner, Array]:
        return along(after[k], *motion)

    def look(k: Array, placed: tuple[Corner, Array]) -> tuple[Array, Array]:
        corner, inside = placed
        return interpolated(pictures[k], corner), inside

    def add(k: Array, found: tuple[Array, Array], sums: list[Array]) -> list[Array]:
        value, inside = found
        return _with_moment(sums, after[k], value, taking_part[k] * inside, about)

    # From the first moment that takes part to the last one.
    numbers = jnp.arange(after.size)
    begin = jnp.min(jnp.where(taking_part != 0, numbers, after.size))
    end = jnp.max(jnp.where(taking_part != 0, numbers + 1, 0))
    # Kept apart: as one array they took a quarter longer.
    sums = in_turn(place, look, add, [jnp.zeros_like(about)] * 9, begin, end)
    return _drift_by(sums, about)


def drift_of(
    pictures: Float[Array | np.ndarray, "n h w"],
    after: Float[np.ndarray, " n"],
    motion: tuple[Float[np.ndarray, "2 h w"], Float[np.ndarray, "2 h w"]] | None,
    taking_part: Bool[np.ndarray, " n"] | None = None,
) -> Drift:
    """`drift` outside `jit`, picture by picture: small programs serve any number of pictures, with motion and at rest.

    **Arguments:** `motion`: velocity and acceleration; None at rest. `taking_part`: all moments if None.

    **Returns:** arrays of NumPy.
    """
    pictures = np.asarray(pictures)
    about = pictures[np.argmin(np.abs(after))]
    fields = None if motion is None else (on_device(motion[0]), on_device(motion[1]))
    ones, sums = np.ones_like(about), [np.zeros_like(about) for _ in range(9)]
    for k in np.arange(after.size) if taking_part is None else np.flatnonzero(taking_part):
        value, inside = (pictures[k], ones) if fields is None else picture_along(pictures[k], after[k], *fields)
        sums = _with_moment(sums, after[k], value, inside, about)
    return Drift(*map(np.asarray, _drift_by(sums, about)))


@jax.jit
def _with_moment(
    sums: list[Float[Array, "h w"]],
    tau: Float[Array, ""],
    value: Float[Array, "h w"],
    inside: Float[Array, "h w"],
    about: Float[Array, "h w"],
) -> list[Float[Array, "h w"]]:
    """The sums of `drift` with one moment more, whose weight `inside` is 0 or 1: of powers of τ, and of values."""
    value = (value - about) * inside
    powers = [inside, inside * tau, inside * tau**2, inside * tau**3, inside * tau**4]
    values = [value, value * tau, value * (tau**2 / 2), value * value]
    return [total + more for total, more in zip(sums, powers + values, strict=True)]


@jax.jit
def _drift_by(sums: list[Float[Array, "h w"]], about: Float[Array, "h w"]) -> Drift:
    """`Drift` by the sums over all moments (`_with_moment`), of pictures less `about`."""
    moments, values = jnp.stack(sums[:5]), jnp.stack(sums[5:])
    # Σ weight, of the regressors τ and τ²/2, and of their products.
    seen, first = moments[0], jnp.stack([moments[1], moments[2] / 2])
    products = moments[2:] / jnp.array([1, 2, 4], about.dtype)[:, None, None]
    count = jnp.maximum(seen, 1e-6)
    mean = values[0] / count
    square = jnp.stack([jnp.stack([products[0], products[1]]), jnp.stack([products[1], products[2]])])
    full = mean + about
    edged = jnp.pad(full, 1, mode="edge")
    return Drift(
        mean=full,
        slope=jnp.stack([edged[2:, 1:-1] - edged[:-2, 1:-1], edged[1:-1, 2:] - edged[1:-1, :-2]]) / 2,
        change=values[1:3] - first * mean[None],
        spread=square - first[:, None] * first[None] / count[None, None],
        residual=jnp.maximum(values[3] - values[0] * mean, 0),
        seen=seen,
    )


@partial(jax.jit, static_argnames="every")
def picture_along(
    picture: Float[Array, "h w"],
    after: Float[Array, ""],
    velocity: Float[Array, "2 h w"],
    acceleration: Float[Array, "2 h w"],
    *,
    every: int = 1,
) -> tuple[Float[Array, "rows columns"], Float[Array, "rows columns"]]:
    """A picture along a motion, read at the positions of the key frame's points `after` frames later, and 1 where the
    position is in view, else 0; for each `every`-th row and column."""
    corner, inside = along(after, velocity, acceleration, every=every)
    return interpolated(picture, corner), inside


# Largest reach of `smooth`, pixels, and how many taps are added in one pass (of its loop, to save memory traffic).
_REACH, _TAPS_AT_ONCE = 18, 16


@jax.jit
def smooth(
    values: Float[Array, "... h w"], sigma: Float[Array, ""], cut: Float[Array, ""] | float = 3.0
) -> Float[Array, "... h w"]:
    """Gaussian smoothing over the last two axes by a standard deviation of `sigma` pixels, cut off at `cut` of these
    and at 18 pixels; beyond the border its values continue.

    `sigma` and `cut` are data and not part of the compiled program: one program serves all windows.
    """
    sigma = sigma.astype(values.dtype)
    reach = jnp.minimum(jnp.ceil(jnp.asarray(cut, values.dtype) * sigma).astype(jnp.int32), _REACH)
    # The last pass may begin at the last tap.
    offsets = jnp.arange(2 * _REACH + _TAPS_AT_ONCE, dtype=jnp.int32) - _REACH
    distance = offsets.astype(values.dtype) / sigma
    taps = jnp.where(jnp.abs(offsets) <= reach, jnp.exp(-0.5 * distance**2), 0)
    taps = taps / taps.sum()
    for axis in (values.ndim - 2, values.ndim - 1):
        border = [(0, 0)] * values.ndim
        border[axis] = (_REACH, _REACH + _TAPS_AT_ONCE - 1)
        wide = jnp.pad(values, border, mode="edge")
        length = values.shape[axis]

        def add(k: Array, total: Array, wide: Array = wide, axis: int = axis, length: int = length) -> Array:
            first = _REACH - reach + k * _TAPS_AT_ONCE
            part = jax.lax.dynamic_slice_in_dim(wide, first, length + _TAPS_AT_ONCE - 1, axis)
            some = jax.lax.dynamic_slice_in_dim(taps, first, _TAPS_AT_ONCE)
            shifted = (jax.lax.slice_in_dim(part, j, j + length, axis=axis) for j in range(_TAPS_AT_ONCE))
            return total + sum((some[j] * each for j, each in enumerate(shifted)), start=jnp.zeros_like(total))

        values = jax.lax.fori_loop(0, -(-(2 * reach + 1) // _TAPS_AT_ONCE), add, jnp.zeros_like(values))
    return values


def smoothed(
    values: Float[Array | np.ndarray, "*n h w"], sigma: float | int, cut: float | int = 3.0
) -> Float[np.ndarray, "*n h w"]:
    """`smooth` of a stack, picture by picture: one program serves stacks of any number of pictures."""
    pictures = np.asarray(values)
    by, until = np.asarray(sigma, pictures.dtype), np.asarray(cut, pictures.dtype)
    found = [smooth(picture, by, until) for picture in pictures.reshape(-1, *pictures.shape[-2:])]
    return np.stack([np.asarray(picture) for picture in found]).reshape(pictures.shape)


def filled(pictures: Float[Array | np.ndarray, "*n h w"], good: Bool[np.ndarray, "h w"]) -> Float[Array, "*n h w"]:
    """The pictures with pixels that are not `good`, (h, w), replaced by a Gaussian mean of good ones around them."""
    pictures = np.asarray(pictures)
    weight = good.astype(pictures.dtype)
    nearby = smoothed(pictures * weight, 1.0) / np.maximum(smoothed(weight, 1.0), np.float32(1e-6))
    return on_device(np.where(good, pictures, nearby))
