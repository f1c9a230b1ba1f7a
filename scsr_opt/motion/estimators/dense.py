"""A velocity and an acceleration for each pixel, by regression over all moments of the recording at once."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from scsr_opt.motion.estimators.frames import MotionFrames, drift, smooth, smoothed
from scsr_opt.motion.estimators.settings import DenseSettings
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.trajectory import Motion

# Which of the two fields is estimated.
_VELOCITY, _ACCELERATION = range(2)


class _Level(NamedTuple):
    """A level of the search: for velocities or accelerations (`which`); from moments within `reach` frames of the key
    frame; presmoothing `sigma` and `window` of the least squares, sensor pixels; Gauss–Newton `steps`."""

    which: int
    reach: float
    sigma: float
    window: float
    steps: int


def dense(pictures: MotionFrames, *, start: Motion | None = None, settings: MotionSettings = DEFAULTS) -> Motion:
    """A velocity for each pixel: least squares in a Gaussian window around it (Lucas and Kanade, 1981), over all
    moments at once, from near times to far ones. The acceleration is that of `start` (`accelerated` estimates one).

    Where a window has no texture the velocity stays near that of `start`, rest if None. The confidence of a pixel, 0 to
    1, follows from the variance of its displacement.
    """
    start = Motion.none(*pictures.picture.shape[1:]) if start is None else start
    options = settings.dense
    reaches = (*settings.comparison.near_times_frames, np.inf)
    values = zip(reaches, options.presmoothing_px, options.window_px, options.steps, strict=True)
    unused = np.zeros(() if pictures.firing is None else pictures.firing.shape, np.float32)
    return _searched(pictures, start, start, [_Level(_VELOCITY, *each) for each in values], unused, options)


def accelerated(
    pictures: MotionFrames,
    motion: Motion,
    *,
    start: Motion | None = None,
    turns: int | None = None,
    reach: float = np.inf,
    settings: MotionSettings = DEFAULTS,
) -> Motion:
    """A dense motion with an acceleration for each pixel, sensor pixels per frame², as far as noise does not explain
    it.

    Acceleration and velocity are improved by least squares in `turns` (those of the settings if None), from windows
    that are wider for the acceleration, which is known less well. Where a window has no texture both stay near those of
    `start`, rest if None. Pictures within `reach` frames of the key frame take part.
    """
    start = Motion.none(*pictures.picture.shape[1:]) if start is None else start
    options = settings.dense
    sigma = options.presmoothing_px[-1]
    turn = [
        _Level(_ACCELERATION, reach, sigma, options.acceleration_window_px, 1),
        _Level(_VELOCITY, reach, sigma, options.accelerated_window_px, 1),
    ]
    turns = options.acceleration_turns if turns is None else turns
    return _searched(pictures, motion, start, turn * turns, _chance_level(pictures, options), options)


def _searched(
    pictures: MotionFrames,
    motion: Motion,
    start: Motion,
    levels: list[_Level],
    chance: Float[np.ndarray | Array, "*hw"],
    settings: DenseSettings,
) -> Motion:
    """`motion` after all levels, near `start` where a window has no texture; `chance`: see `_chance_level`."""
    height, width = pictures.picture.shape[1:]
    distance = np.sort(np.abs(np.asarray(pictures.after)))
    # A point that leaves the picture halfway through the recording cannot be followed.
    limits = (
        settings.followed_share * max(height, width) / (distance[-1] + 1),
        max(height, width) / (distance[-1] + 1) ** 2,
    )
    field, base = (np.stack([m.velocity, m.acceleration]) for m in (motion, start))
    confidence = np.ones((height, width), np.float32)
    for level in levels:
        search = _Search(
            which=np.int32(level.which),
            # At least three moments, however far apart they are.
            reach=np.float32(max(level.reach, distance[min(2, distance.size - 1)])),
            bound=np.float32(level.sigma + settings.step_margin_px),
            window=np.float32(level.window),
            steps=np.int32(level.steps),
            limit=np.float32(limits[level.which]),
        )
        blurred = pictures.presmoothed(level.sigma)
        field, known = _after_level(blurred, pictures.after, field, base, search, chance, settings)
        confidence = known if level.which == _VELOCITY else confidence
    velocity, acceleration = np.asarray(field)
    return Motion(velocity, acceleration, np.asarray(confidence))


class _Search(NamedTuple):
    """A level as data of the compiled program: as `_Level`, with the `bound` of one step, sensor pixels at the farthest
    moment, and the `limit` of a component of velocity or acceleration."""

    which: Int[Array | np.int32, ""]
    reach: Float[Array | np.float32, ""]
    bound: Float[Array | np.float32, ""]
    window: Float[Array | np.float32, ""]
    steps: Int[Array | np.int32, ""]
    limit: Float[Array | np.float32, ""]


@partial(jax.jit, static_argnames="settings")
def _after_level(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    field: Float[Array, "2 2 h w"],
    base: Float[Array, "2 2 h w"],
    search: _Search,
    chance: Float[Array, "*hw"],
    settings: DenseSettings,
) -> tuple[Float[Array, "2 2 h w"], Float[Array, "h w"]]:
    """`field`, velocity and acceleration (sensor pixels per frame and per frame²), after a level of the search, and the
    confidence of the velocity. One program, as on a small sensor each call takes as long as its computation.

    `base`: the field that it stays near where there is no texture.
    """
    which = search.which
    part = (jnp.abs(after) <= search.reach).astype(after.dtype)
    field, information = _refine(pictures, after, part, field, base, search, settings)
    # Single wrong windows are outvoted by their neighbours; an edge between two motions stays.
    voted = jnp.clip(_median(field[which], settings.median_side_px), -search.limit, search.limit)
    shrunk = jnp.where(which == _ACCELERATION, _shrunk(voted, base[which], information, chance), voted)
    longest = jnp.max(jnp.abs(after) * part)
    return field.at[which].set(shrunk), _confidence(information, longest)


@partial(jax.jit, static_argnames="side")
def _median(values: Float[Array, "c h w"], side: int) -> Float[Array, "c h w"]:
    """Median filter over squares of `side` pixels a side; beyond the border values continue.

    By Batcher's merge-exchange network (Knuth, "The Art of Computer Programming", 5.2.2, algorithm M); exchanges that
    the middle value does not depend on are removed by the compiler.
    """
    reach, (_, height, width) = side // 2, values.shape
    wide = jnp.pad(values, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    sides = range(2 * reach + 1)
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


def _chance_level(pictures: MotionFrames, settings: DenseSettings) -> Float[np.ndarray, "*hw"]:
    """Squared acceleration times its information that noise has: `acceleration_chance`, times the number of pictures
    that one interval of a pixel lasts, as these share its noise."""
    firing, after = pictures.firing, pictures.after
    if firing is None or after.size < 2:
        return np.asarray(settings.acceleration_chance, np.float32)
    times = np.asarray(after)
    frames = (times[-1] - times[0]) / (times.size - 1)
    around = smoothed(firing, settings.acceleration_window_px)
    return settings.acceleration_chance / np.clip(around * frames, settings.least_picture_share, 1)


def _shrunk(
    acceleration: Float[Array, "2 h w"],
    base: Float[Array, "2 h w"],
    information: Float[Array, "3 h w"],
    chance: Float[Array, "*hw"],
) -> Float[Array, "2 h w"]:
    """An acceleration shrunk towards `base` by the share that noise has in their difference."""
    (down, right), (a, b, d) = acceleration - base, information
    evidence = a * down**2 + 2 * b * down * right + d * right**2
    share = jnp.minimum(1, chance / jnp.maximum(evidence, 1e-12))
    return base + (1 - share)[None] * (acceleration - base)


def _confidence(information: Float[Array, "3 h w"], longest: Float[Array, ""]) -> Float[Array, "h w"]:
    """Confidence of the velocity, 0 to 1: ½ where its poorer component is known to one pixel over the recording."""
    a, b, d = information
    poorest = (a + d) / 2 - jnp.sqrt(((a - d) / 2) ** 2 + b * b)
    return 1 / (1 + longest**2 / jnp.maximum(poorest, 1e-12))


def _refine(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    part: Float[Array, " n"],
    field: Float[Array, "2 2 h w"],
    base: Float[Array, "2 2 h w"],
    search: _Search,
    settings: DenseSettings,
) -> tuple[Float[Array, "2 2 h w"], Float[Array, "3 h w"]]:
    """`field`, velocity and acceleration, after Gauss–Newton steps for one of them, and the information about that one:
    a, b and d of the matrix [[a, b], [b, d]], per pixel of the window and unit of residual variance.

    An acceleration is fitted together with the velocity that fits best beside it: where the key frame is not in the
    middle of the recording, the two are nearly collinear.
    """
    which, window = search.which, search.window
    longest = jnp.max(jnp.abs(after) * part)
    accelerating = which == _ACCELERATION
    # Displacement at the farthest moment by a unit of velocity or acceleration, sensor pixels.
    lever = jnp.where(accelerating, longest**2 / 2, longest)

    def step(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        field, _ = carry
        now = drift(pictures, after, part, (field[0], field[1]))
        # τ²/2 − beside · τ is the regressor of the acceleration that is orthogonal to the velocity's.
        beside = jnp.where(accelerating, now.spread[0, 1] / jnp.maximum(now.spread[0, 0], 1e-6), 0)
        spread = now.spread[which, which] - beside * now.spread[0, 1]
        change = now.change[which] - beside * now.change[0]
        noise = smooth(now.residual / jnp.maximum(now.seen, 1), window) + 1e-8
        products = jnp.stack([now.slope[0] ** 2, now.slope[0] * now.slope[1], now.slope[1] ** 2])
        information = smooth(spread[None] * products, window) / noise[None]
        gradient = -smooth(change[None] * now.slope, window) / noise[None]
        prior = settings.prior_weight * (lever / settings.prior_px) ** 2
        gradient = gradient + prior * (base[which] - field[which])
        a, b, d = information[0] + prior, information[1], information[2] + prior
        determinant = a * d - b * b
        update = jnp.stack([d * gradient[0] - b * gradient[1], a * gradient[1] - b * gradient[0]]) / determinant[None]
        length = jnp.sqrt(update[0] ** 2 + update[1] ** 2)
        update = update * jnp.minimum(1, search.bound / lever / jnp.maximum(length, 1e-12))[None]
        field = field.at[which].add(update).at[_VELOCITY].add(-beside[None] * update)
        return field, jnp.stack([a, b, d])

    return jax.lax.fori_loop(0, search.steps, step, (field, jnp.ones_like(field, shape=(3, *field.shape[2:]))))
