"""What all motion estimates here share: short pictures along the recording, moved to the key frame and compared.

A recording is cut into stretches of a few frames; each gives a picture I_b at time τ_b from the key frame. With the
right motion d, the pictures J_b(q) = I_b(q + d(q, τ_b)) all show the key frame, and agree. If the velocity is wrong by
δ, they drift: J_b ≈ J̄ + τ_b ∇J̄·δ. So δ follows from the slope of J_b over τ_b, a regression over the whole recording
(Gauss–Newton on the variance along the motion), where two playbacks would use two of its moments only. Times far from
the key frame are taken in step by step: at 40,000 frames a second the near ones hardly move, and nothing has to be
guessed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.saturation import spike_counts
from scsr_opt.camera.sparse import sparse_pixels
from scsr_opt.camera.spike_times import SpikeTimes
from scsr_opt.motion.inversion import Corner, corner_of, in_turn, interpolated

Found = TypeVar("Found")

# Standard deviations at which the Gaussian that pictures are presmoothed with is cut off. What is cut at 3 passes a
# little of all frequencies: of an object (120×120, ×2) two layers then seemed to serve as well as three, and lost 1 dB.
_TAIL = 4.0


@dataclass(frozen=True, eq=False)
class MotionFrames:
    """Pictures along the recording: `picture` (n, h, w), intensity; `after` (n,), frames from the key frame.

    `firing` (h, w), if known: spikes per frame, mean over the recording. No picture shows changes that are faster than
    a pixel fires. `counted()` (n, h, w), if known: spikes per frame in each stretch, counted when they are asked for.
    They are noisier than the pictures, whose intervals reach beyond a stretch, but what one stretch counts no other
    does.
    """

    picture: Float[Array, "n h w"]
    after: Float[Array, " n"]
    firing: Float[Array, "h w"] | None = None
    counted: Callable[[], Float[Array, "n h w"]] | None = None
    _known: dict[str, Any] = field(default_factory=dict, init=False, repr=False)
    _presmoothed: dict[float, "MotionFrames"] = field(default_factory=dict, init=False, repr=False)

    def presmoothed(self, sigma: float | int) -> "MotionFrames":
        """The pictures blurred by a Gaussian of `sigma` sensor pixels: fine texture that has moved far is not mistaken.

        Made once for each `sigma`: nearly everything that looks at pictures asks for the same few."""
        if sigma not in self._presmoothed:
            blurred = smooth(self.picture, jnp.asarray(sigma, jnp.float32), jnp.asarray(_TAIL))
            self._presmoothed[sigma] = MotionFrames(blurred, self.after, self.firing)
        return self._presmoothed[sigma]

    def once(self, what: str, found: Callable[[], Found]) -> Found:
        """What is `found` about these pictures, the first time that it is asked for."""
        if what not in self._known:
            self._known[what] = found()
        return self._known[what]

    def from_moment(self, after: float) -> "MotionFrames":
        """The same pictures, with times counted from another moment, `after` so many frames."""
        return MotionFrames(self.picture, self.after - after, self.firing, self.counted)

    def part(self, rows: slice, columns: slice) -> "MotionFrames":
        """The pictures of a part of the sensor."""
        height, width = self.picture.shape[1:]
        if len(range(height)[rows]) == height and len(range(width)[columns]) == width:
            return self
        firing = None if self.firing is None else self.firing[rows, columns]
        counted = self.counted
        of_part = None if counted is None else lambda: counted()[:, rows, columns]
        part = MotionFrames(self.picture[:, rows, columns], self.after, firing, of_part)
        part._presmoothed.update({sigma: found.part(rows, columns) for sigma, found in self._presmoothed.items()})
        return part


def stretches(
    spikes: Shaped[np.ndarray, "T h w"], *, key: int, white_rate: float | int = 0.6, most: int = 25
) -> MotionFrames:
    """The recording as at most `most` pictures of equal length (about four frames or more), edge to edge.

    The ends of the recording, where many pixels have not fired yet or do not fire again, are left out (a fifth of it
    each at most): what fills such gaps is the same light at other times, which stands still, and pulls a velocity
    towards zero by about 1 % if it takes part, and by 5 % by day, up to all of it in dim light, where the key frame is
    at that end. So the key frame itself may be among what is left out.
    """
    frames = spikes.shape[0]
    begin, end = _measured(spikes)
    # By the length of the recording alone, so that compiled code is met again whatever is left out at the ends.
    number = min(max(frames // 4, 2), most) if frames > 2 else 1
    edges = np.linspace(begin, end, number + 1)
    middle = (edges[1:] + edges[:-1]) / 2 - key
    rates = interval_rates(spikes, edges, white_rate=white_rate)
    firing = spike_counts(spikes).astype(np.float32) / np.float32(frames)
    known = (jnp.asarray(each, jnp.float32) for each in (rates, middle, firing))
    return MotionFrames(*known, counted=lambda: _counted(spikes, edges))


def _counted(spikes: Shaped[np.ndarray, "T h w"], edges: Float[np.ndarray, " edges"]) -> Float[Array, "n h w"]:
    """Spikes per frame between whole frames near the edges."""
    whole = np.rint(edges).astype(int)
    whole[1:] = np.maximum(whole[1:], whole[:-1] + 1)
    stretched = pairwise(whole.tolist())
    counts = np.stack([spike_counts(spikes[begin:end]) for begin, end in stretched])
    return jnp.asarray(counts, jnp.float32) / jnp.asarray(np.diff(whole), jnp.float32)[:, None, None]


# The share of the pixels that must have fired at the first moment that is used, and must still fire at the last one.
_FIRED = 0.85


def _measured(spikes: Shaped[np.ndarray, "T h w"]) -> tuple[int, int]:
    """First and last frame between which most pixels are measured between two spikes."""
    frames = spikes.shape[0]
    if frames < 16:
        return 0, frames - 1
    some = SpikeTimes.of(sparse_pixels(spikes, 2))
    fired = some.count > 0
    if not fired.any():
        return 0, frames - 1
    gaps = some.first[fired], frames - 1 - some.last[fired]
    early, late = (int(np.quantile(gap, _FIRED, method="higher")) for gap in gaps)
    return min(early, frames // 5), frames - 1 - min(late, frames // 5)


def along(
    after: Float[Array, ""], velocity: Float[Array, "2 h w"], acceleration: Float[Array, "2 h w"], *, every: int = 1
) -> tuple[Corner, Float[Array, "rows columns"]]:
    """Where a motion (sensor pixels per frame and per frame²) takes what each pixel of the key frame shows, `after` so
    many frames, and 1 where it is in view then, 0 where it is not; with `every`, of one row and column in so many."""
    height, width = velocity.shape[1:]
    # Rows and columns apart: as one array of places, a pass took five times as long.
    (down, right), (down_more, right_more) = (of[:, ::every, ::every] for of in (velocity, acceleration))
    row = jnp.arange(0, height, every, dtype=after.dtype)[:, None] + after * down + 0.5 * after**2 * down_more
    column = jnp.arange(0, width, every, dtype=after.dtype)[None] + after * right + 0.5 * after**2 * right_more
    inside = (row >= 0) & (column >= 0) & (row <= height - 1) & (column <= width - 1)
    return corner_of(row, column, height, width), inside.astype(after.dtype)


class Drift(NamedTuple):
    """The pictures along a motion, reduced to what an update of the motion needs.

    **Fields:** `mean` (h, w) J̄ and its gradient `slope` (2, h, w); for the regressors τ and τ²/2, taken without their
    mean over the moments at which q is in view: `change` (2, h, w) = Σ_b (basis)(J_b − J̄), `spread` (2, 2, h, w) =
    Σ_b (basis)(basis)ᵀ; `residual` (h, w) = Σ_b (J_b − J̄)², and `seen` (h, w), the number of moments.
    """

    mean: Float[Array, "h w"]
    slope: Float[Array, "2 h w"]
    change: Float[Array, "2 h w"]
    spread: Float[Array, "2 2 h w"]
    residual: Float[Array, "h w"]
    seen: Float[Array, "h w"]


@jax.jit
def drift(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    taking_part: Float[Array, " n"],
    motion: tuple[Float[Array, "2 h w"], Float[Array, "2 h w"]] | None,
) -> Drift:
    """`Drift` of the pictures along a motion, (velocity, acceleration), or at rest. Moments with `taking_part` 0 are
    left out."""
    # Sums of squares are taken about the key picture, so that little is lost when the mean is subtracted from them.
    about = pictures[jnp.argmin(jnp.abs(after))]

    def place(k: Array) -> tuple[Corner, Array] | None:
        return None if motion is None else along(after[k], *motion)

    def look(k: Array, placed: tuple[Corner, Array] | None) -> tuple[Array, Array]:
        if placed is None:
            return pictures[k], jnp.ones_like(about)
        corner, inside = placed
        return interpolated(pictures[k], corner), inside

    def add(k: Array, found: tuple[Array, Array], sums: list[Array]) -> list[Array]:
        tau, (value, inside) = after[k], found
        value, weight = value - about, taking_part[k] * inside
        weighted = weight * value
        powers = [weight, weight * tau, weight * tau**2, weight * tau**3, weight * tau**4]
        values = [weighted, weighted * tau, weighted * (tau**2 / 2), weighted * value]
        return [total + more for total, more in zip(sums, powers + values, strict=True)]

    # Before the first moment that takes part, and after the last, nothing is looked up.
    numbers = jnp.arange(after.size)
    begin = jnp.min(jnp.where(taking_part != 0, numbers, after.size))
    end = jnp.max(jnp.where(taking_part != 0, numbers + 1, 0))
    # Kept apart: as one array they took a quarter longer.
    sums = in_turn(place, look, add, [jnp.zeros_like(about)] * 9, begin, end)
    moments, values = jnp.stack(sums[:5]), jnp.stack(sums[5:])
    # Σ weight, of the regressors τ and τ²/2, and of their products.
    seen, first = moments[0], jnp.stack([moments[1], moments[2] / 2])
    products = moments[2:] / jnp.array([1, 2, 4], after.dtype)[:, None, None]
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


# The widest window that `smooth` is asked for, in sensor pixels, and how many pixels of it are added in one pass.
_REACH, _AT_ONCE = 18, 16


@jax.jit
def smooth(
    values: Float[Array, "... h w"], sigma: Float[Array, ""], cut: Float[Array, ""] | float = 3.0
) -> Float[Array, "... h w"]:
    """Gaussian smoothing over the last two axes, σ cut off at `cut` σ (18 pixels at most); beyond the border its values
    continue.

    Both are data, not part of the compiled code: one compilation serves all windows.
    """
    sigma = sigma.astype(values.dtype)
    reach = jnp.minimum(jnp.ceil(jnp.asarray(cut, values.dtype) * sigma).astype(jnp.int32), _REACH)
    # The last pass may begin at the last tap.
    offsets = jnp.arange(2 * _REACH + _AT_ONCE, dtype=jnp.int32) - _REACH
    distance = offsets.astype(values.dtype) / sigma
    taps = jnp.where(jnp.abs(offsets) <= reach, jnp.exp(-0.5 * distance**2), 0)
    taps = taps / taps.sum()
    for axis in (values.ndim - 2, values.ndim - 1):
        border = [(0, 0)] * values.ndim
        border[axis] = (_REACH, _REACH + _AT_ONCE - 1)
        wide = jnp.pad(values, border, mode="edge")
        length = values.shape[axis]

        def add(k: Array, total: Array, wide: Array = wide, axis: int = axis, length: int = length) -> Array:
            first = _REACH - reach + k * _AT_ONCE
            part = jax.lax.dynamic_slice_in_dim(wide, first, length + _AT_ONCE - 1, axis)
            some = jax.lax.dynamic_slice_in_dim(taps, first, _AT_ONCE)
            shifted = (jax.lax.slice_in_dim(part, j, j + length, axis=axis) for j in range(_AT_ONCE))
            return total + sum((some[j] * each for j, each in enumerate(shifted)), start=jnp.zeros_like(total))

        values = jax.lax.fori_loop(0, -(-(2 * reach + 1) // _AT_ONCE), add, jnp.zeros_like(values))
    return values


def filled(pictures: Float[Array, "n h w"], good: np.ndarray) -> Float[Array, "n h w"]:
    """The pictures with all but the good pixels replaced by a Gaussian mean of good ones around them."""
    weight = jnp.asarray(good, pictures.dtype)
    reach = jnp.asarray(1.0)
    nearby = smooth(pictures * weight[None], reach) / jnp.maximum(smooth(weight, reach), 1e-6)[None]
    return jnp.where(jnp.asarray(good)[None], pictures, nearby)
