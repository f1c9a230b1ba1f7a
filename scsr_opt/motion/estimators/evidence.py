"""Test of a motion against the recording: which pixels contradict it, and how well it predicts the pictures."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from scsr_opt.motion.estimators.frames import Drift, MotionFrames, along, drift, resting_drift, smoothed
from scsr_opt.motion.inversion import Corner, bilinear, in_turn, interpolated
from scsr_opt.motion.settings import DEFAULTS, ComparisonSettings, MotionSettings
from scsr_opt.motion.trajectory import Motion, key_frame_positions


def contradicted(
    pictures: MotionFrames, motion: Motion, settings: MotionSettings = DEFAULTS
) -> Bool[np.ndarray, "h w"]:
    """Contradiction test: pixels that are observable under `motion`, and whose window another velocity explains clearly
    better and at a clear distance (`EvidenceSettings`)."""
    limits, by = settings.evidence, settings.comparison
    after = np.asarray(pictures.after)
    fields = motion.velocity, motion.acceleration
    now = drift(pictures.presmoothed(by.presmoothing_px), after, np.ones_like(after), fields)
    gain, distance, _ = _score_test(now, after, settings)
    exceeds = (gain > limits.contradiction_likelihood) & (distance > limits.contradiction_px)
    return exceeds & observable(pictures, motion, settings)


def observable(pictures: MotionFrames, motion: Motion, settings: MotionSettings = DEFAULTS) -> Bool[np.ndarray, "h w"]:
    """Pixels that fire often enough to contradict this motion.

    Between two spikes a pixel does not resolve when its light came: what passes within an interval looks as if it stood
    still.
    """
    firing = pictures.firing_around(settings.comparison.window_px)
    if firing is None:
        return np.ones(motion.speed.shape, bool)
    return motion.speed <= settings.evidence.smear_px * firing


def at_rest(
    pictures: MotionFrames, settings: MotionSettings = DEFAULTS
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Pixels that contradict rest, and pixels that are certainly at rest.

    The first are those of `contradicted` for a motion of zero. The second are those where any motion by half a pixel
    over the recording would contradict rest, with enough spikes to show it.
    """
    limits, by = settings.evidence, settings.comparison
    likelihood, pixels = limits.contradiction_likelihood, limits.contradiction_px
    after = np.asarray(pictures.after)
    gain, distance, least = _score_test(pictures.drift_at_rest(by.presmoothing_px), after, settings)
    moving = (gain > likelihood) & (distance > pixels)
    certain = (gain <= likelihood) & (distance <= pixels) & (least > likelihood)
    firing = pictures.firing_around(by.window_px)
    if firing is not None:
        certain &= firing * np.ptp(after) >= limits.spikes_at_rest
    return moving, certain


def contradicts_rest(pictures: MotionFrames, settings: MotionSettings = DEFAULTS) -> bool:
    """Whether more pixels contradict rest than are tolerated."""
    return bool(at_rest(pictures, settings)[0].mean() > settings.evidence.tolerated_share_at_rest)


def variance_along(
    pictures: MotionFrames, motion: Motion, sigma: float | int, *, every: int = 1
) -> Float[np.ndarray, "rows columns"]:
    """Variance, intensity², of the pictures along a motion after presmoothing by `sigma` sensor pixels, at each
    `every`-th row and column."""
    presmoothed = pictures.presmoothed(sigma)
    return np.asarray(_variance(presmoothed, pictures.after, motion.velocity, motion.acceleration, every))


@partial(jax.jit, static_argnames="every")
def _variance(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    velocity: Float[Array, "2 h w"],
    acceleration: Float[Array, "2 h w"],
    every: int,
) -> Float[Array, "rows columns"]:
    """`Drift.residual` over `Drift.seen`, in two thirds of the time that `drift` takes."""
    about = pictures[jnp.argmin(jnp.abs(after)), ::every, ::every]

    def place(k: Array) -> tuple[Corner, Array]:
        return along(after[k], velocity, acceleration, every=every)

    def look(k: Array, placed: tuple[Corner, Array]) -> tuple[Array, Array]:
        return interpolated(pictures[k], placed[0]), placed[1]

    def add(_: Array, found: tuple[Array, Array], sums: tuple[Array, ...]) -> tuple[Array, ...]:
        value, inside = found
        value = (value - about) * inside
        return sums[0] + inside, sums[1] + value, sums[2] + value**2

    seen, total, squares = in_turn(place, look, add, (jnp.zeros_like(about),) * 3, 0, after.size)
    return jnp.maximum(squares - total**2 / jnp.maximum(seen, 1e-6), 0) / jnp.maximum(seen, 1)


def typical_noise(pictures: MotionFrames, motion: Motion, sigma: float | int) -> float:
    """Median variance, intensity², of the pictures along a good motion, presmoothed by `sigma` sensor pixels."""
    return float(np.median(variance_along(pictures, motion, sigma))) + 1e-5


def counts_agree(pictures: MotionFrames, motion: Motion, settings: MotionSettings = DEFAULTS) -> bool:
    """Whether the counts of spikes vary less along a motion of the whole scene than at rest, and more hardly anywhere;
    true where they are unknown.

    A test for pixels that fire seldom. Their pictures, whose intervals reach over several moments, look as if nothing
    moved: along the true velocity of dim pans they vary more than at rest, and along half of it less, while the counts'
    variance is 0.74 to 0.82 and 0.79 to 0.84 of that at rest.
    """
    limits, by = settings.evidence, settings.comparison
    counts, after = pictures.presmoothed_counts(by.presmoothing_px), np.asarray(pictures.after)
    if counts is None:
        return True
    resting = resting_drift(np.asarray(counts), after)
    moving = drift(counts, after, np.ones_like(after), (motion.velocity, motion.acceleration))
    # Two moments leave nothing but noise, and one has no variance.
    seen = np.asarray(moving.seen) >= limits.counted_moments
    along, still = (
        np.where(seen, np.asarray(now.residual) / np.maximum(np.asarray(now.seen) - 1, 1), 0)
        for now in (moving, resting)
    )
    worse = seen & (smoothed(along - still, by.window_px) > 0)
    less = float(along.sum()) < limits.counts_variance_ratio * float(still.sum())
    return less and float(worse.sum()) <= limits.counts_worse_share * float(seen.sum())


class Prediction(NamedTuple):
    """How well a motion predicts pictures from the key frame's, for some of the pictures.

    **Fields:** for all pixels, or those of a sparse grid: `residual` (n, rows, columns), squared, in units of
    the noise variance, at most `cap`; `visible` (n, rows, columns) in [0, 1], how far the motion takes the point that a
    pixel shows to be visible in the key frame.
    """

    residual: Float[np.ndarray, "n rows columns"]
    visible: Float[np.ndarray, "n rows columns"]
    cap: float

    def part(self, rows: slice, columns: slice) -> "Prediction":
        """The prediction of these rows and columns."""
        return Prediction(self.residual[:, rows, columns], self.visible[:, rows, columns], self.cap)

    @property
    def mean(self) -> float:
        """Mean residual; points that the motion takes to be hidden count with the cap."""
        return float(np.mean(self.visible * self.residual + (1 - self.visible) * self.cap))


def predict(
    pictures: MotionFrames, motion: Motion, noise: float, *, sparse: bool = False, settings: MotionSettings = DEFAULTS
) -> Prediction:
    """The prediction of the pictures by a motion.

    **Arguments:** `noise`: variance of the pictures along a good motion (`typical_noise`). `sparse`: only a sparse grid
    of pixels is predicted.
    """
    by = settings.comparison
    every = by.sparse_step if sparse else 1
    presmoothed, after = pictures.presmoothed(by.presmoothing_px), np.asarray(pictures.after)
    near = (np.abs(after) <= max(by.key_picture_frames, float(np.abs(after).min()))).astype(np.float32)
    key_picture = drift(presmoothed, after, near, (motion.velocity, motion.acceleration)).mean
    position, visible = key_frame_positions(
        motion, after[:: by.picture_step], every=every, settings=settings.trajectory
    )
    residual, visible = _predicted(presmoothed, position, visible, key_picture, np.float32(noise), every, by)
    return Prediction(np.asarray(residual), np.asarray(visible), by.residual_cap)


@partial(jax.jit, static_argnames=("every", "settings"))
def _predicted(
    pictures: Float[Array, "m h w"],
    position: Float[Array, "n 2 rows columns"],
    visible: Float[Array, "n rows columns"],
    key_picture: Float[Array, "h w"],
    noise: Float[Array, ""],
    every: int,
    settings: ComparisonSettings,
) -> tuple[Float[Array, "n rows columns"], Float[Array, "n rows columns"]]:
    """Capped squared residual and visibility of `Prediction`."""
    height, width = key_picture.shape
    shown = pictures[:: settings.picture_step, ::every, ::every]

    def one(moment: tuple[Array, Array]) -> tuple[Array, Array]:
        picture, q = moment
        inside = (q[0] >= 0) & (q[1] >= 0) & (q[0] <= height - 1) & (q[1] <= width - 1)
        residual = (picture - bilinear(key_picture[None], q[0], q[1])[0]) ** 2 / noise
        return jnp.minimum(residual, settings.residual_cap), inside.astype(key_picture.dtype)

    residual, inside = jax.lax.map(one, (shown, position))
    return residual, visible * inside


def _score_test(
    now: Drift, after: Float[np.ndarray, " n"], settings: MotionSettings
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Score test (Rao, 1948) of each window's velocity in a motion whose `Drift` is given.

    Returns twice the gain in log-likelihood of the best velocity, its displacement from the motion over the recording
    (sensor pixels), and the least gain that a displacement of `contradiction_px` would have.
    """
    window, pixels = settings.comparison.window_px, settings.evidence.contradiction_px
    now, longest = Drift(*map(np.asarray, now)), np.abs(after).max()
    (down, right), spread, change = now.slope, now.spread[0, 0], now.change[0]
    fields = [now.residual / np.maximum(now.seen, 1)]
    fields += [spread * down * down, spread * down * right, spread * right * right, -change * down, -change * right]
    noise, a, b, d, pull, pull_right = smoothed(np.stack(fields), window)
    samples = np.float32(4 * np.pi * window**2)  # effective number of pixels in a Gaussian window
    a, b, d, pull, pull_right = (of / (noise + np.float32(1e-8)) * samples for of in (a, b, d, pull, pull_right))
    a, d = a + np.float32(1e-3), d + np.float32(1e-3)
    determinant = a * d - b * b
    down, right = (d * pull - b * pull_right) / determinant, (a * pull_right - b * pull) / determinant
    poorest = (a + d) / 2 - np.sqrt(((a - d) / 2) ** 2 + b * b)
    gain = pull * down + pull_right * right
    return gain, np.hypot(down, right) * longest, poorest * (pixels / longest) ** 2
