"""Which motion a recording shows: none, one for the whole scene, one for each layer, or one for each pixel."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped
from scipy import ndimage
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import ConvexHull, QhullError

from scsr_opt._arrays import as_array
from scsr_opt._kernels.programs import ready
from scsr_opt._threads import in_threads
from scsr_opt.camera.recording import USUAL_FRAMES, WHITE_RATE, Recording, bad_pixels_of
from scsr_opt.motion.estimators.base import Estimator
from scsr_opt.motion.estimators.dense import accelerated, dense
from scsr_opt.motion.estimators.evidence import (
    TOLERATED_AT_REST,
    Missed,
    at_rest,
    contradicted,
    counts_agree,
    heard,
    missed,
    typical_noise,
)
from scsr_opt.motion.estimators.frames import MotionFrames, filled, smooth, stretches
from scsr_opt.motion.estimators.layered import layered, relabelled
from scsr_opt.motion.estimators.parametric import moves_as_one, parametric
from scsr_opt.motion.estimators.phase import PhaseCorrelation
from scsr_opt.motion.propagation import carry
from scsr_opt.motion.reliability import trusted
from scsr_opt.motion.trajectory import Motion

# The share of the pixels that may contradict one motion for all before a richer one is tried.
_TOLERATED_GLOBAL = 0.01
# The share of the sensor that has to be certainly at rest, single pixels aside, for that to rule out one motion for
# all. Slow pans, by half a sensor pixel to one and a half over the recording, had up to 0.03 by mistake; scenes with an
# object before a background have 0.16 and more.
_RESTING = 0.05
# Where the key frame is farther from the middle of the pictures than this share of half their span, it lies at one end.
# What is found in the middle of the recording then counts if no more than this share of the pixels contradict it of
# those that contradict what is found from there.
_ASIDE, _FEWER = 0.8, 0.75
# The share of the pixels that has to be heard for silence to count as agreement.
_HEARD = 0.5
# What must be left of what contradicted the background, or of what it missed of the pictures around there, at most, for
# anything richer to be believed.
_HELPS = 0.8
# What it must miss of them in any case, beside what the background misses: more numbers always fit a little better.
_PREDICTS = 0.97
# Where so large a share of the sensor contradicted the background, predicting better at all is enough: a clip of leaves
# in the wind, 38 % of which contradicted rest and 0.1 % the dense estimate, was predicted 2 % better by it.
_MUCH = 0.1
# Layers know of edges and of what is hidden, which the dense estimate does not. They are not believed where labels are
# so scattered that most pixels lie near an edge between them (within so many pixels): in 6 of 22 scenes, where the
# dense estimate then was up to 3 dB better.
_EDGE = 3
_SCATTERED = 0.5
# Nor where they predict the recording worse than it, by more than this factor.
_WORSE = 1.01
# Layers are enough without the dense estimate as one more where they predict the recording better than it by so much.
_CLEARLY = 0.95
# What moves apart from the background is looked for on the rows and columns where something does, with a margin (sensor
# pixels; the widest window of the dense estimate has a reach of 18), in steps that let compiled code be met again; if
# they make up no more than this share of the sensor.
_MARGIN, _STEP, _WORTH = 24, 16, 0.85
# Where work is skipped and the pictures have so many pixels, motions are compared on a sparse grid of them. It told the
# mean mismatch to 0.3 % on a car (400×250 pixels), and to 2 % on pictures of 60×60, where that decided between two
# and three layers (0.2 dB) and took the one behind for the one in front.
_MANY = 10_000


# Pixels that tell the light of a moment: those of so large a share of the mean intensity, about so many of them.
_LIT, _LOOKED_AT = 0.1, 4000
# How much it has to change within the recording for the pictures to be looked at without it, and the share of what
# contradicted rest that may do so then, if the scene rests: 0.02 at most where lamps flickered by 10 to 30 %, and half
# or more of pans and turns in which the light seems to change, by up to 12 % (docs/measurements.md).
_FLICKER, _LEFT = 0.02, 0.05

# Bad pixels are heard where so large a share of those around them is good, by a Gaussian of so many sensor pixels.
_FILLED_FROM, _FILLED_SHARE = 2.0, 0.2


class Still(Estimator):
    """Nothing moves."""

    def __call__(self, pictures: MotionFrames) -> Motion:
        return Motion.none(*pictures.picture.shape[1:])


class Global(Estimator):
    """One motion for the whole scene (`together`): a translation, affine or perspective motion (a homography), as far
    as the recording asks for it, with acceleration; or a translation only."""

    affine: bool = True

    def __call__(self, pictures: MotionFrames) -> Motion:
        return together(pictures, affine=self.affine)[0]


class Dense(Estimator):
    """A velocity (`dense`) and an acceleration (`accelerated`) for each pixel; no edges, no occlusion.

    **Fields:** `acceleration`: False leaves it out; each pixel keeps its velocity.
    """

    acceleration: bool = True

    def __call__(self, pictures: MotionFrames) -> Motion:
        straight = dense(pictures)
        return accelerated(pictures, straight) if self.acceleration else straight


class Automatic(Estimator):
    """The simplest motion that the recording does not contradict: none, one motion for all, or layers. A scene whose
    light flickers as a whole is one in which nothing moves.

    Few numbers are estimated far better than many, so the richer ones are used only where they are needed. Where the
    key frame lies at one end of the recording, what moves apart is looked for from its middle as well.

    **Fields:** `skip`: richer ones are not even tried where a simpler one serves, and what moves apart from the
    background is looked for around the pixels that contradict the background only. Otherwise all are estimated for the
    whole sensor before one is chosen, by the same rules.
    """

    skip: bool = True

    def __call__(self, pictures: MotionFrames) -> Motion:
        first, last = np.asarray(pictures.after)[[0, -1]].tolist()
        middle = (first + last) / 2
        found, simple = self._chosen(pictures)
        if simple or abs(middle) <= _ASIDE * (last - first) / 2:
            return found
        # From one end what moves is seen only to leave, or to come, and most of what it passes is hidden. So it is
        # looked for in the middle, too, and followed to the key frame.
        other = relabelled(pictures, carry(self._chosen(pictures.from_moment(middle))[0], -middle))
        against, against_other = (contradicted(pictures, motion).sum() for motion in (found, other))
        return other if against_other < _FEWER * against else found

    def _chosen(self, pictures: MotionFrames) -> tuple[Motion, bool]:
        """The motion, and whether it is none or one for all."""
        still = Motion.none(*pictures.picture.shape[1:])
        moving, resting = at_rest(pictures)
        rests = bool(moving.mean() <= TOLERATED_AT_REST) and not moves_as_one(pictures)
        rests = rests or _flickers(pictures, moving.mean())
        if self.skip and rests:
            return still, True
        several = _takes_several(resting, moving)
        if self.skip and several:
            whole, left = still, moving
        else:
            whole, left = together(pictures)
        # Where most pixels fire too seldom to contradict a motion, their silence says nothing. (Of a dim clip a fit was
        # wrong by two pixels per frame, at which hardly any was heard.)
        silent = heard(pictures, whole).mean() < _HEARD
        possible = not several and (not silent or counts_agree(pictures, whole))
        serves = possible and bool(left.mean() <= _TOLERATED_GLOBAL)
        if self.skip and serves:
            return whole, True
        of_whole = possible and bool(left.mean() < moving.mean() / 2)
        background, unexplained = (whole, left) if of_whole else (still, moving)
        richer = _apart(pictures, background, unexplained, self.skip)
        return (still, True) if rests else (whole, True) if serves else (richer, False)


def _flickers(pictures: MotionFrames, contradicting: float) -> bool:
    """Does so large a share of the pixels contradict rest because the light changes? Lamps flicker at 100 Hz, by a few
    percent within 100 frames, and what gets brighter as a whole looks to each window as if it moved."""
    even = _evenly_lit(pictures)
    if even is None:
        return False
    left = at_rest(even)[0].mean()
    return bool(left <= min(_TOLERATED_GLOBAL, _LEFT * contradicting)) and not moves_as_one(even)


def _evenly_lit(pictures: MotionFrames) -> MotionFrames | None:
    """The pictures, intensity, divided by the light of their moment, the median ratio of their pixels to the mean
    picture; None where it hardly changes (`_FLICKER`). Where something moves the median may follow that, so that
    nothing but rest is to be asked of them."""
    shown = np.asarray(pictures.picture)
    mean = shown.mean(0)
    some = np.argwhere(mean > _LIT * mean.mean())
    some = tuple(some[:: max(1, len(some) // _LOOKED_AT)].T)
    if not some[0].size:
        return None
    light = np.median(shown[:, *some] / mean[some], axis=1)
    if np.ptp(light) <= _FLICKER * np.median(light):  # nor where there is none
        return None
    light = np.maximum(light, _LIT * light.max())
    return MotionFrames(pictures.picture / jnp.asarray(light)[:, None, None], pictures.after, pictures.firing)


def _takes_several(rests: Bool[np.ndarray, "h w"], moving: Bool[np.ndarray, "h w"]) -> bool:
    """Do most of the moving pixels lie between or near pixels that are at rest?

    A component of an affine motion that is at most ε at some points is at most ε between them, and at most 3ε as far
    outside as they are wide, about their middle. So no such motion explains both, and none has to be fitted. Where
    less than `_RESTING` of the sensor rests, it may be by mistake.
    """
    rests = cast(np.ndarray, ndimage.binary_opening(rests, iterations=2))  # single pixels may be wrong
    places = np.argwhere(rests)
    if not moving.any() or len(places) < max(3, _RESTING * rests.size) or (np.ptp(places, axis=0) == 0).any():
        return False
    try:
        sides = ConvexHull(places).equations
    except QhullError:  # all in one line
        return False
    # Towards the middle by half: what was twice as far out is then on the edge.
    middle = places.mean(0)
    nearer = middle + (np.argwhere(moving) - middle) / 2
    return bool((nearer @ sides[:, :2].T + sides[:, 2] < 0).all(1).mean() > 0.5)


def _apart(pictures: MotionFrames, background: Motion, unexplained: Bool[np.ndarray, "h w"], skip: bool) -> Motion:
    """What moves apart from the background, as layers or pixel by pixel; the background, if neither explains more."""
    box, everything = _box(unexplained), (slice(None), slice(None))
    used, judged_on = (box, everything) if skip else (everything, box)
    part, before, total = pictures.part(*used), background.part(*used), unexplained.size
    everywhere = dense(part, start=before)
    noise = typical_noise(part, everywhere)

    sparse = skip and everywhere.speed.size >= _MANY

    def predicts(motion: Motion) -> Missed:
        return missed(part, motion, noise, sparse=sparse).part(*judged_on)

    # An object that does not accelerate lost 0.9 dB by the freedom to; where something does, one turn shows it.
    with ThreadPoolExecutor(1) as beside:
        straight, resting = (beside.submit(predicts, motion) for motion in (everywhere, before))
        curved = accelerated(part, everywhere, start=before, turns=1)
        by_curved, by_pixel, by_background = predicts(curved), straight.result(), resting.result()
    if by_curved.mean < _PREDICTS * by_pixel.mean:
        everywhere = accelerated(part, curved, start=before, turns=2)
        by_pixel = predicts(everywhere)

    def judged(make: Callable[[], Motion]) -> tuple[Motion, Missed, bool]:
        motion = make()
        miss, layers = predicts(motion), motion.layers
        return motion, miss, layers is not None and _serve(layers.label[judged_on], miss, by_pixel, total)

    makers = layered(part, before, everywhere, unexplained[used], total, skip=skip, sparse=sparse)
    candidates = in_threads(judged, makers[:1] if skip else makers)
    _, by_first, serves = candidates[0]
    if serves and by_first.mean < _CLEARLY * by_pixel.mean:
        candidates = candidates[:1]
    elif skip:
        candidates += in_threads(judged, makers[1:])
    serving = [(motion, miss) for motion, miss, serves in candidates if serves]
    # Where no layers were found, the background is all that is left of them.
    is_layered = any(motion.layers is not None for motion, *_ in candidates)
    otherwise = [(everywhere, by_pixel)] if is_layered else [(motion, miss) for motion, miss, _ in candidates]
    motion, miss = min(serving or otherwise, key=lambda one: one[1].mean)
    # A recording of noise contradicts any motion: then more of it explains nothing, or predicts nothing. What is hidden
    # for a while contradicts any motion, too, but all else is predicted.
    at_first, enough = by_background.mean, 1.0 if unexplained.mean() >= _MUCH else _PREDICTS
    better = miss.mean < enough * at_first
    if better and miss.mean >= _HELPS * at_first:
        better = contradicted(part, motion)[judged_on].sum() < _HELPS * unexplained[box].sum()
    if better and motion is everywhere:  # in dim light predictions do not tell, and chance is taken off anyway
        motion = accelerated(part, motion, start=before)
    return motion.within(background, *used) if better else background


def _box(mask: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """The rows and columns of a mask, with a margin; all, where little would be left out."""
    sides = []
    for axis, length in enumerate(mask.shape):
        some = np.flatnonzero(mask.any(1 - axis))
        begin, end = (int(some[0]), int(some[-1]) + 1) if some.size else (0, length)
        begin = max(begin - _MARGIN, 0) // _STEP * _STEP
        end = min(-(-(end + _MARGIN) // _STEP) * _STEP, length)
        sides.append(slice(begin, end))
    area = np.prod([side.stop - side.start for side in sides])
    return (sides[0], sides[1]) if area <= _WORTH * mask.size else (slice(None), slice(None))


def _serve(label: Int[np.ndarray, "h w"], by_layers: Missed, by_pixel: Missed, total: int) -> bool:
    """Do the layers predict the recording as well as the dense estimate does, where they say that something is seen?

    `total`: sensor pixels; those beyond the pictures show the background alone.
    """
    inner = maximum_filter(label, 2 * _EDGE + 1) == minimum_filter(label, 2 * _EDGE + 1)
    if inner.sum() + total - inner.size < _SCATTERED * total:
        return False
    both = (by_layers.seen > 0.5) & (by_pixel.seen > 0.5)
    return bool(by_layers.error[both].mean() <= _WORSE * by_pixel.error[both].mean())


def together(pictures: MotionFrames, *, affine: bool = True) -> tuple[Motion, Bool[np.ndarray, "h w"]]:
    """One motion for the whole scene (`parametric`), and the pixels that contradict it.

    Where that is too much, phase correlation gives another start, if it is itself contradicted by fewer. In dim light
    near times, by which the fit begins, show nothing: at 0.12 spikes per frame of white it missed 0.3 px per frame by
    0.27 from rest, by 0.03 from there.
    """
    motion = parametric(pictures, affine=affine)
    left = _left(pictures, motion)
    start = PhaseCorrelation()(pictures) if left.mean() > _TOLERATED_GLOBAL else None
    if start is not None and _left(pictures, start).mean() < left.mean():
        other = parametric(pictures, affine=affine, start=start)
        left_then = _left(pictures, other)
        if left_then.mean() < left.mean():
            return other, left_then
    return motion, left


def _left(pictures: MotionFrames, motion: Motion) -> Bool[np.ndarray, "h w"]:
    """The pixels that contradict a motion of the whole scene; all, if it carries most out of view, where nothing can
    contradict it, and what is left does not speak for it."""
    longest = float(jnp.max(jnp.abs(pictures.after)))
    leaves = np.abs(np.median(motion.velocity, axis=(1, 2))) * longest > 0.5 * np.array(pictures.picture.shape[1:])
    if leaves.any() and not counts_agree(pictures, motion):
        return np.ones(motion.speed.shape, bool)
    return contradicted(pictures, motion)


def estimate_motion(
    spikes: Shaped[np.ndarray, "T h w"] | Recording,
    *,
    key: int | None = None,
    white_rate: float | int | None = None,
    estimator: Estimator | None = None,
    bad_pixels: np.ndarray | None = None,
    gain: Float[np.ndarray, "h w"] | None = None,
) -> Motion:
    """The motion around a key frame, with its trust.

    **Arguments:**
    - `spikes`: (T, h, w) of 0 and 1, of which all frames are used, or a `Recording`, of which the 101 frames around the
      key frame are used, with its white rate and bad pixels.
    - `key`: the key frame; the middle one if None.
    - `white_rate`: spikes per frame of a pixel at intensity 1; the recording's, or 0.6, if None.
    - `estimator`: `Automatic` if None.
    - `bad_pixels`: (h, w), filled from their neighbours before anything is compared.
    - `gain`: (h, w), by which measurements are divided: a fixed pattern rests whatever moves. 1 if None.

    **Returns:** the `Motion`; none for fewer than three frames, or a single row or column.

    **Raises:** `InputError` for arrays that cannot be read, and a key frame that is not in the recording.
    """
    bad, gains = (
        None if value is None else as_array(value, name) for name, value in (("bad_pixels", bad_pixels), ("gain", gain))
    )
    if isinstance(spikes, Recording):
        start, stop = spikes.around(key, USUAL_FRAMES)
        middle = spikes.frames // 2 if key is None else key
        rate = spikes.white_rate if white_rate is None else white_rate
        bad = bad_pixels_of(spikes, bad)
        frames, key = spikes.window(start, stop), middle - start
    else:
        frames = as_array(spikes, "The array of spikes")
        key, rate = len(frames) // 2 if key is None else key, WHITE_RATE if white_rate is None else white_rate
    pictures = comparable(frames, key=key, white_rate=rate, bad_pixels=bad, gain=gains)
    if pictures is None:
        return Motion.none(*frames.shape[1:])
    # Arrays of the caller's own, which can be written to.
    return jax.tree.map(np.array, motion_in(pictures, estimator))


def motion_in(pictures: MotionFrames, estimator: Estimator | None = None) -> Motion:
    """The motion (h, w) that these pictures (`comparable`) show by `estimator`, `Automatic` if not given, with its
    trust."""
    ready()
    motion = (Automatic() if estimator is None else estimator)(pictures)
    return trusted(pictures, motion)


def comparable(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    key: int,
    white_rate: float | int,
    bad_pixels: np.ndarray | None,
    gain: Float[np.ndarray, "h w"] | None,
) -> MotionFrames | None:
    """The recording as pictures (`stretches`) in which what differs has moved: over the gains, bad pixels filled. None
    where no motion can be seen, in fewer than three frames or a single row or column."""
    ready()
    frames, height, width = spikes.shape
    if frames < 3 or min(height, width) < 2:
        return None
    found = stretches(spikes, key=key, white_rate=white_rate)
    picture, firing, counted = found.picture, found.firing, found.counted
    assert firing is not None and counted is not None  # by `stretches`
    good = None if bad_pixels is None or not bad_pixels.any() else ~bad_pixels

    def mended(of: Float[Array, "n h w"]) -> Float[Array, "n h w"]:
        over = of if gain is None else of / jnp.asarray(gain, jnp.float32)[None]
        return over if good is None else filled(over, good)

    if good is not None:
        # Where there are no good pixels around, nothing is heard: what is filled in there does not move.
        some = smooth(jnp.asarray(good, firing.dtype), jnp.asarray(_FILLED_FROM)) > _FILLED_SHARE
        firing = jnp.where(some, filled(firing[None], good)[0], 0)
    return MotionFrames(mended(picture), found.after, firing, lambda: mended(counted()))
