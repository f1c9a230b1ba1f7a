"""How far a motion can be trusted, moment by moment: where the pictures along it stop agreeing, samples count less.

No estimate of the motion is right everywhere. Things turn, speed up, pass behind one another, and the farther from the
key frame, the worse a velocity predicts where they are. Wrong samples blur; missing ones only leave some noise. So a
moment's samples are weighted by what they are worth: noise variance N and squared error of the motion E make a sample
as good as one of variance N + E.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from scsr_opt.motion.estimators.evidence import TOLERATED_AT_REST, at_rest
from scsr_opt.motion.estimators.frames import MotionFrames, along, smooth
from scsr_opt.motion.inversion import interpolated
from scsr_opt.motion.stacks import folded
from scsr_opt.motion.trajectory import Motion, Trust

# The pictures are compared after this presmoothing (sensor pixels): coarse enough that aliasing between pixels does not
# count as disagreement. Squared differences are averaged over the neighbourhood.
_SHARPNESS = 1.0
_NEIGHBOURHOOD = 1.5
# The picture that all are compared with: a mean over the moments around the key frame (standard deviation in frames).
_PRESENT = 2.0
# In units of the noise of one picture: a squared difference of two such is 2 by chance; below 3 it counts as agreement.
_CHANCE = 3.0
# An error of the motion is the same for many samples, so that it does not average out as noise does: it counts so many
# times. (From 4 to 10 video clips gained 0.1 to 0.2 dB, scenes of layers lost 0.05 dB.)
_COHERENCE = 8.0
# What stands still and is never worth less than this share is worth the mean of its moments throughout: it then needs
# no more than one measurement, and the weights that are left out would have lessened an error by half at most.
_STEADY = 0.5
# The mean logarithm of a χ² of one degree of freedom is −γ − log 2.
_GEOMETRIC = float(np.exp(-np.euler_gamma) / 2)


def trusted(pictures: MotionFrames, motion: Motion) -> Motion:
    """`motion` with its `trust` measured on the recording's pictures."""
    after = np.asarray(pictures.after)
    if after.size < 3 or not (motion.moves or _something_moves(pictures)):
        return motion
    # Pictures nearer to each other than a pixel's interval between spikes share their light and their error.
    interval = 1 / max(float(np.median(np.asarray(pictures.firing))), 1e-3) if pictures.firing is not None else 1.0
    lag = int(np.clip(np.ceil(interval / (after[1] - after[0])), 1, after.size // 2))
    share = _share(
        pictures.presmoothed(_SHARPNESS).picture,
        pictures.after,
        motion.velocity,
        motion.acceleration,
        np.int32(lag),
    )
    trust = Trust(after, np.asarray(share))
    return Motion(motion.velocity, motion.acceleration, motion.confidence, motion.layers, trust)


def _something_moves(pictures: MotionFrames) -> bool:
    """Does the recording contradict that nothing moves?"""
    return bool(at_rest(pictures)[0].mean() > TOLERATED_AT_REST)


@jax.jit
def _share(
    pictures: Float[Array, "n h w"],
    moments: Float[Array, " n"],
    velocity: Float[Array, "2 h w"],
    acceleration: Float[Array, "2 h w"],
    lag: Int[Array, ""],
) -> Float[Array, "n h w"]:
    # Picture by picture, so that what is found of one is still in the cache when it is used.
    def moved(one: tuple[Array, Array]) -> tuple[Array, Array]:
        corner, inside = along(one[1], velocity, acceleration)
        return interpolated(one[0], corner), inside

    values, inside = jax.lax.map(moved, (pictures, moments))
    near = jnp.exp(-0.5 * (moments / _PRESENT) ** 2)[:, None, None] * inside
    # The nearest moment always takes part, however far it is.
    near = near + 1e-6 * (jnp.abs(moments) == jnp.min(jnp.abs(moments))).astype(jnp.float32)[:, None, None]
    nothing = jnp.zeros_like(values[0])

    def average(k: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        return sums[0] + near[k] * values[k], sums[1] + near[k]

    total, weight = jax.lax.fori_loop(0, values.shape[0], average, (nothing, nothing))
    present = total / weight

    # The noise, from pictures a spike interval apart: a geometric mean, so that a few moments that disagree for another
    # reason do not matter.
    def compare(k: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        both = inside[k] * inside[k + lag]
        change = (values[k + lag] - values[k]) ** 2 / 2
        return sums[0] + both * jnp.log(change + 1e-8), sums[1] + both

    logarithms, compared = jax.lax.fori_loop(0, values.shape[0] - lag, compare, (nothing, nothing))
    noise = smooth(jnp.exp(logarithms / jnp.maximum(compared, 1)) / _GEOMETRIC, jnp.asarray(3.0)) + 1e-6
    # Presmoothing has averaged the noise of so many pixels, which each sample has in full.
    noise_of_one = noise * (4 * np.pi * _SHARPNESS**2)
    window = jnp.asarray(_NEIGHBOURHOOD)

    def worth(one: tuple[Array, Array]) -> Array:
        value, inside = one
        square = smooth((value - present) ** 2 * inside, window) / jnp.maximum(smooth(inside, window), 0.1)
        error = jnp.maximum(square - _CHANCE * noise, 0)
        return 1 / (1 + _COHERENCE * error / noise_of_one)

    share = jax.lax.map(worth, (values, inside))
    still = (velocity[0] == 0) & (velocity[1] == 0) & (acceleration[0] == 0) & (acceleration[1] == 0)
    steady = still & (folded(jnp.minimum, share) >= _STEADY)
    return jnp.where(steady[None], folded(jnp.add, share)[None] / len(share), share)
