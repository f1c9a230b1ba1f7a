"""Test of a motion against the recording: which pixels contradict it, and how well it predicts the pictures."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scsr_opt._kernels.device import on_device
from scsr_opt.motion.estimators.frames import Drift, MotionFrames, drift_of, picture_along, smoothed
from scsr_opt.motion.inversion import read_picture
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.trajectory import Motion, key_frame_positions


def contradicted(
    pictures: MotionFrames, motion: Motion, settings: MotionSettings = DEFAULTS
) -> Bool[np.ndarray, "h w"]:
    """Contradiction test: pixels that are observable under `motion`, and whose window another velocity explains clearly
    better and at a clear distance (`EvidenceSettings`)."""
    limits, by = settings.evidence, settings.comparison
    after = np.asarray(pictures.after)
    now = drift_of(pictures.presmoothed(by.presmoothing_px), after, (motion.velocity, motion.acceleration))
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
    presmoothed, after = np.asarray(pictures.presmoothed(sigma)), np.asarray(pictures.after)
    about = presmoothed[np.argmin(np.abs(after)), ::every, ::every]
    seen, total, squares = (np.zeros_like(about) for _ in range(3))
    fields = on_device(motion.velocity), on_device(motion.acceleration)
    for picture, tau in zip(presmoothed, after, strict=True):
        value, inside = map(np.asarray, picture_along(picture, tau, *fields, every=every))
        value = (value - about) * inside
        seen += inside
        total += value
        squares += value**2
    return np.maximum(squares - total**2 / np.maximum(seen, np.float32(1e-6)), 0) / np.maximum(seen, 1)


def light_explains(
    with_light: tuple[MotionFrames, Motion], without: tuple[MotionFrames, Motion], settings: MotionSettings = DEFAULTS
) -> bool:
    """Whether light that was found explains the recording: pictures that are corrected for it have to agree along the
    motion that is found in them about as well as the others do along theirs. A light that is not there was made of
    motion, and takes it away."""
    sigma = settings.comparison.presmoothing_px

    def variance(frames: MotionFrames, motion: Motion) -> float:
        """Relative to the square of the mean."""
        level = float(np.mean(np.asarray(frames.picture)))
        return float(variance_along(frames, motion, sigma).mean()) / max(level, 1e-6) ** 2

    return variance(*with_light) <= settings.light.most_variance_ratio * variance(*without)


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
    moving, resting = (drift_of(counts, after, of) for of in ((motion.velocity, motion.acceleration), None))
    # Two moments leave nothing but noise, and one has no variance.
    seen = moving.seen >= limits.counted_moments
    along, still = (np.where(seen, now.residual / np.maximum(now.seen - 1, 1), 0) for now in (moving, resting))
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
    presmoothed, after = np.asarray(pictures.presmoothed(by.presmoothing_px)), np.asarray(pictures.after)
    near = np.abs(after) <= max(by.key_picture_frames, float(np.abs(after).min()))
    key_picture = drift_of(presmoothed, after, (motion.velocity, motion.acceleration), near).mean
    position, visible = key_frame_positions(
        motion, after[:: by.picture_step], every=every, settings=settings.trajectory
    )
    shown, height, width = presmoothed[:: by.picture_step, ::every, ::every], *key_picture.shape
    residual, visible = np.empty(shown.shape, np.float32), np.array(visible)
    for k, (row, column) in enumerate(np.asarray(position)):
        difference = shown[k] - np.asarray(read_picture(key_picture, row, column))
        residual[k] = np.minimum(difference**2 / np.float32(noise), np.float32(by.residual_cap))
        visible[k] *= (row >= 0) & (column >= 0) & (row <= height - 1) & (column <= width - 1)
    return Prediction(residual, visible, by.residual_cap)


def _score_test(
    now: Drift, after: Float[np.ndarray, " n"], settings: MotionSettings
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Score test (Rao, 1948) of each window's velocity in a motion whose `Drift` is given.

    Returns twice the gain in log-likelihood of the best velocity, its displacement from the motion over the recording
    (sensor pixels), and the least gain that a displacement of `contradiction_px` would have.
    """
    window, pixels = settings.comparison.window_px, settings.evidence.contradiction_px
    longest = np.abs(after).max()
    (down, right), spread, change = now.slope, now.spread[0, 0], now.change[0]
    fields = [now.residual / np.maximum(now.seen, 1)]
    fields += [spread * down * down, spread * down * right, spread * right * right, -change * down, -change * right]
    noise, a, b, d, pull, pull_right = smoothed(np.stack(fields), window)
    samples = np.float32(4 * np.pi * window**2)  # effective number of pixels in a Gaussian window
    a, b, d, pull, pull_right = (of / (noise + np.float32(1e-8)) * samples for of in (a, b, d, pull, pull_right))
    least = np.float32(1e-3)
    a, d = a + least, d + least
    # Without rounding it is no less, as a·d ≥ b² before `least` was added.
    determinant = np.maximum(a * d - b * b, least * (a + d - least))
    down, right = (d * pull - b * pull_right) / determinant, (a * pull_right - b * pull) / determinant
    poorest = (a + d) / 2 - np.sqrt(((a - d) / 2) ** 2 + b * b)
    gain = pull * down + pull_right * right
    return gain, np.hypot(down, right) * longest, poorest * (pixels / longest) ** 2
