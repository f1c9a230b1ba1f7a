"""How far in time a dense motion is to be estimated from, and used, pixel by pixel: its reach.

A velocity and an acceleration describe a motion for a while only. Pictures along it, averaged over a reach of R frames
before and after the key frame, have a squared error

    bias(R)² + V(R),

which a longer reach makes less noisy, and wrong where the motion no longer holds. Against the average of the pictures
next to the key frame, which any motion predicts, the squared difference is bias² + V(near) − V(R) in the mean, as the
near pictures are part of both. So the reach of least

    (squared difference) + 2 V(R)

has the least error; V(near) is common to all (Mallows's Cp, 1973; the choice among nested windows is that of Lepski,
1990). V(R) is measured: a quarter of the squared difference of the averages over every other picture. Neighbouring
pictures share intervals between spikes, so that it comes out too large rather than too small: where little speaks for
a shorter reach the longer one stays.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter

from scsr_opt._kernels.device import on_device
from scsr_opt.motion.estimators.dense import accelerated
from scsr_opt.motion.estimators.frames import MotionFrames, picture_along
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.trajectory import Motion


def within_reach(pictures: MotionFrames, motion: Motion, settings: MotionSettings = DEFAULTS) -> Motion:
    """`motion`, dense and fitted to all pictures, fitted again to those within its `reach` where a shorter one has less
    error; as it was, if that is hardly anywhere.

    Reaches are tried from the longest to the shortest, each fit from the one before; most scenes need one trial.
    """
    limits, after = settings.reach, np.asarray(pictures.after)
    distance = np.sort(np.abs(after))
    if distance.size < 3:
        return motion
    # The pictures next to the key frame, two at least. Those closer to each other than the spikes of a pixel show the
    # same intervals: their differences tell neither an error nor its variance.
    near = max(settings.comparison.key_picture_frames, float(distance[1]), _interval(pictures))
    reaches, motions = [float(distance[-1])], [motion]
    errors = [_error(pictures, motion, reaches[0], near, settings)]
    while (reach := reaches[-1] / limits.step) >= limits.least_near * near:
        motion = accelerated(
            pictures, motion, start=motion, turns=limits.turns, reach=reach, settings=settings
        )  # fmt: skip
        error = _error(pictures, motion, reach, near, settings)
        if np.mean(error < np.min(errors, axis=0)) < limits.least_share:
            break
        reaches, motions, errors = [*reaches, reach], [*motions, motion], [*errors, error]
    if len(motions) == 1:
        return motions[0]
    best = np.argmin(errors, axis=0)
    # Fields of neighbouring reaches differ little; where one follows another they are blended, so that none has edges.
    shares = [gaussian_filter((best == k).astype(np.float32), limits.blend_px) for k in range(len(motions))]
    velocity, acceleration, confidence = (
        sum((share * of for share, of in zip(shares, fields, strict=True)), np.float32(0))
        for fields in zip(*((m.velocity, m.acceleration, m.confidence) for m in motions), strict=True)
    )
    used = sum((share * np.float32(reach) for share, reach in zip(shares, reaches, strict=True)), np.float32(0))
    # A reach is known to within a step.
    used = np.asarray(used) * np.float32(limits.step)
    return Motion(np.asarray(velocity), np.asarray(acceleration), np.asarray(confidence), reach=used)


def _interval(pictures: MotionFrames) -> float:
    """Frames from one spike of a pixel to the next, of the median pixel; 0 where that is not known."""
    firing = None if pictures.firing is None else float(np.median(np.asarray(pictures.firing)))
    return 0.0 if firing is None else 1 / max(firing, 1e-6)


def _error(
    pictures: MotionFrames, motion: Motion, reach: float, near: float, settings: MotionSettings
) -> Float[np.ndarray, "h w"]:
    """Squared error, intensity², of the average of the pictures along a motion within `reach` frames, less what is the
    same for any reach; pictures within `near` frames are those that it is compared with."""
    presmoothed, after = (
        np.asarray(pictures.presmoothed(settings.comparison.presmoothing_px)),
        np.asarray(pictures.after),
    )
    fields = on_device(motion.velocity), on_device(motion.acceleration)
    # Sums of weights and values: of every other picture, of the rest, and of those next to the key frame.
    weight, total = np.zeros((2, 3, *motion.speed.shape), np.float32)
    for number, k in enumerate(np.flatnonzero(np.abs(after) <= reach)):
        value, inside = map(np.asarray, picture_along(presmoothed[k], after[k], *fields))
        for which in (number % 2, 2) if abs(after[k]) <= near else (number % 2,):
            weight[which] += inside
            total[which] += inside * value
    both = weight[0] + weight[1]
    known = (weight > 0).all(0)
    every, rest, close = total / np.maximum(weight, 1)
    difference = (total[0] + total[1]) / np.maximum(both, 1) - close
    chance = (every - rest) ** 2 * weight[0] * weight[1] / np.maximum(both, 1) ** 2
    found = np.where(known, difference**2 + 2 * chance, 0)
    around = gaussian_filter(known.astype(np.float32), settings.reach.window_px)
    return gaussian_filter(found, settings.reach.window_px) / np.maximum(around, np.float32(1e-6))
