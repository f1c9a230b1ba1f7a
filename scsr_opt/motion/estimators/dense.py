"""A velocity and an acceleration for each pixel, from all moments of the recording at once."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from scsr_opt.motion.estimators.frames import MotionFrames, drift, smooth
from scsr_opt.motion.trajectory import Motion

_VELOCITY, _ACCELERATION = 0, 1
_Part = tuple[int, tuple[float, float, float, int]]
_WIDE = 6.0  # sensor pixels, a window
# What is looked for, and how: frames from the key frame, presmoothing and window (sensor pixels), steps. Near times and
# wide windows first. An acceleration is known less well than a velocity, so it is taken from wider windows.
_FOR_VELOCITY = (
    (_VELOCITY, (8.0, 2.0, 6.0, 8)),
    (_VELOCITY, (16.0, 1.5, 4.0, 6)),
    (_VELOCITY, (32.0, 1.0, 3.0, 6)),
    (_VELOCITY, (np.inf, 0.8, 2.5, 6)),
)
_A_TURN = ((_ACCELERATION, (np.inf, 0.8, _WIDE, 1)), (_VELOCITY, (np.inf, 0.8, 4.0, 1)))

# What |a|² times its information in a window comes to by chance, on average, where nothing accelerates (pans by day).
# Noise that neighbouring pictures share adds up instead of averaging out: in dim light it is ten times that.
_CHANCE = 0.05
# Side of the square of pixels that vote after each part of the schedule.
_VOTERS = 5


def dense(pictures: MotionFrames, *, start: Motion | None = None) -> Motion:
    """Least squares in a Gaussian window around each pixel (Lucas and Kanade, 1981), over all moments at once, for the
    velocity, from near times to far ones; the acceleration is that of `start` (`accelerated` finds one).

    Where a window has no texture the velocity stays near that of `start` (nothing moves, if not given).
    """
    start = Motion.none(*pictures.picture.shape[1:]) if start is None else start
    return _searched(pictures, start, start, _FOR_VELOCITY)


def accelerated(pictures: MotionFrames, motion: Motion, *, start: Motion | None = None, turns: int = 3) -> Motion:
    """A dense motion with an acceleration for each pixel, sensor pixels per frame², as far as chance does not explain
    it: acceleration and velocity by least squares in so many `turns`. Where a window has no texture they stay near
    those of `start` (nothing moves, if not given)."""
    start = Motion.none(*pictures.picture.shape[1:]) if start is None else start
    return _searched(pictures, motion, start, _A_TURN * turns)


def _searched(pictures: MotionFrames, motion: Motion, start: Motion, schedule: tuple[_Part, ...]) -> Motion:
    """`motion` after all parts of a schedule, near `start` where a window has no texture."""
    height, width = pictures.picture.shape[1:]
    distance = np.sort(np.abs(np.asarray(pictures.after)))
    # What has left the picture halfway through the recording cannot have been followed.
    limits = 0.5 * max(height, width) / (distance[-1] + 1), max(height, width) / (distance[-1] + 1) ** 2
    field, base = (np.stack([m.velocity, m.acceleration]) for m in (motion, start))
    confidence, by_chance = np.ones((height, width), np.float32), _by_chance(pictures)
    for which, (reach, sigma, window, steps) in schedule:
        field, known = _after_part(
            pictures.presmoothed(sigma).picture,
            pictures.after,
            field,
            base,
            np.int32(which),
            # Three moments at least, however far apart they are.
            np.float32(max(reach, distance[min(2, distance.size - 1)])),
            # A step of more pixels than this at the farthest moment is beyond what the linearisation knows.
            np.float32(sigma + 0.5),
            np.float32(window),
            np.int32(steps),
            np.float32(limits[which]),
            by_chance,
        )
        confidence = known if which == _VELOCITY else confidence
    velocity, acceleration = np.asarray(field)
    return Motion(velocity, acceleration, np.asarray(confidence))


@jax.jit
def _after_part(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    field: Float[Array, "2 2 h w"],
    base: Float[Array, "2 2 h w"],
    which: Int[Array, ""],
    reach: Float[Array, ""],
    bound: Float[Array, ""],
    window: Float[Array, ""],
    steps: Int[Array, ""],
    limit: Float[Array, ""],
    by_chance: Float[Array, "*hw"],
) -> tuple[Float[Array, "2 2 h w"], Float[Array, "h w"]]:
    """`field`, velocity and acceleration (sensor pixels per frame and per frame²), after a part of the schedule, and
    how well the velocity is known, 0 to 1. In one program, as on a small sensor calls take as long as numbers.

    `which` of the two is looked for, among moments within `reach` frames, in `steps` of at most `bound` sensor pixels,
    by a `window` of so many, up to `limit`; `base`: what it stays near without texture.
    """
    part = (jnp.abs(after) <= reach).astype(after.dtype)
    field, information = _refine(pictures, after, part, field, base, which, bound, window, steps)
    # Single windows that went astray are outvoted by their neighbours; an edge between two motions stays.
    voted = jnp.clip(_median(field[which]), -limit, limit)
    believed = jnp.where(which == _ACCELERATION, _believed(voted, base[which], information, by_chance), voted)
    longest = jnp.max(jnp.abs(after) * part)
    return field.at[which].set(believed), _confidence(information, longest)


@jax.jit
def _median(values: Float[Array, "c h w"]) -> Float[Array, "c h w"]:
    """The median of the square of `_VOTERS` pixels a side around each; beyond the border values continue.

    By Batcher's network of exchanges (Knuth, "The Art of Computer Programming", 5.2.2, algorithm M), of which those
    that the middle one does not depend on fall away in compiling.
    """
    reach, (_, height, width) = _VOTERS // 2, values.shape
    wide = jnp.pad(values, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    sides = range(_VOTERS)
    sorting = [wide[:, row : row + height, column : column + width] for row in sides for column in sides]
    half = 1 << (len(sorting) - 1).bit_length() - 1
    p = half
    while p:
        distance, q, bit = p, half, 0
        while True:
            for i in range(len(sorting) - distance):
                if i & p == bit:
                    one, other = sorting[i], sorting[i + distance]
                    sorting[i], sorting[i + distance] = jnp.minimum(one, other), jnp.maximum(one, other)
            if q == p:
                break
            distance, q, bit = q - p, q // 2, p
        p //= 2
    return sorting[len(sorting) // 2]


def _by_chance(pictures: MotionFrames) -> Float[Array, "*hw"]:
    """`_CHANCE`, times the number of pictures that the intervals of a pixel last: these share its noise."""
    firing, after = pictures.firing, pictures.after
    if firing is None or after.size < 2:
        return jnp.asarray(_CHANCE, jnp.float32)
    return pictures.once("by chance", lambda: _shared(firing, after))


@jax.jit
def _shared(firing: Float[Array, "h w"], after: Float[Array, " n"]) -> Float[Array, "h w"]:
    frames = (after[-1] - after[0]) / (after.size - 1)
    return _CHANCE / jnp.clip(smooth(firing, jnp.asarray(_WIDE)) * frames, 1e-3, 1)


def _believed(
    acceleration: Float[Array, "2 h w"],
    base: Float[Array, "2 h w"],
    information: Float[Array, "3 h w"],
    by_chance: Float[Array, "*hw"],
) -> Float[Array, "2 h w"]:
    """An acceleration drawn towards `base`, by the share that chance has in what it differs by."""
    (down, right), (a, b, d) = acceleration - base, information
    evidence = a * down**2 + 2 * b * down * right + d * right**2
    share = jnp.minimum(1, by_chance / jnp.maximum(evidence, 1e-12))
    return base + (1 - share)[None] * (acceleration - base)


def _confidence(information: Float[Array, "3 h w"], longest: Float[Array, ""]) -> Float[Array, "h w"]:
    """How well the velocity is known, 0 to 1, by the variance of its poorer component over the recording, pixels."""
    a, b, d = information
    poorest = (a + d) / 2 - jnp.sqrt(((a - d) / 2) ** 2 + b * b)
    return 1 / (1 + longest**2 / jnp.maximum(poorest, 1e-12))


def _refine(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    part: Float[Array, " n"],
    field: Float[Array, "2 2 h w"],
    base: Float[Array, "2 2 h w"],
    which: Int[Array, ""],
    bound: Float[Array, ""],
    window: Float[Array, ""],
    steps: Int[Array, ""],
) -> tuple[Float[Array, "2 2 h w"], Float[Array, "3 h w"]]:
    """`field`, velocity and acceleration, after some steps for one of them, and the information about that one: a, b
    and d of the matrix [[a, b], [b, d]], per pixel of the window and unit of residual variance.

    With the acceleration goes the velocity that fits best beside it; where the key frame is not in the middle of the
    recording, one looks much like the other.
    """
    longest = jnp.max(jnp.abs(after) * part)
    accelerating = which == _ACCELERATION
    # Pixels that a unit of it is worth at the farthest moment.
    lever = jnp.where(accelerating, longest**2 / 2, longest)

    def step(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        field, _ = carry
        now = drift(pictures, after, part, (field[0], field[1]))
        # τ²/2 − beside · τ is what acceleration has for itself.
        beside = jnp.where(accelerating, now.spread[0, 1] / jnp.maximum(now.spread[0, 0], 1e-6), 0)
        spread = now.spread[which, which] - beside * now.spread[0, 1]
        change = now.change[which] - beside * now.change[0]
        noise = smooth(now.residual / jnp.maximum(now.seen, 1), window) + 1e-8
        products = jnp.stack([now.slope[0] ** 2, now.slope[0] * now.slope[1], now.slope[1] ** 2])
        information = smooth(spread[None] * products, window) / noise[None]
        pull = -smooth(change[None] * now.slope, window) / noise[None]
        # As if it were known beforehand to within 2 px over the recording: decides only where nothing else does.
        prior = 0.01 * (lever / 2) ** 2
        pull = pull + prior * (base[which] - field[which])
        a, b, d = information[0] + prior, information[1], information[2] + prior
        determinant = a * d - b * b
        update = jnp.stack([d * pull[0] - b * pull[1], a * pull[1] - b * pull[0]]) / determinant[None]
        length = jnp.sqrt(update[0] ** 2 + update[1] ** 2)
        update = update * jnp.minimum(1, bound / lever / jnp.maximum(length, 1e-12))[None]
        field = field.at[which].add(update).at[_VELOCITY].add(-beside[None] * update)
        return field, jnp.stack([a, b, d])

    return jax.lax.fori_loop(0, steps, step, (field, jnp.ones_like(field, shape=(3, *field.shape[2:]))))
