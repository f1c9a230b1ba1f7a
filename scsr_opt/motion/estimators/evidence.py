"""Does the recording contradict a motion? A test on statistics, for each pixel's surroundings."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from scsr_opt.motion.estimators.frames import Drift, MotionFrames, along, drift, smooth
from scsr_opt.motion.inversion import Corner, bilinear, in_turn, interpolated
from scsr_opt.motion.trajectory import Motion, seen_at

# A pixel contradicts a motion if another velocity in its window would explain the recording better by this much
# (likelihood ratio; χ² with 2 degrees of freedom if the noise were white, so that 100 would never be met by chance: on
# recordings of still scenes the largest value seen was 80, the median 3.5), and would take it more than half a pixel
# elsewhere.
_CONTRADICTION = 100.0
_DRIFT = 0.5
_WINDOW = 3.0
TOLERATED_AT_REST = 0.001
"""The share of the pixels that may contradict that nothing moves without it being doubted."""
# Between two spikes a pixel tells nothing of when its light came: what passes it within an interval looks as if it
# stood still. Where a motion goes further between spikes than a pixel's diagonal (sensor pixels), the pixel is not
# heard against it. Of `skimage.data.camera` at 0.3 px per frame a tenth contradicted the true velocity by day without
# this; with 2 pixels up to 4 % of dim stills at 0.14, with 1 a car that passes in dim light went unnoticed.
_SMEAR = 1.4
# Spikes within the pictures that it takes for a pixel to be certainly at rest. With fewer, most pictures show the same
# interval, and agree whatever moves: of pans over 10 to 40 frames, or in dim light, up to four fifths seemed to rest.
# With two it is 0.05 at most, and of scenes that do rest in part, in dim light, half or more of it is left.
_SPIKES = 2.0


def contradicted(pictures: MotionFrames, motion: Motion) -> Bool[np.ndarray, "h w"]:
    """Where the recording contradicts `motion`, see above."""
    evidence, drifted, _ = map(np.asarray, _evidence(pictures, motion))
    return (evidence > _CONTRADICTION) & (drifted > _DRIFT) & heard(pictures, motion)


def heard(pictures: MotionFrames, motion: Motion) -> Bool[np.ndarray, "h w"]:
    """Where pixels fire often enough to contradict this motion, see above."""
    firing = _firing_around(pictures)
    return np.ones(motion.speed.shape, bool) if firing is None else motion.speed <= _SMEAR * firing


def _firing_around(pictures: MotionFrames) -> Float[np.ndarray, "h w"] | None:
    """Spikes per frame in each pixel's window, if known."""
    firing = pictures.firing
    if firing is None:
        return None
    return pictures.once("firing around", lambda: np.asarray(smooth(firing, jnp.asarray(_WINDOW))))


def at_rest(pictures: MotionFrames) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Where the recording contradicts that nothing moves, as `contradicted` says, and where it is certain that nothing
    does: any motion by half a pixel over the recording would contradict rest, and there are spikes to show it."""

    def found() -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
        evidence, drifted, least = map(np.asarray, _evidence(pictures, None))
        moving = (evidence > _CONTRADICTION) & (drifted > _DRIFT)
        certain = (evidence <= _CONTRADICTION) & (drifted <= _DRIFT) & (least > _CONTRADICTION)
        firing = _firing_around(pictures)
        if firing is not None:
            certain &= firing * np.ptp(np.asarray(pictures.after)) >= _SPIKES
        return moving, certain

    return pictures.once("at rest", found)


def variance_along(
    pictures: MotionFrames, motion: Motion, sharpness: float | int = 1.0, *, every: int = 1
) -> Float[np.ndarray, "rows columns"]:
    """Variance of the pictures along a motion, presmoothed by `sharpness` sensor pixels; with `every`, of one row and
    column in so many."""
    smoothed = pictures.presmoothed(sharpness)
    return np.asarray(_variance(smoothed.picture, smoothed.after, motion.velocity, motion.acceleration, every))


@partial(jax.jit, static_argnames="every")
def _variance(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    velocity: Float[Array, "2 h w"],
    acceleration: Float[Array, "2 h w"],
    every: int,
) -> Float[Array, "rows columns"]:
    """`Drift.residual` over `Drift.seen`, in two thirds of the time."""
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


def typical_noise(pictures: MotionFrames, motion: Motion, sharpness: float | int = 1.0) -> float:
    """Typical variance of a picture along a good motion."""
    return float(np.median(variance_along(pictures, motion, sharpness))) + 1e-5


# Moments at which a point has to be in view for its counts to be compared, how much less they have to differ in all,
# and in what share of the places they may differ more: up to 0.018 on pans, 0.054 of a dim clip in which a car does not
# move with the rest.
_MOMENTS, _LESS, _MORE = 3, 0.98, 0.02


def counts_agree(pictures: MotionFrames, motion: Motion) -> bool:
    """Do the numbers of spikes along a motion of the whole scene differ less than those at rest, and more hardly
    anywhere?

    This is asked where pixels fire so seldom that the pictures, whose intervals reach over several moments, look as if
    nothing moved: along the true velocity of dim pans they then differ more than at rest, and along half of it less,
    while the counts' variance is 0.74 to 0.82 and 0.79 to 0.84 of that at rest (0.88 to 0.97 on clips).
    """
    counted = pictures.counted
    if counted is None:
        return True
    counts = pictures.once("counts", lambda: MotionFrames(counted(), pictures.after).presmoothed(1.0))
    fields = jnp.asarray(motion.velocity), jnp.asarray(motion.acceleration)
    moving, resting = (drift(counts.picture, counts.after, jnp.ones_like(counts.after), m) for m in (fields, None))
    # Of two moments nothing is left but noise; what is seen once agrees with itself.
    seen = moving.seen >= _MOMENTS
    along, still = (jnp.where(seen, now.residual / jnp.maximum(now.seen - 1, 1), 0) for now in (moving, resting))
    worse = seen & (smooth(along - still, jnp.asarray(_WINDOW)) > 0)
    return float(along.sum()) < _LESS * float(still.sum()) and float(worse.sum()) <= _MORE * float(seen.sum())


# Moments within so many frames make the picture that a motion carries to the others.
_NEAR = 10.0
# A squared error counts up to so many times the noise: what is hidden without anybody knowing says little more.
_MISSED = 6.0
# One picture in so many is predicted, and where work is to be skipped one row and column in so many of it: enough to
# compare motions.
_EVERY, _SPARSE = 3, 2


class Missed(NamedTuple):
    """How well a motion predicts pictures from those near the key frame, for every third picture.

    **Fields:** of every pixel or of one row and column in so many, `error` (n, rows, columns), squared, in units of the
    noise, cut off; `seen` (n, rows, columns), how far the motion says that what a pixel shows is visible in the key
    frame.
    """

    error: Float[np.ndarray, "n rows columns"]
    seen: Float[np.ndarray, "n rows columns"]

    def part(self, rows: slice, columns: slice) -> "Missed":
        """On some rows and columns."""
        return Missed(self.error[:, rows, columns], self.seen[:, rows, columns])

    @property
    def mean(self) -> float:
        """How badly the motion predicts the pictures; what it says is hidden counts as missed."""
        return float(np.mean(self.seen * self.error + (1 - self.seen) * _MISSED))


def missed(pictures: MotionFrames, motion: Motion, noise: float, *, sparse: bool = False) -> Missed:
    """What a motion misses of the pictures, at every pixel or a sparse grid of them; `noise`: their typical variance
    along a good motion."""
    every = _SPARSE if sparse else 1
    smoothed = pictures.presmoothed(1.0)
    after = np.asarray(smoothed.after)
    near = (np.abs(after) <= max(_NEAR, float(np.abs(after).min()))).astype(np.float32)
    present = drift(smoothed.picture, after, near, (motion.velocity, motion.acceleration)).mean
    position, visible = seen_at(motion, after[::_EVERY], every=every)
    error, visible = _missed(smoothed.picture, position, visible, present, np.float32(noise), every)
    return Missed(np.asarray(error), np.asarray(visible))


@partial(jax.jit, static_argnames="every")
def _missed(
    pictures: Float[Array, "m h w"],
    position: Float[Array, "n 2 rows columns"],
    visible: Float[Array, "n rows columns"],
    present: Float[Array, "h w"],
    noise: Float[Array, ""],
    every: int,
) -> tuple[Float[Array, "n rows columns"], Float[Array, "n rows columns"]]:
    height, width = present.shape
    shown = pictures[::_EVERY, ::every, ::every]

    def one(moment: tuple[Array, Array]) -> tuple[Array, Array]:
        picture, q = moment
        inside = (q[0] >= 0) & (q[1] >= 0) & (q[0] <= height - 1) & (q[1] <= width - 1)
        error = (picture - bilinear(present[None], q[0], q[1])[0]) ** 2 / noise
        return jnp.minimum(error, _MISSED), inside.astype(present.dtype)

    error, inside = jax.lax.map(one, (shown, position))
    return error, visible * inside


def _evidence(
    pictures: MotionFrames, motion: Motion | None
) -> tuple[Float[Array, "h w"], Float[Array, "h w"], Float[Array, "h w"]]:
    """Score test of each window's velocity, or of rest: twice the gain in log-likelihood of the best one, how far that
    goes, and what the gain would be, at least, if the best one went half a pixel elsewhere."""
    smoothed = pictures.presmoothed(1.0)
    after = np.asarray(smoothed.after)
    along = None if motion is None else (motion.velocity, motion.acceleration)
    now = drift(smoothed.picture, after, np.ones_like(after), along)
    return _score(now, np.abs(after).max(), np.float32(_WINDOW))


@jax.jit
def _score(
    now: Drift, longest: Float[Array, ""], window: Float[Array, ""]
) -> tuple[Float[Array, "h w"], Float[Array, "h w"], Float[Array, "h w"]]:
    noise = smooth(now.residual / jnp.maximum(now.seen, 1), window) + 1e-8
    samples = 4 * np.pi * window**2  # effective number of pixels in a Gaussian window
    information = (
        smooth(now.spread[:1, :1] * now.slope[:, None] * now.slope[None], window) / noise[None, None] * samples
    )
    pull = -smooth(now.change[:1] * now.slope, window) / noise[None] * samples
    a, b, d = information[0, 0] + 1e-3, information[0, 1], information[1, 1] + 1e-3
    down, right = (d * pull[0] - b * pull[1]) / (a * d - b * b), (a * pull[1] - b * pull[0]) / (a * d - b * b)
    poorest = (a + d) / 2 - jnp.sqrt(((a - d) / 2) ** 2 + b * b)
    gain = pull[0] * down + pull[1] * right
    return gain, jnp.sqrt(down**2 + right**2) * longest, poorest * (_DRIFT / longest) ** 2
