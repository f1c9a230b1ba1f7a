"""Choice of the motion that a recording shows: none, one for the scene, one for each layer, or one for each pixel."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped
from scipy import ndimage
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import ConvexHull, QhullError

from scsr_opt._arrays import as_array
from scsr_opt._kernels.device import on_device
from scsr_opt._kernels.programs import ready
from scsr_opt._threads import in_threads
from scsr_opt._validation import check_type, pixel_gain, whole
from scsr_opt.camera.light import Light
from scsr_opt.camera.recording import USUAL_FRAMES, Recording, bad_pixels_of, checked_white_rate
from scsr_opt.camera.sources import ArraySource, as_spikes, checked_shape
from scsr_opt.errors import InputError, shown
from scsr_opt.motion.estimators.base import Estimator
from scsr_opt.motion.estimators.dense import accelerated, dense
from scsr_opt.motion.estimators.evidence import (
    Prediction,
    at_rest,
    contradicted,
    counts_agree,
    light_explains,
    observable,
    predict,
    typical_noise,
)
from scsr_opt.motion.estimators.frames import MotionFrames, filled, motion_frames, smoothed
from scsr_opt.motion.estimators.layered import layered, relabelled
from scsr_opt.motion.estimators.parametric import parametric, shows_global_motion
from scsr_opt.motion.estimators.phase import PhaseCorrelation
from scsr_opt.motion.estimators.reach import within_reach
from scsr_opt.motion.estimators.settings import ChoiceSettings
from scsr_opt.motion.lamps import along_motion
from scsr_opt.motion.light import find_light
from scsr_opt.motion.propagation import carry
from scsr_opt.motion.reliability import with_trust
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.trajectory import Motion


class Still(Estimator):
    """The estimate that nothing moves."""

    def __call__(self, pictures: MotionFrames) -> Motion:
        return Motion.none(*pictures.picture.shape[1:])


class Global(Estimator):
    """One motion for the whole scene (`global_motion`): a translation, affine or perspective motion (a homography), as
    far as the recording supports it, with acceleration.

    **Fields:** `affine`: False allows a translation only. `settings`: thresholds.
    """

    affine: bool = True
    settings: MotionSettings = eqx.field(static=True, default=DEFAULTS, kw_only=True)

    def __call__(self, pictures: MotionFrames) -> Motion:
        return global_motion(pictures, affine=self.affine, settings=self.settings)[0]


class Dense(Estimator):
    """A velocity (`dense`) and an acceleration (`accelerated`) for each pixel, for as long as they hold
    (`within_reach`); no edges, no occlusion.

    **Fields:** `acceleration`: False leaves it out; each pixel keeps its velocity. `settings`: thresholds.
    """

    acceleration: bool = True
    settings: MotionSettings = eqx.field(static=True, default=DEFAULTS, kw_only=True)

    def __call__(self, pictures: MotionFrames) -> Motion:
        straight = dense(pictures, settings=self.settings)
        if not self.acceleration:
            return straight
        return within_reach(pictures, accelerated(pictures, straight, settings=self.settings), self.settings)


class Automatic(Estimator):
    """The simplest motion that the recording does not contradict: none, one for the whole scene (`Global`), layers with
    one motion each, or one for each pixel (`Dense`).

    A scene whose light flickers as a whole counts as one in which nothing moves. Few numbers are estimated far better
    than many, so a richer motion is taken only where it is needed. Where the key frame lies at one end of the
    recording, separate motion is estimated from its middle as well.

    **Fields:**
    - `simple_motion`: a richer motion is not estimated where a simpler one serves, and what moves apart from the
      background is searched for only around the pixels that contradict the background (`Shortcuts.simple_motion`). If
      False, all are estimated for the whole sensor before one is chosen, by the same rules.
    - `settings`: thresholds.
    """

    simple_motion: bool = True
    settings: MotionSettings = eqx.field(static=True, default=DEFAULTS, kw_only=True)

    def __call__(self, pictures: MotionFrames) -> Motion:
        choice = self.settings.choice
        first, last = np.asarray(pictures.after)[[0, -1]].tolist()
        middle = (first + last) / 2
        found, simple = self._chosen(pictures)
        if simple or abs(middle) <= choice.end_share * (last - first) / 2:
            return found
        # From one end, what moves is seen only to leave, or to come, and most of what it passes is hidden. So motion is
        # estimated from the middle as well, and propagated to the key frame.
        carried = carry(self._chosen(pictures.from_moment(middle))[0], -middle, self.settings.trajectory)
        other = relabelled(pictures, carried, self.settings)
        against, against_other = (contradicted(pictures, motion, self.settings).sum() for motion in (found, other))
        return other if against_other < choice.end_contradiction_ratio * against else found

    def _chosen(self, pictures: MotionFrames) -> tuple[Motion, bool]:
        """The motion, and whether it is none or one for the whole scene."""
        settings, choice = self.settings, self.settings.choice
        still = Motion.none(*pictures.picture.shape[1:])
        moving, resting = at_rest(pictures, settings)
        rests = bool(moving.mean() <= settings.evidence.tolerated_share_at_rest)
        rests = rests and not shows_global_motion(pictures, settings)
        rests = rests or _only_flickers(pictures, moving.mean(), settings)
        if self.simple_motion and rests:
            return still, True
        several = _needs_several_motions(resting, moving, choice)
        presmoothed = (settings.comparison.presmoothing_px,)
        if self.simple_motion and several:
            whole, left = still, moving
        else:
            whole, left = global_motion(pictures, settings=settings)
            presmoothed += settings.parametric.presmoothing_px
        # Where most pixels fire too seldom to contradict a motion, a lack of contradiction is no evidence.
        unobservable = observable(pictures, whole, settings).mean() < choice.observable_share
        possible = not several and (not unobservable or counts_agree(pictures, whole, settings))
        serves = possible and bool(left.mean() <= choice.tolerated_share_global)
        if self.simple_motion and serves:
            return whole, True
        moves_behind = possible and bool(left.mean() < choice.background_ratio * moving.mean())
        background, unexplained = (whole, left) if moves_behind else (still, moving)
        richer = _SeparateMotion(pictures, background, unexplained, presmoothed, self.simple_motion, settings).found()
        return (still, True) if rests else (whole, True) if serves else (richer, False)


def _only_flickers(pictures: MotionFrames, contradicting: float, settings: MotionSettings) -> bool:
    """Whether rest is contradicted, by this share of the pixels, because the light changes: lamps flicker at 100 Hz, by
    a few percent within 100 frames, and each window that brightens as a whole looks as if it moved."""
    choice = settings.choice
    even = _without_flicker(pictures, choice)
    if even is None:
        return False
    left = at_rest(even, settings)[0].mean()
    most = min(choice.tolerated_share_global, choice.flicker_residual_share * contradicting)
    return bool(left <= most) and not shows_global_motion(even, settings)


def _without_flicker(pictures: MotionFrames, settings: ChoiceSettings) -> MotionFrames | None:
    """The pictures divided by the light of their moment, the median ratio of their pixels to the mean picture; None
    where that hardly changes. Where something moves, the median may follow it: the result is for tests of rest only."""
    shown = np.asarray(pictures.picture)
    mean = shown.mean(0)
    some = np.argwhere(mean > settings.lit_ratio * mean.mean())
    some = tuple(some[:: max(1, len(some) // settings.light_pixels)].T)
    if not some[0].size:
        return None
    light = np.median(shown[:, *some] / mean[some], axis=1)
    if np.ptp(light) <= settings.flicker_share * np.median(light):  # also where there is no light
        return None
    light = np.maximum(light, settings.lit_ratio * light.max())
    even = on_device(shown / light[:, None, None].astype(np.float32))
    return MotionFrames(even, pictures.after, pictures.firing, cutoff=pictures.cutoff)


def _needs_several_motions(
    resting: Bool[np.ndarray, "h w"], moving: Bool[np.ndarray, "h w"], settings: ChoiceSettings
) -> bool:
    """Whether most moving pixels lie between or near pixels at rest, so that no affine motion explains both.

    A component of an affine motion that is at most ε at some points is at most ε in their convex hull, and at most 3ε
    in the hull enlarged by 2 about its middle. Fewer pixels at rest than `resting_share` may be so by mistake.
    """
    resting = cast(np.ndarray, ndimage.binary_opening(resting, iterations=settings.resting_opening_iterations))
    places = np.argwhere(resting)
    if not moving.any() or len(places) < max(3, settings.resting_share * resting.size):
        return False
    if (np.ptp(places, axis=0) == 0).any():
        return False
    try:
        sides = ConvexHull(places).equations
    except QhullError:  # all in one line
        return False
    # Half as far from the middle: a pixel in the enlarged hull is then in the hull.
    middle = places.mean(0)
    nearer = middle + (np.argwhere(moving) - middle) / 2
    return bool((nearer @ sides[:, :2].T + sides[:, 2] < 0).all(1).mean() > 0.5)


@dataclass(frozen=True, eq=False)
class _SeparateMotion:
    """The search for what moves apart from the background, as layers or pixel by pixel.

    **Fields:** `background`, the motion of most of the scene; `unexplained`, (h, w), the pixels that contradict it;
    `presmoothed`, widths by which all `pictures` have been presmoothed already; `simple_motion` as of `Automatic`.
    """

    pictures: MotionFrames
    background: Motion
    unexplained: Bool[np.ndarray, "h w"]
    presmoothed: tuple[float, ...]
    simple_motion: bool
    settings: MotionSettings

    def found(self) -> Motion:
        """The motion of the scene; that of the background, if nothing richer explains clearly more."""
        settings, choice = self.settings, self.settings.choice
        box, everything = _box(self.unexplained, choice), (slice(None), slice(None))
        used, judged_on = (box, everything) if self.simple_motion else (everything, box)
        part = self.pictures.part(*used, presmoothed=self.presmoothed)
        before = self.background.part(*used)
        everywhere = dense(part, start=before, settings=settings)
        noise = typical_noise(part, everywhere, settings.comparison.presmoothing_px)
        sparse = self.simple_motion and everywhere.speed.size >= choice.sparse_from_pixels

        def prediction(motion: Motion) -> Prediction:
            return predict(part, motion, noise, sparse=sparse, settings=settings).part(*judged_on)

        everywhere, by_pixel, by_background = self._maybe_accelerated(part, before, everywhere, prediction)
        makers = layered(
            part, before, everywhere, self.unexplained[used], self.unexplained.size,
            simple_motion=self.simple_motion, sparse=sparse, settings=settings,
        )  # fmt: skip
        motion, residual = self._best(makers, everywhere, by_pixel, prediction, judged_on)
        # A recording of noise contradicts any motion: a richer one then explains nothing, or predicts nothing. What is
        # hidden for a while contradicts any motion, too, but all else is predicted.
        enough = 1.0 if self.unexplained.mean() >= choice.widespread_share else choice.prediction_ratio
        better = residual < enough * by_background
        if better and residual >= choice.contradiction_ratio * by_background:
            against = contradicted(part, motion, settings)[judged_on].sum()
            better = against < choice.contradiction_ratio * self.unexplained[box].sum()
        if better and motion is everywhere:  # in dim light predictions hardly differ, and noise is subtracted anyway
            motion = accelerated(part, motion, start=before, settings=settings)
        # One motion that is contradicted, and nothing richer that is better: it may hold for a while.
        found = motion if better else before
        if found.layers is None and found.moves:
            found = within_reach(part, found, settings)
        return found.within(self.background, *used)

    def _maybe_accelerated(
        self,
        part: MotionFrames,
        before: Motion,
        everywhere: Motion,
        prediction: Callable[[Motion], Prediction],
    ) -> tuple[Motion, Prediction, float]:
        """The dense estimate, with accelerations where one turn of them predicts the pictures better; its prediction;
        and the residual of the background, `before`. An object that does not accelerate lost 0.9 dB by the freedom to.
        """
        settings = self.settings
        with ThreadPoolExecutor(1) as beside:
            straight, resting = (beside.submit(prediction, motion) for motion in (everywhere, before))
            curved = accelerated(part, everywhere, start=before, turns=1, settings=settings)
            by_curved, by_pixel, by_background = prediction(curved), straight.result(), resting.result()
        if by_curved.mean < settings.choice.prediction_ratio * by_pixel.mean:
            turns = settings.dense.acceleration_turns - 1
            everywhere = accelerated(part, curved, start=before, turns=turns, settings=settings)
            by_pixel = prediction(everywhere)
        return everywhere, by_pixel, by_background.mean

    def _best(
        self,
        makers: list[Callable[[], Motion]],
        everywhere: Motion,
        by_pixel: Prediction,
        prediction: Callable[[Motion], Prediction],
        judged_on: tuple[slice, slice],
    ) -> tuple[Motion, float]:
        """The motion of least residual, and that: of the layers that serve, or else of the dense estimate; of the
        background where no layers were found."""
        choice, total = self.settings.choice, self.unexplained.size
        edge = self.settings.layers.edge_px

        def judged(make: Callable[[], Motion]) -> tuple[Motion, Prediction, bool]:
            motion = make()
            by_layers, layers = prediction(motion), motion.layers
            if layers is None:
                return motion, by_layers, False
            compact = _is_compact(layers.label[judged_on], total, edge, choice)
            return motion, by_layers, compact and _predict_as_well(by_layers, by_pixel, choice)

        candidates = in_threads(judged, makers[:1] if self.simple_motion else makers)
        _, by_first, serves = candidates[0]
        if serves and by_first.mean < choice.layers_sufficient_ratio * by_pixel.mean:
            candidates = candidates[:1]
        elif self.simple_motion:
            candidates += in_threads(judged, makers[1:])
        serving = [(motion, found) for motion, found, serves in candidates if serves]
        is_layered = any(motion.layers is not None for motion, *_ in candidates)
        otherwise = [(everywhere, by_pixel)] if is_layered else [(motion, found) for motion, found, _ in candidates]
        motion, found = min(serving or otherwise, key=lambda one: one[1].mean)
        return motion, found.mean


def _box(mask: Bool[np.ndarray, "h w"], settings: ChoiceSettings) -> tuple[slice, slice]:
    """Rows and columns around a mask, with a margin; all of them where the box would not be much smaller. A side is
    whole quarters of the sensor's, so that compiled programs fit the box of another moment, too."""
    margin, sides = settings.margin_px, []
    for axis, length in enumerate(mask.shape):
        some = np.flatnonzero(mask.any(1 - axis))
        begin, end = (int(some[0]), int(some[-1]) + 1) if some.size else (0, length)
        quarters = -(-4 * (end - begin + 2 * margin) // length)
        side = min(-(-quarters * length // 4), length)
        first = min(max((begin + end - side) // 2, 0), length - side)
        sides.append(slice(first, first + side))
    area = np.prod([side.stop - side.start for side in sides])
    return (sides[0], sides[1]) if area <= settings.box_share * mask.size else (slice(None), slice(None))


def _is_compact(label: Int[np.ndarray, "h w"], total: int, edge: int, settings: ChoiceSettings) -> bool:
    """Whether enough pixels lie more than `edge` pixels inside a layer; of `total` sensor pixels, those beyond the
    labels are background."""
    inner = maximum_filter(label, 2 * edge + 1) == minimum_filter(label, 2 * edge + 1)
    return bool(inner.sum() + total - inner.size >= settings.layer_interior_share * total)


def _predict_as_well(by_layers: Prediction, by_pixel: Prediction, settings: ChoiceSettings) -> bool:
    """Whether layers predict the recording as well as the dense estimate does, where both predict it."""
    both = (by_layers.visible > 0.5) & (by_pixel.visible > 0.5)
    residual, reference = by_layers.residual[both].mean(), by_pixel.residual[both].mean()
    return bool(residual <= settings.layers_residual_ratio * reference)


def global_motion(
    pictures: MotionFrames, *, affine: bool = True, settings: MotionSettings = DEFAULTS
) -> tuple[Motion, Bool[np.ndarray, "h w"]]:
    """One motion for the whole scene (`parametric`), and the pixels that contradict it.

    Where these are too many, the fit is repeated from phase correlation, if fewer contradict that. In dim light near
    times, by which the fit begins, show nothing: at 0.12 spikes per frame of white its error was 0.27 of 0.3 px per
    frame from rest, 0.03 from phase correlation.
    """
    motion = parametric(pictures, affine=affine, settings=settings)
    left = _contradicting(pictures, motion, settings)
    too_many = left.mean() > settings.choice.tolerated_share_global
    start = PhaseCorrelation(settings=settings)(pictures) if too_many else None
    if start is not None and _contradicting(pictures, start, settings).mean() < left.mean():
        other = parametric(pictures, affine=affine, start=start, settings=settings)
        left_then = _contradicting(pictures, other, settings)
        if left_then.mean() < left.mean():
            return other, left_then
    return motion, left


def _contradicting(pictures: MotionFrames, motion: Motion, settings: MotionSettings) -> Bool[np.ndarray, "h w"]:
    """The pixels that contradict a motion of the whole scene; all pixels, if the motion carries most of them out of
    view, where nothing can contradict it, and the counts of spikes do not agree with it."""
    longest = float(np.abs(np.asarray(pictures.after)).max())
    far = settings.choice.out_of_view_share * np.array(pictures.picture.shape[1:])
    leaves = np.abs(np.median(motion.velocity, axis=(1, 2))) * longest > far
    if leaves.any() and not counts_agree(pictures, motion, settings):
        return np.ones(motion.speed.shape, bool)
    return contradicted(pictures, motion, settings)


def estimate_motion(
    spikes: Shaped[np.ndarray, "T h w"] | Recording,
    *,
    key: int | None = None,
    white_rate: float | int | None = None,
    estimator: Estimator | None = None,
    bad_pixels: np.ndarray | None = None,
    gain: Float[np.ndarray, "h w"] | None = None,
    settings: MotionSettings = DEFAULTS,
) -> Motion:
    """The motion around a key frame, with its trust.

    **Arguments:**
    - `spikes`: (T, h, w) of 0 and 1, of which all frames are used, or a `Recording`, of which the 101 frames around the
      key frame are used, with its white rate and bad pixels.
    - `key`: the key frame; the middle one if None.
    - `white_rate`: spikes per frame of a pixel at intensity 1; the recording's, or 0.6, if None.
    - `estimator`: `Automatic(settings=settings)` if None.
    - `bad_pixels`: (h, w), filled from their neighbours before anything is compared.
    - `gain`: (h, w), by which measurements are divided: a fixed pattern rests whatever moves. 1 if None.
    - `settings`: thresholds of the pictures and the trust, and of the estimator where none is given.

    **Returns:** the `Motion`; none for fewer than three frames, or a single row or column.

    **Raises:** `InputError` for arrays that cannot be read or have another shape, a key frame that is not in the
    recording, and an estimator or settings that are none.
    """
    check_type(estimator, Estimator, "estimator", "Global()")
    if not isinstance(settings, MotionSettings):
        raise InputError(f"settings is {shown(settings)}; it must be a MotionSettings, such as MotionSettings().")
    recording = spikes if isinstance(spikes, Recording) else _recording(spikes)
    middle = recording.frames // 2 if key is None else whole(key, "key", 0, recording.frames - 1)
    start, stop = recording.around(middle, USUAL_FRAMES if recording is spikes else None)
    rate = recording.white_rate if white_rate is None else checked_white_rate(white_rate)
    window, bad = recording.window(start, stop), bad_pixels_of(recording, bad_pixels)
    of_pixels = None if gain is None else pixel_gain(gain, recording.height, recording.width)

    def pictures_over(light: Light | None) -> MotionFrames | None:
        return corrected_frames(
            window, key=middle - start, white_rate=rate, bad_pixels=bad, gain=of_pixels, light=light, settings=settings
        )

    light = find_light(
        window,
        bad_pixels=bad,
        before=start,
        after=recording.frames - stop,
        read=lambda begin, end: recording.window(start + begin, start + end),
        settings=settings,
    ).light
    pictures = pictures_over(light)
    if pictures is None:
        return Motion.none(recording.height, recording.width)
    motion = motion_in(pictures, estimator, settings)
    for _ in range(0 if light is None or light.uniform else settings.light.lamp_rounds):
        assert light is not None
        light = along_motion(light, pictures, motion, middle - start, settings)
        pictures = pictures_over(light)
        assert pictures is not None
        motion = motion_in(pictures, estimator, settings)
    plain = None if light is None else pictures_over(None)
    if plain is not None:
        without = motion_in(plain, estimator, settings)
        motion = motion if light_explains((pictures, motion), (plain, without), settings) else without
    # Arrays of the caller's own, which can be written to.
    return jax.tree.map(np.array, motion)


def _recording(spikes: Any) -> Recording:
    """An array as a recording, without a look at its axis of time: most callers have had one."""
    array = as_array(spikes, "The array of spikes")
    checked_shape(array.shape, "The array of spikes")
    return Recording(ArraySource.of(as_spikes(array, "The array of spikes")))


def motion_in(pictures: MotionFrames, estimator: Estimator | None, settings: MotionSettings) -> Motion:
    """The motion (h, w) in these pictures (`corrected_frames`) by `estimator`, `Automatic` if None, with its trust."""
    ready()
    motion = (Automatic(settings=settings) if estimator is None else estimator)(pictures)
    return with_trust(pictures, motion, settings)


def corrected_frames(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    key: int,
    white_rate: float | int,
    bad_pixels: np.ndarray | None,
    gain: Float[np.ndarray, "h w"] | None,
    light: Light | None = None,
    settings: MotionSettings = DEFAULTS,
) -> MotionFrames | None:
    """The recording as `motion_frames` in which all differences are motion: divided by the gains and the
    light, bad pixels filled.

    **Arguments:** as of `estimate_motion`, with `key` counted from the first frame; `light` of each moment.

    **Returns:** None where no motion can be seen, in fewer than three frames or a single row or column.
    """
    ready()
    frames, height, width = spikes.shape
    if frames < 3 or min(height, width) < 2:
        return None
    found = motion_frames(spikes, key=key, white_rate=white_rate, light=light, settings=settings)
    limits = settings.frames
    picture, firing, counted = found.picture, found.firing, found.counted
    assert firing is not None and counted is not None  # by `motion_frames`
    good = None if bad_pixels is None or not bad_pixels.any() else ~bad_pixels

    def mended(of: Float[Array, "n h w"]) -> Float[Array, "n h w"]:
        over = of if gain is None else on_device(np.asarray(of) / np.asarray(gain, np.float32))
        return over if good is None else filled(over, good)

    if good is not None:
        # Where hardly any pixel around is good, what is filled in does not move, and must not contradict a motion.
        around = smoothed(good.astype(np.float32), limits.repair_window_px)
        lit = np.asarray(filled(firing, good))
        firing = on_device(np.where(around > limits.repair_good_share, lit, np.float32(0)))
    return MotionFrames(mended(picture), found.after, firing, lambda: mended(counted()), found.cutoff)
