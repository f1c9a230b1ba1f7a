"""Dense velocity by scikit-image's optical flow, coarse to fine in time.

An optical flow compares two pictures and finds displacements of a few pixels; a recording has many moments, over which
thirty pixels may lie. So the stretches are first moved to the key frame by the velocity known so far, those of the
earliest and of the latest third are averaged (sharp, because they are moved first), and the flow between the two
pictures is the remainder only: divided by the time between them it corrects the velocity, on the key frame's grid. Near
times come first, where nothing has moved far; the velocity found there is good enough to look at times twice as far.
The start is one velocity for all (`PhaseCorrelation`) where that makes near times agree better than standing still
does.

What is not seen (no texture, hidden at one end of the recording) does not decide: where the confidence is low, the
velocity is filled in from better pixels around it.
"""

import abc
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, map_coordinates, median_filter
from skimage.registration import optical_flow_ilk, optical_flow_tvl1

from scsr_opt.errors import InputError
from scsr_opt.motion.estimators.base import Estimator
from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.estimators.phase import PhaseCorrelation
from scsr_opt.motion.trajectory import Motion

# (frames from the key frame within which stretches take part, rounds, longest remainder in sensor pixels): once near
# times agree, a long remainder is a failure of the flow, not motion.
_LEVELS = ((8, 2, 10.0), (16, 1, 2.5), (32, 1, 2.5), (np.inf, 2, 2.5))
# Gaussian window over which texture and noise are compared, sensor pixels.
_WINDOW = 3.0
# Displacements are wanted to this (standard deviation and forward–backward difference at which the confidence is ½).
_WANTED = 0.25
# Sensor pixels: in a smaller picture there is no room for a window.
_SMALLEST = 8


class _PlaybackFlow(Estimator):
    """Optical flow between moved and averaged pictures, see the module's description."""

    @abc.abstractmethod
    def _flow(self, first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "2 h w"]:
        """f with second(q + f(q)) = first(q), sensor pixels."""

    def __call__(self, pictures: MotionFrames) -> Motion:
        images, times = np.asarray(pictures.picture), np.asarray(pictures.after, np.float64)
        number, height, width = images.shape
        if number < 2:
            raise InputError(
                f"The recording gives {number} picture(s), but optical flow compares at least two: use more frames."
            )
        velocity = np.zeros((2, height, width), np.float32)
        confidence = np.zeros((height, width), np.float32)
        if min(height, width) < _SMALLEST:
            return Motion.of_velocity(velocity, confidence)
        images = gaussian_filter(images, 0.7, axes=(1, 2), mode="nearest")
        together = PhaseCorrelation()(pictures).velocity
        before: list[int] = []
        for reach, rounds, longest in _LEVELS:
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

            if not before and _mismatch(*both(together)) < _mismatch(*both(velocity)):
                velocity = together
            before = chosen
            for _ in range(rounds):
                remainder, confidence = self._remainder(*both(velocity), longest)
                velocity = _filled(velocity + remainder / np.float32(gap), confidence)
        return Motion.of_velocity(velocity, confidence)

    def _remainder(
        self, first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"], longest: float
    ) -> tuple[Float[np.ndarray, "2 h w"], Float[np.ndarray, "h w"]]:
        """What the flow finds between the two pictures, and how far it can be trusted."""
        forward, backward = (
            np.nan_to_num(self._flow(*pair)).clip(-longest, longest).astype(np.float32)
            for pair in ((first, second), (second, first))
        )
        there = np.indices(first.shape, np.float32) + forward
        back = np.stack([map_coordinates(part, there, order=1, mode="nearest") for part in backward])
        disagreement = gaussian_filter(((forward + back) ** 2).sum(0), 1.0)
        moved = map_coordinates(second, there, order=1, mode="nearest")
        variance = _variance((first + moved) / 2, first - moved)
        confidence = 1 / (1 + (disagreement + variance) / _WANTED**2)
        # Half of the difference: a failure in one direction is often none in the other.
        return (forward - back) / 2, confidence.astype(np.float32)


class ILK(_PlaybackFlow):
    """Iterative Lucas–Kanade (Le Besnerais and Champagnat, 2005; `skimage.registration.optical_flow_ilk`).

    Fast (about 0.3 s for each of a dozen flows at 250 × 400); motion boundaries are blurred by `radius`.

    Holds as long as the velocity varies little within `radius`, and nothing moves further than about 10 sensor pixels
    within ten frames relative to the most of the scene. Pictures smaller than 8 × 8 sensor pixels show no motion
    (confidence 0).

    **Fields:** `radius`: of the window, sensor pixels. `warps`: how often the second picture is warped.

    **Raises:** `InputError` for a radius or a number of warps below 1, and if there are fewer than two stretches.
    """

    radius: int = 7
    warps: int = 8

    def __check_init__(self):
        _at_least_one("radius", self.radius)
        _at_least_one("warps", self.warps)

    def _flow(self, first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "2 h w"]:
        return optical_flow_ilk(first, second, radius=self.radius, num_warp=self.warps, prefilter=True)


class TVL1(_PlaybackFlow):
    """TV-L1 (Zach, Pock and Bischof, 2007; `skimage.registration.optical_flow_tvl1`): keeps motion boundaries.

    Two to three times slower than `ILK`. Holds for motion of less than about 10 sensor pixels within ten frames
    relative to the most of the scene. Pictures smaller than 8 × 8 sensor pixels show no motion (confidence 0).

    **Fields:** `attachment`: how closely the pictures are matched, against how smooth the velocity is; for intensities
    of 0 to 1. `warps`: how often the second picture is warped.

    **Raises:** `InputError` for an attachment that is not above 0, a number of warps below 1, and if there are fewer
    than two stretches.
    """

    attachment: float | int = 15.0
    warps: int = 5

    def __check_init__(self):
        if not 0 < self.attachment < np.inf:
            raise InputError(f"attachment is {self.attachment!r}; it must be a finite number above 0.")
        _at_least_one("warps", self.warps)

    def _flow(self, first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "2 h w"]:
        attachment: Any = self.attachment  # annotated as whole, but any number will do
        return optical_flow_tvl1(first, second, attachment=attachment, num_warp=self.warps, prefilter=True)


def _at_least_one(name: str, value: Any) -> None:
    if value < 1:
        raise InputError(f"{name} is {value!r}; it must be a whole number of at least 1.")


def _mismatch(first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> float:
    return float(np.abs(first - second).mean())


def _averaged(
    images: Float[np.ndarray, "n h w"], times: Float[np.ndarray, " n"], velocity: Float[np.ndarray, "2 h w"]
) -> Float[np.ndarray, "h w"]:
    """The mean of the pictures, each moved to the key frame; where one of them ends, the others go on."""
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


def _variance(picture: Float[np.ndarray, "h w"], difference: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Variance of the displacement (its poorer component) that a window of the pictures leaves, sensor pixels²."""
    slope = np.gradient(picture)
    a, b, d = (
        gaussian_filter(x * y, _WINDOW) for x, y in ((slope[0], slope[0]), (slope[0], slope[1]), (slope[1],) * 2)
    )
    poorest = (a + d) / 2 - np.sqrt(((a - d) / 2) ** 2 + b**2)
    noise = gaussian_filter(difference**2, _WINDOW) + 1e-8
    return noise / (4 * np.pi * _WINDOW**2 * np.maximum(poorest, 1e-10))


def _filled(velocity: Float[np.ndarray, "2 h w"], confidence: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "2 h w"]:
    """Single wrong pixels taken out, and those without support filled in from their neighbourhood."""
    velocity = median_filter(velocity, size=5, axes=(1, 2), mode="nearest")
    weight = confidence**2 + np.float32(1e-6)
    around = gaussian_filter(velocity * weight, 5.0, axes=(1, 2)) / gaussian_filter(weight, 5.0)
    return (confidence * velocity + (1 - confidence) * around).astype(np.float32)
