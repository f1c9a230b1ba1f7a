"""Layers: several surfaces, each with a motion of its own, one in front of another.

At the edge of something that moves, a velocity for each pixel is not enough: it blends the two motions, and does not
decide which surface hides which. Here the scene is decomposed into layers. Each has a smooth motion over the whole
picture (affine with acceleration, or the dense estimate where nothing simpler serves), and a label names the layer that
the key frame shows at a pixel. What a sensor pixel sees at another time then follows: of the layers whose point comes
to lie there, and that the key frame shows at that point, the nearest one. If there is none, the surface was hidden in
the key frame, and the sample has to be left out.
"""

from collections.abc import Callable
from functools import partial
from typing import cast

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from scsr_opt._kernels.device import on_device
from scsr_opt._threads import in_threads
from scsr_opt.motion.estimators.evidence import contradicted, typical_noise, variance_along
from scsr_opt.motion.estimators.frames import MotionFrames, drift_of, picture_along, smoothed
from scsr_opt.motion.estimators.parametric import generators, parametric
from scsr_opt.motion.estimators.settings import LayerSettings
from scsr_opt.motion.inversion import inverse, read_picture
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.trajectory import Layers, Motion


def layered(
    pictures: MotionFrames,
    background: Motion,
    everywhere: Motion,
    moving: Bool[np.ndarray, "h w"],
    total: int,
    *,
    simple_motion: bool,
    sparse: bool,
    settings: MotionSettings = DEFAULTS,
) -> list[Callable[[], Motion]]:
    """The scene as layers: `background`, further affine motions where that is contradicted, and the dense estimate
    `everywhere` where these do not explain enough.

    **Arguments:**
    - `moving`: pixels that contradict `background`.
    - `total`: sensor pixels, of which the pictures may be a part; all others are background.
    - `simple_motion`: whether a region that its first fit explains is fitted no further, and fits begin with some of
      their points.
    - `sparse`: whether a sparse grid of pixels decides which layer is in front and whether the last fit is better, and
      the last fit begins with some of its points.

    **Returns:** functions that make motions to choose from, with `layers`, or `background` alone if nothing else was
    found. Along the edges of something that moves, the dense estimate takes the background that is uncovered for
    another surface; so the first motion is without it, where that is possible.
    """
    options = settings.layers
    # Speeds at which pixels are not observable are not taken, either.
    fastest = options.top_speed_ratio * _top_speed(everywhere, moving, options)
    motions = _layer_motions(
        pictures, background, everywhere, moving, fastest, total, simple_motion=simple_motion, settings=settings
    )
    noise = typical_noise(pictures, everywhere, options.presmoothing_px)
    number = len(motions)
    first = number - 1 if number > 2 and motions[-1] is everywhere else number

    def mismatch(motion: Motion) -> Float[np.ndarray, "h w"]:
        too_fast = settings.comparison.residual_cap * (motion.speed > fastest)
        return _mismatch(pictures, motion, noise, settings) + too_fast

    mismatches = in_threads(mismatch, motions[:first])

    def made(some: int) -> Motion:
        of_some = mismatches + [mismatch(motion) for motion in motions[first:some]]
        return _layers(pictures, motions[:some], of_some, everywhere, sparse=sparse, settings=settings)

    return [partial(made, some) for some in range(first, number + 1)]


def relabelled(pictures: MotionFrames, motion: Motion, settings: MotionSettings = DEFAULTS) -> Motion:
    """A motion with layers, whose labels are found again on these pictures; motions and depths of the layers are kept.
    A motion without layers is returned as it is."""
    layers = motion.layers
    if layers is None:
        return motion
    each = [
        Motion(velocity, acceleration, motion.confidence)
        for velocity, acceleration in zip(layers.velocity, layers.acceleration, strict=True)
    ]
    noise = typical_noise(pictures, motion, settings.layers.presmoothing_px)
    label = _labels([_mismatch(pictures, one, noise, settings) for one in each], settings).astype(np.int32)
    return Motion.of_layers(eqx.tree_at(lambda found: found.label, layers, label), motion.confidence)


def _layers(
    pictures: MotionFrames,
    motions: list[Motion],
    mismatches: list[Float[np.ndarray, "h w"]],
    everywhere: Motion,
    *,
    sparse: bool,
    settings: MotionSettings,
) -> Motion:
    """Layers with these motions, of which the first is the background, and the confidence of `everywhere`; a single
    motion if no second one keeps enough pixels."""
    background, least = motions[0], settings.layers.least_pixels
    while True:  # a layer of too few pixels is removed, and its pixels are labelled again
        if len(motions) == 1:
            return motions[0]
        label = _labels(mismatches, settings)
        sizes = np.bincount(label.ravel(), minlength=len(motions))
        if sizes.min() >= least:
            break
        kept = np.flatnonzero(sizes >= least) if sizes.max() >= least else [0]
        motions, mismatches = [motions[k] for k in kept], [mismatches[k] for k in kept]

    def refitted(k: int) -> Motion:
        if motions[k] is background or motions[k] is everywhere:
            return motions[k]
        return _refitted_inside(pictures, motions[k], np.asarray(label == k), sparse=sparse, settings=settings)

    motions = in_threads(refitted, range(len(motions)))
    layers = Layers(
        velocity=np.stack([motion.velocity for motion in motions]),
        acceleration=np.stack([motion.acceleration for motion in motions]),
        label=label.astype(np.int32),
        depth=np.zeros(len(motions), np.int32),
    )
    depth = _depth(pictures, layers, sparse=sparse, settings=settings)
    return Motion.of_layers(eqx.tree_at(lambda found: found.depth, layers, depth), everywhere.confidence)


def _layer_motions(
    pictures: MotionFrames,
    background: Motion,
    everywhere: Motion,
    moving: Bool[np.ndarray, "h w"],
    fastest: float,
    total: int,
    *,
    simple_motion: bool,
    settings: MotionSettings,
) -> list[Motion]:
    """The motions of the layers, the background first: the largest region that contradicts all motions so far is given
    one of its own, again and again."""
    options = settings.layers

    def judge(candidate: Callable[[], Motion]) -> tuple[Motion, Bool[np.ndarray, "h w"]]:
        motion = candidate()
        return motion, contradicted(pictures, motion, settings) | (motion.speed > fastest)

    motions = [background]
    tried, unexplained = np.zeros_like(moving), moving
    for _ in range(options.most_layers):
        left = unexplained & ~tried
        regions, number = _regions(left, options.closing_px)
        if number == 0:
            break
        sizes = np.bincount(regions[left].ravel(), minlength=number + 1)[1:]
        region = (regions == 1 + sizes.argmax()) & ~tried
        if sizes.max() < options.least_pixels:
            break
        # The region includes the background that the surface uncovers, and in dim light a fit to the pictures may
        # fail. So fits compete with the commonest velocities of the dense estimate, and the motion that the fewest
        # pixels contradict is taken, or the first of those that are about as good.
        candidates = _candidates(pictures, everywhere, region, sparse=simple_motion, settings=settings)
        judged = in_threads(judge, candidates[:1] if simple_motion else candidates)
        if simple_motion and (region & judged[0][1]).sum() > options.fit_contradicting_share * region.sum():
            judged += in_threads(judge, candidates[1:])
        fits, wrong = zip(*judged, strict=True)
        against = np.array([(region & here).sum() for here in wrong])
        best = int(np.argmax(against <= options.equivalent_ratio * against.min()))
        explained = region & ~wrong[best]
        if explained.sum() > options.explained_share * region.sum():
            motions.append(fits[best])
            unexplained = unexplained & wrong[best]
        tried = tried | region
    if len(motions) == 1 or unexplained.sum() > options.dense_share * total:
        motions.append(everywhere)
    return motions


def _regions(mask: Bool[np.ndarray, "h w"], gap: int) -> tuple[Int[np.ndarray, "h w"], int]:
    """Connected regions of a mask without its single pixels, numbered from 1, and how many there are; parts less than
    twice `gap` sensor pixels apart are one region."""
    some = ndimage.binary_opening(mask)
    wide = cast(np.ndarray, ndimage.binary_closing(np.pad(some, gap), iterations=gap))  # padded: whole at the edges
    inner = slice(gap, -gap) if gap else slice(None)
    return cast(tuple[np.ndarray, int], ndimage.label(wide[inner, inner]))


def _robust_affine_fit(motion: Motion, region: Bool[np.ndarray, "h w"], settings: MotionSettings) -> Motion:
    """The affine velocity that most of a region's velocities are near to, by iteratively reweighted least squares."""
    options, scale = settings.layers, settings.parametric.outlier_scale
    height, width = region.shape
    fields = generators(np.mgrid[0:height, 0:width].astype(np.float32), height, width)[:6]
    places = np.flatnonzero(region)
    some = np.unravel_index(places[:: max(1, places.size // options.fitted_pixels)], region.shape)
    here, found = fields[:, :, *some].reshape(6, -1).T, motion.velocity[:, *some].reshape(-1)
    trust = np.tile(motion.confidence[some] + 1e-3, 2)
    weight, numbers = trust, np.zeros(6, np.float32)
    for _ in range(options.affine_steps):
        weighted = here * weight[:, None]
        damping = 1e-6 * np.eye(6, dtype=np.float32) * weight.sum()
        numbers = np.linalg.solve(weighted.T @ here + damping, weighted.T @ found)
        distance = (found - here @ numbers) ** 2
        usual = np.quantile(distance, options.affine_agreeing_share) + 1e-8
        weight = trust / (1 + distance / (scale * usual)) ** 2
    return Motion.of_velocity(np.einsum("p,pchw->chw", numbers, fields))


def _candidates(
    pictures: MotionFrames,
    everywhere: Motion,
    region: Bool[np.ndarray, "h w"],
    *,
    sparse: bool,
    settings: MotionSettings,
) -> list[Callable[[], Motion]]:
    """Functions that make motions for a region, in order of preference where they serve equally well."""
    commonest = _commonest_velocities(everywhere, region, settings.layers)

    def fitted(start: Motion) -> Motion:
        return parametric(pictures, start=start, where=region, sparse=sparse, settings=settings)

    fits = [lambda: fitted(commonest[0]), lambda: fitted(_robust_affine_fit(everywhere, region, settings))]
    return [*fits, *(lambda motion=motion: motion for motion in commonest)]


def _commonest_velocities(motion: Motion, region: Bool[np.ndarray, "h w"], settings: LayerSettings) -> list[Motion]:
    """Constant motions with the modes of a region's velocities, weighted by confidence: a mean would mix right and
    wrong velocities."""
    width = settings.mode_width
    places = np.flatnonzero(region)
    places = np.unravel_index(places[:: max(1, places.size // settings.voting_pixels)], region.shape)
    some, weight = motion.velocity[:, *places].T, motion.confidence[places] + 1e-3
    # Rows and columns apart: a sum over two of each pair took ten times as long.
    down, right = ((of[:, None] - of) ** 2 for of in some.T)
    distance = down + right
    votes = np.exp(-0.5 * distance / width**2) @ weight
    found = []
    for _ in range(settings.velocity_modes):
        best = int(votes.argmax())
        found.append(Motion.of_velocity(np.broadcast_to(some[best][:, None, None], motion.velocity.shape)))
        votes = np.where(distance[best] < (3 * width) ** 2, 0, votes)
        if not votes.any():
            break
    return found


def _refitted_inside(
    pictures: MotionFrames,
    motion: Motion,
    member: Bool[np.ndarray, "h w"],
    *,
    sparse: bool,
    settings: MotionSettings,
) -> Motion:
    """The motion fitted once more, to the inside of its layer, whose edge shows some of the next layer; the one of the
    two along which pictures vary less there."""
    options = settings.layers
    inside = cast(np.ndarray, ndimage.binary_erosion(member, iterations=options.edge_px))
    if inside.sum() < options.least_pixels:
        return motion
    found = parametric(pictures, start=motion, where=inside, fitted=True, sparse=sparse, settings=settings)
    # Fewer pixels may determine the motion less well.
    every = settings.comparison.sparse_step if sparse else 1
    inside = inside[::every, ::every]

    def variance(one: Motion) -> float:
        of = variance_along(pictures, one, settings.comparison.presmoothing_px, every=every)
        return float(of[inside].mean())

    before, after = in_threads(variance, (motion, found))
    return found if after < before else motion


def _labels(mismatches: list[Float[np.ndarray, "h w"]], settings: MotionSettings) -> Int[np.ndarray, "h w"]:
    """The layer of each key-frame pixel: that of least mismatch, regularised by its neighbours' layers."""
    mismatch, options = np.stack(mismatches), settings.layers
    return _islands_merged(
        _regularised_labels(mismatch, settings.comparison.neighbourhood_px, options), mismatch, options
    )


def _regularised_labels(
    mismatch: Float[np.ndarray, "layers h w"], neighbourhood: float, settings: LayerSettings
) -> Int[np.ndarray, "h w"]:
    """Labels of least mismatch minus what agreement with the neighbourhood gains, by iterated conditional modes (Besag,
    1986)."""
    numbers = np.arange(len(mismatch))[:, None, None]
    cost = mismatch + np.float32(settings.order_penalty) * numbers.astype(mismatch.dtype)
    label = cost.argmin(0)
    for _ in range(settings.most_label_turns):
        around = smoothed((label == numbers).astype(cost.dtype), neighbourhood)
        before, label = label, (cost - np.float32(settings.neighbour_gain) * around).argmin(0)
        if np.array_equal(label, before):
            break
    return label.astype(np.int32)


def _islands_merged(
    label: Int[np.ndarray, "h w"], mismatch: Float[np.ndarray, "layers h w"], settings: LayerSettings
) -> Int[np.ndarray, "h w"]:
    """Labels in which each part of a layer but its largest takes the layer around it, where that has about as little
    mismatch: a surface without texture matches any motion, and its surroundings decide."""
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
            explained[around < settings.border_share * edge.sum()] = np.inf
            other = int(explained.argmin())
            if explained[other] <= mismatch[k][box][member].mean() + settings.undecided_mismatch:
                joined[box][member] = other
    return joined


def _top_speed(motion: Motion, moving: Bool[np.ndarray, "h w"], settings: LayerSettings) -> float:
    """The speed, sensor pixels per frame, that hardly any of the moving pixels exceeds."""
    return float(np.quantile(motion.speed[moving], settings.top_speed_quantile)) if moving.any() else np.inf


def _mismatch(
    pictures: MotionFrames, motion: Motion, noise: float, settings: MotionSettings
) -> Float[np.ndarray, "h w"]:
    """Mean squared difference of the pictures along a motion from the key frame's, in units of the variance `noise`."""
    options, cap = settings.layers, settings.comparison.residual_cap
    fields = (motion.velocity, motion.acceleration) if motion.moves else None
    sides = _mismatch_of_sides(pictures, fields, noise, cap, options)
    sides = ndimage.gaussian_filter(sides, (0, options.support_px, options.support_px))
    better = options.better_side_weight
    return better * sides.min(0) + (1 - better) * sides.mean(0)


def _mismatch_of_sides(
    pictures: MotionFrames,
    motion: tuple[Float[np.ndarray, "2 h w"], Float[np.ndarray, "2 h w"]] | None,
    noise: float,
    cap: float,
    settings: LayerSettings,
) -> Float[np.ndarray, "2 h w"]:
    """Mean squared difference of the pictures from their mean near the key frame, for times before it and after it, in
    units of `noise`, each at most `cap`.

    `motion`: velocity and acceleration, or None at rest. Moments near the key frame count less, as all motions agree
    there.
    """
    sharp, after = np.asarray(pictures.presmoothed(settings.presmoothing_px)), np.asarray(pictures.after)
    ones = np.ones(sharp.shape[1:], np.float32)
    fields = None if motion is None else (on_device(motion[0]), on_device(motion[1]))
    shown = [
        (picture, ones) if fields is None else tuple(map(np.asarray, picture_along(picture, tau, *fields)))
        for picture, tau in zip(sharp, after, strict=True)
    ]
    # Relative to the weight of the nearest moment; moments of hardly any weight are left out.
    near = np.exp(-0.5 * (after**2 - np.min(after**2)) / settings.key_picture_frames**2).astype(np.float32)
    total, weight = np.zeros_like(ones), np.zeros_like(ones)
    for share, (value, inside) in zip(near, shown, strict=True):
        if share > settings.least_weight:
            total += share * inside * value
            weight += share * inside
    reference = total / np.maximum(weight, np.float32(1e-6))
    totals, weights = (np.zeros((2, *ones.shape), np.float32) for _ in range(2))
    for tau, (value, inside) in zip(after, shown, strict=True):
        side, part = int(tau >= 0), np.float32(min(abs(tau) / settings.late_frames, 1)) * inside
        totals[side] += part * np.minimum((value - reference) ** 2 / np.float32(noise), np.float32(cap))
        weights[side] += part
    # Out of view nothing speaks for or against the motion: half of the cap.
    return np.where(weights > 0.5, totals / np.maximum(weights, np.float32(1e-6)), np.float32(cap / 2))


def _depth(
    pictures: MotionFrames, layers: Layers, *, sparse: bool, settings: MotionSettings
) -> Int[np.ndarray, " layers"]:
    """The number of other layers that each one is in front of: where two of them come to lie on one pixel, the pixel
    votes for the one that looks more like what it shows. `sparse`: only a sparse grid of pixels votes."""
    by, cap = settings.comparison, settings.layers.vote_cap
    sharp, every = pictures.presmoothed(settings.layers.presmoothing_px), by.sparse_step if sparse else 1
    number, some = len(layers.depth), slice(None, None, by.picture_step)
    voting = np.asarray(sharp)[some, ::every, ::every]
    after = np.asarray(pictures.after)
    near = np.abs(after) <= by.key_picture_frames

    def compared(k: int) -> tuple[Float[np.ndarray, "n rows columns"], Bool[np.ndarray, "n rows columns"]]:
        """Squared difference of a layer from the pictures, and the pixels on which it comes to lie."""
        velocity, acceleration = layers.velocity[k], layers.acceleration[k]
        origin = inverse(velocity, acceleration, after[some], every=every, settings=settings.trajectory)
        key_picture = drift_of(sharp, after, (velocity, acceleration), near).mean
        of_layer = (layers.label == k).astype(np.float32)
        picture, member = (
            np.stack([np.asarray(read_picture(of, *at)) for at in np.asarray(origin)]) for of in (key_picture, of_layer)
        )
        return (picture - voting) ** 2, member > 0.5

    difference, there = zip(*in_threads(compared, range(number)), strict=True)
    wins = np.zeros(number, np.int32)
    for front in range(number):
        for back in range(number):
            if front != back:
                conflict = there[front] & there[back]
                votes = np.clip(difference[back][conflict] - difference[front][conflict], -cap, cap).sum()
                wins[front] += int(votes > 0)
    return wins
