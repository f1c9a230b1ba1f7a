"""A velocity for each pixel, from all moments of the recording at once."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import median_filter

from scsr_opt.motion.alignment import Stretches, drift, smooth
from scsr_opt.motion.trajectory import Motion

# (frames from the key frame, presmoothing, window, steps), sensor pixels: near times and wide windows first.
_SCHEDULE = ((8, 2.0, 6.0, 8), (16, 1.5, 4.0, 6), (32, 1.0, 3.0, 6), (np.inf, 0.8, 2.5, 6))

# Side of the square of pixels that vote on a velocity after each part of the schedule.
_VOTERS = 5


def dense(pictures: Stretches, *, start: Motion | None = None) -> Motion:
    """Least squares in a Gaussian window around each pixel (Lucas and Kanade, 1981), over all moments at once.

    Where a window has no texture its velocity stays near `start` (nothing moves, if not given).
    """
    height, width = pictures.picture.shape[1:]
    if start is None:
        start = Motion.none(height, width)
    velocity = base = jnp.asarray(start.velocity)
    acceleration = jnp.asarray(start.acceleration)
    confidence = jnp.ones((height, width), jnp.float32)
    for reach, sigma, window, steps in _SCHEDULE:
        part = (jnp.abs(pictures.after) <= reach).astype(jnp.float32)
        velocity, confidence = _refine(
            pictures.presmoothed(sigma).picture,
            pictures.after,
            part,
            velocity,
            acceleration,
            base,
            # A step of more pixels than this at the farthest moment is beyond what the linearisation knows.
            jnp.asarray(sigma + 0.5),
            jnp.asarray(window),
            jnp.asarray(steps),
        )
        # Single windows that went astray are outvoted by their neighbours; an edge between two motions stays.
        velocity = jnp.asarray(median_filter(np.asarray(velocity), (1, _VOTERS, _VOTERS), mode="nearest"))
        # What has left the picture halfway through the recording cannot have been followed.
        limit = 0.5 * max(height, width) / float(jnp.max(jnp.abs(pictures.after)) + 1)
        velocity = jnp.clip(velocity, -limit, limit)
    return Motion(np.asarray(velocity), start.acceleration, np.asarray(confidence))


@jax.jit
def _refine(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    part: Float[Array, " n"],
    velocity: Float[Array, "2 h w"],
    acceleration: Float[Array, "2 h w"],
    base: Float[Array, "2 h w"],
    bound: Float[Array, ""],
    window: Float[Array, ""],
    steps: Int[Array, ""],
) -> tuple[Float[Array, "2 h w"], Float[Array, "h w"]]:
    longest = jnp.max(jnp.abs(after) * part)

    def step(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        velocity, _ = carry
        now = drift(pictures, after, part, (velocity, acceleration))
        spread, change = now.spread[0, 0], now.change[0]
        noise = smooth(now.residual / jnp.maximum(now.seen, 1), window) + 1e-8
        # Per unit of residual variance: the information about the velocity in the window.
        information = smooth(spread[None, None] * now.slope[:, None] * now.slope[None], window) / noise[None, None]
        pull = -smooth(change[None] * now.slope, window) / noise[None]
        # As if the velocity were known beforehand to within 2 px over the recording: decides only where nothing else
        # does.
        prior = (longest / 2) ** 2
        pull = pull + prior * (base - velocity) * 0.01
        a, b, d = information[0, 0] + 0.01 * prior, information[0, 1], information[1, 1] + 0.01 * prior
        determinant = a * d - b * b
        update = jnp.stack([d * pull[0] - b * pull[1], a * pull[1] - b * pull[0]]) / determinant[None]
        length = jnp.sqrt((update**2).sum(0))
        velocity = velocity + update * jnp.minimum(1, bound / longest / jnp.maximum(length, 1e-12))[None]
        # Variance of the poorer component over the recording, in sensor pixels.
        poorest = (a + d) / 2 - jnp.sqrt(((a - d) / 2) ** 2 + b * b)
        confidence = 1 / (1 + longest**2 / jnp.maximum(poorest, 1e-12))
        return velocity, confidence

    return jax.lax.fori_loop(0, steps, step, (velocity, jnp.ones_like(velocity[0])))
