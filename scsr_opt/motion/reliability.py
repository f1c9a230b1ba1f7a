"""Trust in a motion, moment by moment: where the pictures along it stop agreeing, samples have less weight.

No estimate of the motion is right everywhere. Things turn, speed up, pass behind one another, and the farther from the
key frame, the worse a velocity predicts where they are. Wrong samples blur; missing ones only leave some noise. So
samples of a moment are weighted by inverse variance: noise of variance N and a squared error E of the motion make a
sample as good as one of variance N + E.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from scsr_opt._kernels.device import on_device
from scsr_opt.motion.estimators.evidence import contradicts_rest
from scsr_opt.motion.estimators.frames import MotionFrames, picture_along, smoothed
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.trajectory import Motion, Trust


def with_trust(pictures: MotionFrames, motion: Motion, settings: MotionSettings = DEFAULTS) -> Motion:
    """`motion` with its `trust` measured on the recording's pictures; without it for fewer than three pictures, and for
    a scene at rest that the recording does not contradict."""
    after = np.asarray(pictures.after)
    if after.size < 3 or not (motion.moves or contradicts_rest(pictures, settings)):
        return motion
    # Pictures nearer to each other than a pixel's interval between spikes share their light and their error.
    interval = 1 / max(float(np.median(np.asarray(pictures.firing))), 1e-3) if pictures.firing is not None else 1.0
    lag = int(np.clip(np.ceil(interval / (after[1] - after[0])), 1, after.size // 2))
    presmoothed = np.asarray(pictures.presmoothed(settings.comparison.presmoothing_px))
    share = _worth(presmoothed, after, motion, lag, settings)
    if motion.reach is not None:
        # The weight falls from one reach that was tried to the next: to within as much it is known. What rests is used
        # throughout.
        share_left = 1 - np.abs(after)[:, None, None] / np.maximum(motion.reach, np.float32(1e-6))
        within = np.clip(share_left / (1 - 1 / settings.reach.step), 0, 1).astype(np.float32)
        share = np.where(_rests(motion), share, share * within)
    return replace(motion, trust=Trust(after, share))


def _worth(
    pictures: Float[np.ndarray, "n h w"],
    moments: Float[np.ndarray, " n"],
    motion: Motion,
    lag: int,
    settings: MotionSettings,
) -> Float[np.ndarray, "n h w"]:
    """N / (N + E) of each moment and pixel; `lag`: difference in number from which on pictures share no interval.

    Picture by picture, so that each is still in the cache when it is used.
    """
    limits, by = settings.reliability, settings.comparison
    velocity, acceleration = on_device(motion.velocity), on_device(motion.acceleration)
    shown = [
        picture_along(picture, tau, velocity, acceleration) for picture, tau in zip(pictures, moments, strict=True)
    ]
    values, inside = (np.stack(of) for of in zip(*shown, strict=True))
    near = np.exp(-0.5 * (moments / limits.key_picture_frames) ** 2)
    # The nearest moment always takes part, however far it is.
    alone = np.float32(1e-6) * (np.abs(moments) == np.abs(moments).min())
    total, weight = (np.zeros_like(values[0]) for _ in range(2))
    for value, seen, share, least in zip(values, inside, near, alone, strict=True):
        part = share * seen + least
        total += part * value
        weight += part
    present = total / weight

    # The noise, from pictures a spike interval apart: a geometric mean, which a few moments that disagree for another
    # reason hardly change. The mean logarithm of a χ² of one degree of freedom is −γ − log 2.
    logarithms, compared = (np.zeros_like(present) for _ in range(2))
    for k in range(len(values) - lag):
        both = inside[k] * inside[k + lag]
        logarithms += both * np.log((values[k + lag] - values[k]) ** 2 / 2 + np.float32(1e-8))
        compared += both
    geometric = np.float32(np.exp(-np.euler_gamma) / 2)
    noise = np.exp(logarithms / np.maximum(compared, 1)) / geometric
    noise = smoothed(noise, by.window_px) + np.float32(1e-6)
    # A sample has the noise of one pixel, which presmoothing has averaged over several.
    noise_of_one = noise * np.float32(4 * np.pi * by.presmoothing_px**2)
    squares = smoothed((values - present) ** 2 * inside, by.neighbourhood_px)
    squares /= np.maximum(smoothed(inside, by.neighbourhood_px), np.float32(0.1))
    error = np.maximum(squares - np.float32(limits.chance_ratio) * noise, 0)
    share = 1 / (1 + np.float32(limits.error_weight) * error / noise_of_one)
    steady = _rests(motion) & (share.min(0) >= limits.steady_worth)
    return np.where(steady, share.mean(0), share)


def _rests(motion: Motion) -> Bool[np.ndarray, "h w"]:
    """Pixels whose velocity and acceleration are zero."""
    return np.asarray(~(motion.velocity.any(0) | motion.acceleration.any(0)))
