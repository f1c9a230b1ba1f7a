"""Trust in a motion, moment by moment: where the pictures along it stop agreeing, samples have less weight.

No estimate of the motion is right everywhere. Things turn, speed up, pass behind one another, and the farther from the
key frame, the worse a velocity predicts where they are. Wrong samples blur; missing ones only leave some noise. So
samples of a moment are weighted by inverse variance: noise of variance N and a squared error E of the motion make a
sample as good as one of variance N + E.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from scsr_opt.motion.estimators.evidence import contradicts_rest
from scsr_opt.motion.estimators.frames import MotionFrames, along, smooth
from scsr_opt.motion.inversion import interpolated
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.stacks import folded
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
    presmoothed = pictures.presmoothed(settings.comparison.presmoothing_px)
    fields = motion.velocity, motion.acceleration
    share = _worth(presmoothed, pictures.after, *fields, np.int32(lag), settings)
    trust = Trust(after, np.asarray(share))
    return Motion(motion.velocity, motion.acceleration, motion.confidence, motion.layers, trust)


@partial(jax.jit, static_argnames="settings")
def _worth(
    pictures: Float[Array, "n h w"],
    moments: Float[Array, " n"],
    velocity: Float[Array, "2 h w"],
    acceleration: Float[Array, "2 h w"],
    lag: Int[Array, ""],
    settings: MotionSettings,
) -> Float[Array, "n h w"]:
    """N / (N + E) of each moment and pixel; `lag`: difference in number from which on pictures share no interval."""
    limits, by = settings.reliability, settings.comparison

    # Picture by picture, so that each is still in the cache when it is used.
    def moved(one: tuple[Array, Array]) -> tuple[Array, Array]:
        corner, inside = along(one[1], velocity, acceleration)
        return interpolated(one[0], corner), inside

    values, inside = jax.lax.map(moved, (pictures, moments))
    near = jnp.exp(-0.5 * (moments / limits.key_picture_frames) ** 2)[:, None, None] * inside
    # The nearest moment always takes part, however far it is.
    near = near + 1e-6 * (jnp.abs(moments) == jnp.min(jnp.abs(moments))).astype(jnp.float32)[:, None, None]
    nothing = jnp.zeros_like(values[0])

    def average(k: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        return sums[0] + near[k] * values[k], sums[1] + near[k]

    total, weight = jax.lax.fori_loop(0, values.shape[0], average, (nothing, nothing))
    present = total / weight

    # The noise, from pictures a spike interval apart: a geometric mean, which a few moments that disagree for another
    # reason hardly change. The mean logarithm of a χ² of one degree of freedom is −γ − log 2.
    def compare(k: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        both = inside[k] * inside[k + lag]
        change = (values[k + lag] - values[k]) ** 2 / 2
        return sums[0] + both * jnp.log(change + 1e-8), sums[1] + both

    logarithms, compared = jax.lax.fori_loop(0, values.shape[0] - lag, compare, (nothing, nothing))
    geometric = float(np.exp(-np.euler_gamma) / 2)
    window = jnp.asarray(by.window_px)
    noise = smooth(jnp.exp(logarithms / jnp.maximum(compared, 1)) / geometric, window) + 1e-6
    # A sample has the noise of one pixel, which presmoothing has averaged over several.
    noise_of_one = noise * (4 * np.pi * by.presmoothing_px**2)
    neighbourhood = jnp.asarray(by.neighbourhood_px)

    def worth(one: tuple[Array, Array]) -> Array:
        value, inside = one
        square = smooth((value - present) ** 2 * inside, neighbourhood)
        square = square / jnp.maximum(smooth(inside, neighbourhood), 0.1)
        error = jnp.maximum(square - limits.chance_ratio * noise, 0)
        return 1 / (1 + limits.error_weight * error / noise_of_one)

    share = jax.lax.map(worth, (values, inside))
    still = (velocity[0] == 0) & (velocity[1] == 0) & (acceleration[0] == 0) & (acceleration[1] == 0)
    steady = still & (folded(jnp.minimum, share) >= limits.steady_worth)
    return jnp.where(steady[None], folded(jnp.add, share)[None] / len(share), share)
