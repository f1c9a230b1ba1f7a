"""Several surfaces, each with a motion of its own, one in front of another.

At the edge of something that moves, a velocity for each pixel is not enough: it blends the two motions, and it cannot
say which surface hides which. Here the scene is taken apart into layers. Each has a smooth motion over the whole
picture (affine with acceleration, or the dense estimate where nothing simpler serves), and a label says which layer
the key frame shows at a pixel. What a sensor pixel sees at another time then follows: of the layers whose point comes
to lie there and that are seen in the key frame at that point, the one in front. If there is none, the surface was
hidden in the key frame and the sample has to be left out.
"""

from collections.abc import Callable
from functools import partial
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from scsr_opt._threads import in_threads
from scsr_opt.motion.estimators.evidence import contradicted, typical_noise, variance_along
from scsr_opt.motion.estimators.frames import MotionFrames, along, drift, smooth
from scsr_opt.motion.estimators.parametric import generators, parametric
from scsr_opt.motion.inversion import Corner, bilinear, in_turn, interpolated, inverse
from scsr_opt.motion.trajectory import Layers, Motion

# Layers besides the background that are looked for, and the fewest sensor pixels one may have.
_MOST = 3
_FEWEST_PIXELS = 40
# Pixels of a region, about, whose velocities an affine one is fitted to: a start, which is refined.
_FITTED = 4000
# Velocities that a region is tried with; those nearer than this (sensor pixels per frame) are alike.
_COMMON, _ALIKE = 3, 0.02
# A candidate that at most so many times as many pixels contradict as the best one serves a region as well.
_ABOUT = 1.1
# Where no more than this share of a region contradicts its first fit, what is left was hidden or uncovered: of 51
# regions (the scoreboard's objects and fans, two scales) 31 were, and no other candidate would have been chosen there.
_LITTLE = 0.35
# Parts no further apart than twice this (sensor pixels) are one region.
_NEAR = 3
# Sensor pixels from the edge of a layer that show something of the next.
_EDGE = 3
# Presmoothing (sensor pixels) of the pictures whose agreement decides about labels, and of the mismatch itself: small,
# so that edges stay where they are.
_SHARPNESS = 0.6
_SUPPORT = 1.2
# A mismatch counts in units of the noise, at most this much: what is hidden at a time mismatches under any motion.
_ENOUGH = 6.0
# The picture of the key frame is a mean over near moments, weighted by a Gaussian of 6 frames; weights below this are
# left out.
_HARDLY = 1e-4
# What a motion has to gain over one found before it (the background is the first, the dense estimate the last): where
# all fit, the simplest is taken.
_PREFERENCE = 0.15
# An affine motion goes on growing outside the region that it was fitted to. Where it is so many times as fast as what
# was seen moving, it is not believed.
_FASTEST = 1.5
# One picture in so many votes on which layer is in front.
_EVERY = 3
# A part of a layer is given to one that makes up so much of the edge around it, if that mismatches by so little more.
_AROUND, _UNDECIDED = 0.25, 0.15
# What a pixel gains by agreeing with its neighbourhood, in the same units, the neighbourhood's radius, and how often
# neighbours are asked.
_TOGETHER = 1.4
_NEIGHBOURHOOD = 1.5
_TURNS = 12


def layered(
    pictures: MotionFrames,
    background: Motion,
    everywhere: Motion,
    moving: Bool[np.ndarray, "h w"],
    total: int,
    *,
    skip: bool,
    sparse: bool,
) -> list[Callable[[], Motion]]:
    """The scene as layers: `background`, further affine motions where that is contradicted, and the dense estimate
    `everywhere` where these do not explain enough.

    **Arguments:** `moving`: where `background` is contradicted; `total`: sensor pixels, of which the pictures may be a
    part: what lies outside is background; `skip`: whether a region that its first fit explains is fitted no more, and
    its fits begin with a part of their points; `sparse`: whether one row and column in two tell which layer is in front
    and whether a last fit is the better one, which then begins with a part of its points, too.

    **Returns:** motions with `layers` to choose from, made as asked for, or `background` alone if nothing else was
    found. Along the edges of something that moves, the dense estimate takes what it uncovers for another surface; so
    the first one is without it, where that is possible.
    """
    # What is too fast to be heard against is not heard for either.
    fastest = _FASTEST * _top_speed(everywhere, moving)
    motions = _find(pictures, background, everywhere, moving, fastest, total, skip)
    noise = typical_noise(pictures, everywhere, _SHARPNESS)
    sharp = pictures.presmoothed(_SHARPNESS)
    number = len(motions)
    first = number - 1 if number > 2 and motions[-1] is everywhere else number

    def mismatch(motion: Motion) -> Float[np.ndarray, "h w"]:
        return _mismatch(sharp, motion, noise) + _ENOUGH * (motion.speed > fastest)

    mismatches = in_threads(mismatch, motions[:first])

    def made(some: int) -> Motion:
        of_some = mismatches + [mismatch(motion) for motion in motions[first:some]]
        return _layers(pictures, motions[:some], of_some, everywhere, sparse=sparse)

    return [partial(made, some) for some in range(first, number + 1)]


def relabelled(pictures: MotionFrames, motion: Motion) -> Motion:
    """A motion of layers with the labels found on these pictures, the layers' own motions and depths as they are; any
    other motion as it is."""
    layers = motion.layers
    if layers is None:
        return motion
    each = [
        Motion(velocity, acceleration, motion.confidence)
        for velocity, acceleration in zip(layers.velocity, layers.acceleration, strict=True)
    ]
    noise = typical_noise(pictures, motion, _SHARPNESS)
    sharp = pictures.presmoothed(_SHARPNESS)
    label = _label([_mismatch(sharp, one, noise) for one in each]).astype(np.int32)
    return Motion.of_layers(eqx.tree_at(lambda found: found.label, layers, label), motion.confidence)


def _layers(
    pictures: MotionFrames,
    motions: list[Motion],
    mismatches: list[Float[np.ndarray, "h w"]],
    everywhere: Motion,
    *,
    sparse: bool,
) -> Motion:
    """Layers with these motions, `everywhere` for the confidence; a single motion if one is left of them."""
    background = motions[0]
    while True:  # a layer that nearly no pixel wants goes, and its pixels choose again
        if len(motions) == 1:
            return motions[0]
        label = _label(mismatches)
        sizes = np.bincount(label.ravel(), minlength=len(motions))
        if sizes.min() >= _FEWEST_PIXELS:
            break
        kept = np.flatnonzero(sizes >= _FEWEST_PIXELS) if sizes.max() >= _FEWEST_PIXELS else [0]
        motions, mismatches = [motions[k] for k in kept], [mismatches[k] for k in kept]

    def sharpened(k: int) -> Motion:
        if motions[k] is background or motions[k] is everywhere:
            return motions[k]
        return _sharpened(pictures, motions[k], np.asarray(label == k), sparse=sparse)

    motions = in_threads(sharpened, range(len(motions)))
    layers = Layers(
        velocity=np.stack([motion.velocity for motion in motions]),
        acceleration=np.stack([motion.acceleration for motion in motions]),
        label=label.astype(np.int32),
        depth=np.zeros(len(motions), np.int32),
    )
    layers = eqx.tree_at(lambda found: found.depth, layers, _depth(pictures, layers, sparse=sparse))
    return Motion.of_layers(layers, everywhere.confidence)


def _find(
    pictures: MotionFrames,
    background: Motion,
    everywhere: Motion,
    moving: Bool[np.ndarray, "h w"],
    fastest: float,
    total: int,
    skip: bool,
) -> list[Motion]:
    """The candidates: the largest region that contradicts all so far is given a motion of its own, again and again."""

    def judge(candidate: Callable[[], Motion]) -> tuple[Motion, Bool[np.ndarray, "h w"]]:
        motion = candidate()
        return motion, contradicted(pictures, motion) | (motion.speed > fastest)

    motions = [background]
    tried, unexplained = np.zeros_like(moving), moving
    for _ in range(_MOST):
        left = unexplained & ~tried
        regions, number = _regions(left)
        if number == 0:
            break
        sizes = np.bincount(regions[left].ravel(), minlength=number + 1)[1:]
        region = (regions == 1 + sizes.argmax()) & ~tried
        if sizes.max() < _FEWEST_PIXELS:
            break
        # The region holds what the surface uncovers, too, and in dim light a fit to the pictures may go astray. Of what
        # is fitted to the region and what the dense estimate finds most in it, that is taken which most agree with.
        # Among candidates about as good as the best the first is taken: fits come before constants.
        candidates = _candidates(pictures, everywhere, region, skip)
        judged = in_threads(judge, candidates[:1] if skip else candidates)
        if skip and (region & judged[0][1]).sum() > _LITTLE * region.sum():
            judged += in_threads(judge, candidates[1:])
        fits, wrong = zip(*judged, strict=True)
        against = np.array([(region & here).sum() for here in wrong])
        best = int(np.argmax(against <= _ABOUT * against.min()))
        explained = region & ~wrong[best]
        if explained.sum() > 0.3 * region.sum():
            motions.append(fits[best])
            unexplained = unexplained & wrong[best]
        tried = tried | region
    if len(motions) == 1 or unexplained.sum() > 0.01 * total:
        motions.append(everywhere)
    return motions


def _regions(mask: Bool[np.ndarray, "h w"]) -> tuple[Int[np.ndarray, "h w"], int]:
    """The parts of a mask without its single pixels, numbered from 1; what is near counts as one."""
    some = ndimage.binary_opening(mask)
    wide = cast(np.ndarray, ndimage.binary_closing(np.pad(some, _NEAR), iterations=_NEAR))  # whole at the edges, too
    return cast(tuple[np.ndarray, int], ndimage.label(wide[_NEAR:-_NEAR, _NEAR:-_NEAR]))


def _affine(motion: Motion, region: Bool[np.ndarray, "h w"]) -> Motion:
    """The affine velocity that most of a region's velocities are near to (iteratively reweighted least squares)."""
    height, width = region.shape
    fields = generators(np.mgrid[0:height, 0:width].astype(np.float32), height, width)[:6]
    places = np.flatnonzero(region)
    some = np.unravel_index(places[:: max(1, places.size // _FITTED)], region.shape)
    here, found = fields[:, :, *some].reshape(6, -1).T, motion.velocity[:, *some].reshape(-1)
    trust = np.tile(motion.confidence[some] + 1e-3, 2)
    weight, numbers = trust, np.zeros(6, np.float32)
    for _ in range(20):
        weighted = here * weight[:, None]
        damping = 1e-6 * np.eye(6, dtype=np.float32) * weight.sum()
        numbers = np.linalg.solve(weighted.T @ here + damping, weighted.T @ found)
        distance = (found - here @ numbers) ** 2
        usual = np.quantile(distance, 0.3) + 1e-8
        weight = trust / (1 + distance / (3 * usual)) ** 2
    return Motion.of_velocity(np.einsum("p,pchw->chw", numbers, fields))


def _candidates(
    pictures: MotionFrames, everywhere: Motion, region: Bool[np.ndarray, "h w"], sparse: bool
) -> list[Callable[[], Motion]]:
    """Motions that a region may have, those first that are preferred where they serve as well; made as asked for."""
    commonest = _commonest(everywhere, region)

    def fitted(start: Motion) -> Motion:
        return parametric(pictures, start=start, where=region, sparse=sparse)

    fits = [lambda: fitted(commonest[0]), lambda: fitted(_affine(everywhere, region))]
    return [*fits, *(lambda motion=motion: motion for motion in commonest)]


def _commonest(motion: Motion, region: Bool[np.ndarray, "h w"]) -> list[Motion]:
    """The velocities that most pixels of a region are near to, by confidence: a mean would mix right and wrong ones."""
    places = np.flatnonzero(region)
    places = np.unravel_index(places[:: max(1, places.size // 500)], region.shape)
    some, weight = motion.velocity[:, *places].T, motion.confidence[places] + 1e-3
    # Rows and columns apart: a sum over two of each pair took ten times as long.
    down, right = ((of[:, None] - of) ** 2 for of in some.T)
    distance = down + right
    votes = np.exp(-0.5 * distance / _ALIKE**2) @ weight
    found = []
    for _ in range(_COMMON):
        best = int(votes.argmax())
        found.append(Motion.of_velocity(np.broadcast_to(some[best][:, None, None], motion.velocity.shape)))
        votes = np.where(distance[best] < (3 * _ALIKE) ** 2, 0, votes)
        if not votes.any():
            break
    return found


def _sharpened(pictures: MotionFrames, motion: Motion, member: Bool[np.ndarray, "h w"], *, sparse: bool) -> Motion:
    """The motion fitted once more, to the inside of its layer: near the edges pictures show some of what lies behind,
    and that made an object 2 % too slow."""
    inside = cast(np.ndarray, ndimage.binary_erosion(member, iterations=_EDGE))
    if inside.sum() < _FEWEST_PIXELS:
        return motion
    found = parametric(pictures, start=motion, where=inside, fitted=True, sparse=sparse)
    # Fewer pixels may tell less: the better of the two.
    every = 2 if sparse else 1
    inside = inside[::every, ::every]

    def varies(one: Motion) -> float:
        return float(variance_along(pictures, one, every=every)[inside].mean())

    before, after = in_threads(varies, (motion, found))
    return found if after < before else motion


def _label(mismatches: list[Float[np.ndarray, "h w"]]) -> Int[np.ndarray, "h w"]:
    """The layer of each key-frame pixel: least mismatch, together with its neighbours."""
    mismatch = np.stack(mismatches)
    return _joined(np.asarray(_agreed(mismatch)), mismatch)


@jax.jit
def _agreed(mismatch: Float[Array, "layers h w"]) -> Int[Array, "h w"]:
    """The layer of least mismatch, the neighbourhood's layers considered (iterated conditional modes)."""
    numbers = jnp.arange(len(mismatch))[:, None, None]
    cost = mismatch + _PREFERENCE * numbers.astype(mismatch.dtype)

    def turn(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        label, done, _ = carry
        around = smooth((label[None] == numbers).astype(cost.dtype), jnp.asarray(_NEIGHBOURHOOD))
        again = _least(cost - _TOGETHER * around)
        return again, done + 1, jnp.any(again != label)

    def go_on(carry: tuple[Array, Array, Array]) -> Array:
        return (carry[1] < _TURNS) & carry[2]

    begin = _least(cost), jnp.zeros((), jnp.int32), jnp.asarray(True)
    return jax.lax.while_loop(go_on, turn, begin)[0]


def _least(cost: Float[Array, "layers h w"]) -> Int[Array, "h w"]:
    """The number of the least, of equal ones the first; layer by layer, as `folded`."""
    least, label = cost[0], jnp.zeros(cost.shape[1:], jnp.int32)
    for k in range(1, len(cost)):
        label = jnp.where(cost[k] < least, k, label)
        least = jnp.minimum(least, cost[k])
    return label


def _joined(label: Int[np.ndarray, "h w"], mismatch: Float[np.ndarray, "layers h w"]) -> Int[np.ndarray, "h w"]:
    """Each part of a layer but its largest goes to a layer around it whose motion explains it as well.

    A plain surface moves as well as it rests; what lies around says which.
    """
    joined = label.copy()
    for k in range(len(mismatch)):
        parts, number = cast(tuple[np.ndarray, int], ndimage.label(label == k))
        if number < 2:
            continue
        largest = 1 + int(np.bincount(parts.ravel())[1:].argmax())
        for part, box in enumerate(ndimage.find_objects(parts), 1):
            if part == largest:
                continue
            box = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in box)
            member = parts[box] == part
            edge = ndimage.binary_dilation(member) & ~member
            around = np.bincount(label[box][edge], minlength=len(mismatch))
            explained = mismatch[(slice(None), *box)][:, member].mean(1)
            explained[around < _AROUND * edge.sum()] = np.inf
            other = int(explained.argmin())
            if explained[other] <= mismatch[k][box][member].mean() + _UNDECIDED:
                joined[box][member] = other
    return joined


def _top_speed(motion: Motion, moving: Bool[np.ndarray, "h w"]) -> float:
    """The speed that hardly any of the pixels that move exceeds."""
    return float(np.quantile(motion.speed[moving], 0.95)) if moving.any() else np.inf


def _mismatch(sharp: MotionFrames, motion: Motion, noise: float) -> Float[np.ndarray, "h w"]:
    """How far the pictures along a motion differ from their mean near the key frame, in units of `noise`."""
    fields = (motion.velocity, motion.acceleration) if motion.moves else None
    sides = _sides(sharp.picture, sharp.after, fields, np.float32(noise))
    sides = ndimage.gaussian_filter(np.asarray(sides), (0, _SUPPORT, _SUPPORT))
    # A surface that is hidden later was in view before, or the other way round: mostly the better side counts.
    return 0.7 * sides.min(0) + 0.3 * sides.mean(0)


@jax.jit
def _sides(
    pictures: Float[Array, "n h w"],
    after: Float[Array, " n"],
    motion: tuple[Float[Array, "2 h w"], Float[Array, "2 h w"]] | None,
    noise: Float[Array, ""],
) -> Float[Array, "2 h w"]:
    """How far the pictures along a motion, velocity and acceleration or None at rest, differ from their mean near the
    key frame, before it and after it.

    Mean square in units of `noise`, cut off. Moments within 20 frames count less, for there all motions agree.
    """
    height, width = pictures.shape[1:]

    # Beside the nearest moment; those that hardly count are not looked up.
    near = jnp.exp(-0.5 * (after**2 - jnp.min(after**2)) / 6**2)
    numbers = jnp.arange(after.size)
    begin = jnp.min(jnp.where(near > _HARDLY, numbers, after.size))
    end = jnp.max(jnp.where(near > _HARDLY, numbers + 1, 0))

    def place(k: Array) -> tuple[Corner, Array] | None:
        return None if motion is None else along(after[k], *motion)

    def look(k: Array, placed: tuple[Corner, Array] | None) -> tuple[Array, Array]:
        if placed is None:  # nothing to look up
            return pictures[k], jnp.ones((height, width), pictures.dtype)
        return interpolated(pictures[k], placed[0]), placed[1]

    def average(k: Array, found: tuple[Array, Array], sums: tuple[Array, Array]) -> tuple[Array, Array]:
        value, inside = found
        return sums[0] + near[k] * inside * value, sums[1] + near[k] * inside

    nothing = jnp.zeros((height, width), jnp.float32)
    total, weight = in_turn(place, look, average, (nothing, nothing), begin, end)
    reference = total / jnp.maximum(weight, 1e-6)

    def compare(k: Array, found: tuple[Array, Array], sums: tuple[Array, Array]) -> tuple[Array, Array]:
        tau, (value, inside) = after[k], found
        side = jnp.stack([tau < 0, tau >= 0]).astype(jnp.float32)[:, None, None]
        side = side * jnp.minimum(jnp.abs(tau) / 20, 1) * inside[None]
        difference = jnp.minimum((value - reference) ** 2 / noise, _ENOUGH)
        return sums[0] + side * difference[None], sums[1] + side

    neither = jnp.zeros((2, height, width), jnp.float32)
    total, weight = in_turn(place, look, compare, (neither, neither), 0, after.size)
    # Out of view: nothing is known, neither for nor against.
    return jnp.where(weight > 0.5, total / jnp.maximum(weight, 1e-6), _ENOUGH / 2)


@jax.jit
def _look_up(
    picture: Float[Array, "h w"], member: Float[Array, "h w"], position: Float[Array, "n 2 rows columns"]
) -> list[Float[Array, "n rows columns"]]:
    return jax.lax.map(lambda q: [bilinear(field[None], q[0], q[1])[0] for field in (picture, member)], position)


def _depth(pictures: MotionFrames, layers: Layers, *, sparse: bool) -> Int[np.ndarray, " layers"]:
    """How many other layers each is in front of: where two come to lie on one pixel, which of them does it show?

    `sparse`: one row and column in two vote.
    """
    sharp, every = pictures.presmoothed(_SHARPNESS), 2 if sparse else 1
    number, some = len(layers.depth), slice(None, None, _EVERY)
    voting = np.asarray(sharp.picture)[some, ::every, ::every]
    after = np.asarray(sharp.after)
    near = (np.abs(after) <= 10).astype(np.float32)

    def seen(k: int) -> tuple[Float[np.ndarray, "n rows columns"], Bool[np.ndarray, "n rows columns"]]:
        """How far the layer is from what is shown, squared, and where it would be."""
        velocity, acceleration = layers.velocity[k], layers.acceleration[k]
        origin = inverse(velocity, acceleration, after[some], every=every)
        key_picture = drift(sharp.picture, after, near, (velocity, acceleration)).mean
        picture, member = map(np.asarray, _look_up(key_picture, (layers.label == k).astype(np.float32), origin))
        return (picture - voting) ** 2, member > 0.5

    shown, there = zip(*in_threads(seen, range(number)), strict=True)
    wins = np.zeros(number, np.int32)
    for front in range(number):
        for back in range(number):
            if front != back:
                conflict = there[front] & there[back]
                # Cut off, so that many pixels decide and not a few bright ones.
                votes = np.clip(shown[back][conflict] - shown[front][conflict], -0.02, 0.02).sum()
                wins[front] += int(votes > 0)
    return wins
