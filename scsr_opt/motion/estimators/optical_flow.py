"""Dense velocity by scikit-image's optical flow, coarse to fine in time.

An optical flow compares two pictures and finds displacements of a few pixels; over a recording, a scene may move by
thirty. So the short pictures are first moved to the key frame by the velocity known so far, those of the earliest and
of the latest third are averaged (sharp, because they were moved first), and the flow between the two means is only the
remainder: divided by the time between them it corrects the velocity, on the key frame's grid. Near times come first,
where nothing has moved far; the velocity found there is good enough for times twice as far. The start is one velocity
for the scene (`PhaseCorrelation`) where near times then agree better than at rest.

Where the confidence is low (no texture, hidden at one end of the recording), the velocity is filled in from better
pixels around it.
"""

import abc
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, map_coordinates, median_filter
from skimage.registration import optical_flow_ilk, optical_flow_tvl1

from scsr_opt._validation import whole
from scsr_opt.errors import InputError
from scsr_opt.motion.estimators.base import Estimator
from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.estimators.phase import PhaseCorrelation
from scsr_opt.motion.estimators.settings import FlowSettings
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.trajectory import Motion


class _PlaybackFlow(Estimator):
    """Optical flow between moved and averaged pictures, as the module's docstring explains."""

    settings: MotionSettings = eqx.field(static=True, default=DEFAULTS, kw_only=True)

    @abc.abstractmethod
    def _flow(self, first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "2 h w"]:
        """The displacement f, sensor pixels, with second(q + f(q)) = first(q)."""

    def __call__(self, pictures: MotionFrames) -> Motion:
        images, times = np.asarray(pictures.picture), np.asarray(pictures.after, np.float64)
        number, height, width = images.shape
        if number < 2:
            raise InputError(
                f"The recording gives {number} picture(s), but optical flow compares at least two: use more frames."
            )
        velocity = np.zeros((2, height, width), np.float32)
        confidence = np.zeros((height, width), np.float32)
        options, by = self.settings.flow, self.settings.comparison
        if min(height, width) < by.least_side_px:
            return Motion.of_velocity(velocity, confidence)
        images = gaussian_filter(images, options.presmoothing_px, axes=(1, 2), mode="nearest")
        uniform = PhaseCorrelation(settings=self.settings)(pictures).velocity
        before: list[int] = []
        levels = zip((*by.near_times_frames, np.inf), options.rounds, options.longest_remainder_px, strict=True)
        for reach, rounds, longest in levels:
            chosen = np.flatnonzero(np.abs(times) <= reach).tolist()
            if len(chosen) < 2:  # a key frame at one end, long stretches: the two nearest
                chosen = sorted(np.argsort(np.abs(times), kind="stable")[:2].tolist())
            if chosen == before:
                continue
            third = max(len(chosen) // 3, 1)
            early, late = chosen[:third], chosen[-third:]
            gap = times[late].mean() - times[early].mean()

            def both(velocity: np.ndarray, early: list[int] = early, late: list[int] = late) -> list[np.ndarray]:
                return [_averaged(images[part], times[part], velocity) for part in (early, late)]

            if not before and _mismatch(*both(uniform)) < _mismatch(*both(velocity)):
                velocity = uniform
            before = chosen
            for _ in range(rounds):
                remainder, confidence = self._remainder(*both(velocity), longest)
                velocity = _filled(velocity + remainder / np.float32(gap), confidence, options)
        return Motion.of_velocity(velocity, confidence)

    def _remainder(
        self, first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"], longest: float
    ) -> tuple[Float[np.ndarray, "2 h w"], Float[np.ndarray, "h w"]]:
        """Displacement between the two pictures, at most `longest` sensor pixels either way, and its confidence."""
        options = self.settings.flow
        forward, backward = (
            np.nan_to_num(self._flow(*pair)).clip(-longest, longest).astype(np.float32)
            for pair in ((first, second), (second, first))
        )
        there = np.indices(first.shape, np.float32) + forward
        back = np.stack([map_coordinates(part, there, order=1, mode="nearest") for part in backward])
        disagreement = gaussian_filter(((forward + back) ** 2).sum(0), options.disagreement_window_px)
        moved = map_coordinates(second, there, order=1, mode="nearest")
        variance = _variance((first + moved) / 2, first - moved, self.settings.comparison.window_px)
        confidence = 1 / (1 + (disagreement + variance) / options.precision_px**2)
        # The mean of forward and reversed backward flow: a failure in one of them is often none in the other.
        return (forward - back) / 2, confidence.astype(np.float32)


class ILK(_PlaybackFlow):
    """Iterative Lucas–Kanade (Le Besnerais and Champagnat, 2005; `skimage.registration.optical_flow_ilk`).

    Fast (about 0.3 s for each of a dozen flows at 250 × 400); motion boundaries are blurred by `radius`.

    Suitable where the velocity varies little within `radius`, and nothing moves further than about 10 sensor pixels
    within ten frames relative to most of the scene. Pictures smaller than 8 × 8 sensor pixels show no motion
    (confidence 0).

    **Fields:** `radius`: of the window, sensor pixels. `warps`: how often the second picture is warped. `settings`:
    thresholds.

    **Raises:** `InputError` for a radius or a number of warps below 1, and if there are fewer than two stretches.
    """

    radius: int = 7
    warps: int = 8

    def __check_init__(self):
        whole(self.radius, "radius", 1)
        whole(self.warps, "warps", 1)

    def _flow(self, first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "2 h w"]:
        return optical_flow_ilk(first, second, radius=self.radius, num_warp=self.warps, prefilter=True)


class TVL1(_PlaybackFlow):
    """TV-L1 (Zach, Pock and Bischof, 2007; `skimage.registration.optical_flow_tvl1`): keeps motion boundaries.

    Two to three times slower than `ILK`. Suitable for motion of less than about 10 sensor pixels within ten frames
    relative to most of the scene. Pictures smaller than 8 × 8 sensor pixels show no motion (confidence 0).

    **Fields:** `attachment`: weight of the match of the pictures against the smoothness of the velocity, for
    intensities of 0 to 1. `warps`: how often the second picture is warped. `settings`: thresholds.

    **Raises:** `InputError` for an attachment that is not above 0, a number of warps below 1, and if there are fewer
    than two stretches.
    """

    attachment: float | int = 15.0
    warps: int = 5

    def __check_init__(self):
        if not 0 < self.attachment < np.inf:
            raise InputError(f"attachment is {self.attachment!r}; it must be a finite number above 0.")
        whole(self.warps, "warps", 1)

    def _flow(self, first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "2 h w"]:
        attachment: Any = self.attachment  # annotated as int by scikit-image, which takes any number
        return optical_flow_tvl1(first, second, attachment=attachment, num_warp=self.warps, prefilter=True)


def _mismatch(first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> float:
    """Mean absolute difference of two pictures."""
    return float(np.abs(first - second).mean())


def _averaged(
    images: Float[np.ndarray, "n h w"], times: Float[np.ndarray, " n"], velocity: Float[np.ndarray, "2 h w"]
) -> Float[np.ndarray, "h w"]:
    """Mean of the pictures moved to the key frame, over those in which a point is in view."""
    height, width = velocity.shape[1:]
    grid = np.indices((height, width), np.float32)
    total, weight = np.zeros((height, width)), np.full((height, width), 1e-3)
    for image, time in zip(images, times, strict=True):
        there = grid + np.float32(time) * velocity
        row, column = there
        inside = (row >= 0) & (column >= 0) & (row <= height - 1) & (column <= width - 1)
        share = inside + 1e-3 / len(images)  # out of view at all moments: the border's value
        total += share * map_coordinates(image, there, order=1, mode="nearest")
        weight += share
    return (total / (weight - 1e-3)).astype(np.float32)


def _variance(
    picture: Float[np.ndarray, "h w"], difference: Float[np.ndarray, "h w"], window: float
) -> Float[np.ndarray, "h w"]:
    """Variance of the poorer component of a displacement, sensor pixels², by the texture of `picture` and the noise in
    `difference` within a Gaussian window."""
    slope = np.gradient(picture)
    a, b, d = (gaussian_filter(x * y, window) for x, y in ((slope[0], slope[0]), (slope[0], slope[1]), (slope[1],) * 2))
    poorest = (a + d) / 2 - np.sqrt(((a - d) / 2) ** 2 + b**2)
    noise = gaussian_filter(difference**2, window) + 1e-8
    return noise / (4 * np.pi * window**2 * np.maximum(poorest, 1e-10))


def _filled(
    velocity: Float[np.ndarray, "2 h w"], confidence: Float[np.ndarray, "h w"], settings: FlowSettings
) -> Float[np.ndarray, "2 h w"]:
    """Velocity without single outliers, and filled in from the neighbourhood where its confidence is low."""
    window = settings.fill_window_px
    velocity = median_filter(velocity, size=settings.median_side_px, axes=(1, 2), mode="nearest")
    weight = confidence**2 + np.float32(1e-6)
    around = gaussian_filter(velocity * weight, window, axes=(1, 2)) / gaussian_filter(weight, window)
    return (confidence * velocity + (1 - confidence) * around).astype(np.float32)
