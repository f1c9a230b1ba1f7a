"""What all motion estimates here share: short pictures along the recording, moved to the key frame and compared.

A recording is cut into stretches of a few frames; each gives a picture I_b at time τ_b from the key frame. With the
right motion d, the pictures J_b(q) = I_b(q + d(q, τ_b)) all show the key frame, and agree. If the velocity is wrong by
δ, they drift: J_b ≈ J̄ + τ_b ∇J̄·δ. So δ follows from the slope of J_b over τ_b, a regression over the whole recording
(Gauss–Newton on the variance along the motion), where two playbacks would use two of its moments only. Times far from
the key frame are taken in step by step: at 40,000 frames a second the near ones hardly move, and nothing has to be
guessed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped
from scipy.ndimage import gaussian_filter

from scsr_opt.camera.rates import interval_rates
from scsr_opt.motion.trajectory import bilinear


class Stretches(NamedTuple):
    """Pictures along the recording: `picture` (n, h, w), intensity; `after` (n,), frames from the key frame.

    `firing` (h, w), if known: spikes per frame, mean over the recording. No picture shows changes that are faster than
    a pixel fires.
    """

    picture: Float[Array, "n h w"]
    after: Float[Array, " n"]
    firing: Float[Array, "h w"] | None = None

    def part(self, rows: slice, columns: slice) -> "Stretches":
        """The pictures of a part of the sensor."""
        firing = None if self.firing is None else self.firing[rows, columns]
        return Stretches(self.picture[:, rows, columns], self.after, firing)


def stretches(
    spikes: Shaped[np.ndarray, "T h w"], *, key: int, white_rate: float | int = 0.6, most: int = 25
) -> Stretches:
    """The recording as at most `most` pictures of equal length (about four frames or more), edge to edge.

    The ends of the recording, where many pixels have not fired yet or do not fire again, are left out (a fifth of it
    each at most): what fills such gaps is the same light at other times, which stands still, and pulls a velocity
    towards zero by about 1 % if it takes part.
    """
    frames = spikes.shape[0]
    begin, end = _measured(spikes, key)
    # By the length of the recording alone, so that compiled code is met again whatever is left out at the ends.
    number = min(max(frames // 4, 2), most) if frames > 2 else 1
    edges = np.linspace(begin, end, number + 1)
    middle = (edges[1:] + edges[:-1]) / 2 - key
    rates = interval_rates(spikes, edges, white_rate=white_rate)
    firing = np.count_nonzero(spikes, axis=0).astype(np.float32) / np.float32(frames)
    return Stretches(jnp.asarray(rates), jnp.asarray(middle, jnp.float32), jnp.asarray(firing))


# The share of the pixels that must have fired at the first moment that is used, and must still fire at the last one.
_FIRED = 0.85


def _measured(spikes: Shaped[np.ndarray, "T h w"], key: int) -> tuple[int, int]:
    """First and last frame between which most pixels are measured between two spikes; always around the key frame."""
    frames = spikes.shape[0]
    if frames < 16:
        return 0, frames - 1
    some = np.asarray(spikes[:, ::2, ::2]).astype(bool, copy=False).reshape(frames, -1)
    some = some[:, some.any(0)]
    if some.shape[1] == 0:
        return 0, frames - 1
    early, late = (int(np.quantile(part.argmax(0), _FIRED, method="higher")) for part in (some, some[::-1]))
    begin, end = min(early, frames // 5), frames - 1 - min(late, frames // 5)
    return min(begin, key), max(end, key)


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
    velocity: Float[Array, "2 h w"],
    acceleration: Float[Array, "2 h w"],
) -> Drift:
    """`Drift` of the pictures along a motion. Moments with `taking_part` 0 are left out."""
    height, width = pictures.shape[1:]
    rows, columns = jnp.meshgrid(
        jnp.arange(height, dtype=jnp.float32), jnp.arange(width, dtype=jnp.float32), indexing="ij"
    )
    # Sums of squares are taken about the key picture, so that little is lost when the mean is subtracted from them.
    about = pictures[jnp.argmin(jnp.abs(after))]
    powers = jnp.arange(5, dtype=jnp.float32)

    def add(sums: tuple[Array, Array], one: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], None]:
        picture, tau, part = one
        row = rows + tau * velocity[0] + 0.5 * tau**2 * acceleration[0]
        column = columns + tau * velocity[1] + 0.5 * tau**2 * acceleration[1]
        inside = (row >= 0) & (column >= 0) & (row <= height - 1) & (column <= width - 1)
        weight = jnp.where(inside, part, 0)
        value = bilinear(picture[None], row, column)[0] - about
        moments, values = sums
        moments = moments + weight[None] * (tau**powers)[:, None, None]
        one_to_value = jnp.stack([weight, weight * tau, weight * tau**2 / 2, weight * value])
        values = values + one_to_value * value[None]
        return (moments, values), None

    start = (jnp.zeros((5, height, width), jnp.float32), jnp.zeros((4, height, width), jnp.float32))
    (moments, values), _ = jax.lax.scan(add, start, (pictures, after, taking_part))
    # Σ weight, of the regressors τ and τ²/2, and of their products.
    seen, first = moments[0], jnp.stack([moments[1], moments[2] / 2])
    products = moments[2:] / jnp.array([1.0, 2.0, 4.0])[:, None, None]
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


def presmoothed(pictures: Stretches, sigma: float | int) -> Stretches:
    """The pictures blurred by a Gaussian of `sigma` sensor pixels: fine texture that has moved far is not mistaken."""
    blurred = gaussian_filter(np.asarray(pictures.picture), sigma, axes=(1, 2), mode="nearest")
    return pictures._replace(picture=jnp.asarray(blurred))


# The widest window that `smooth` is asked for, in sensor pixels.
_REACH = 18


@jax.jit
def smooth(values: Float[Array, "... h w"], sigma: Float[Array, ""]) -> Float[Array, "... h w"]:
    """Gaussian smoothing over the last two axes (σ up to 6, cut off at 3σ); beyond the border its values continue.

    σ is data, not part of the compiled code: one compilation serves all windows.
    """
    reach = jnp.minimum(jnp.ceil(3 * sigma).astype(jnp.int32), _REACH)
    offsets = jnp.arange(-_REACH, _REACH + 1)
    distance = offsets.astype(values.dtype) / sigma
    taps = jnp.where(jnp.abs(offsets) <= reach, jnp.exp(-0.5 * distance**2), 0)
    taps = taps / taps.sum()
    for axis in (values.ndim - 2, values.ndim - 1):
        border = [(0, 0)] * values.ndim
        border[axis] = (_REACH, _REACH)
        wide = jnp.pad(values, border, mode="edge")
        length = values.shape[axis]

        def add(k: Array, total: Array, wide: Array = wide, axis: int = axis, length: int = length) -> Array:
            return total + taps[k] * jax.lax.dynamic_slice_in_dim(wide, k, length, axis)

        values = jax.lax.fori_loop(_REACH - reach, _REACH + reach + 1, add, jnp.zeros_like(values))
    return values
