"""Maps of bad pixels, gains and dark level of a camera, from recordings of even light, of darkness, and of scenes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from scsr_opt.calibration.bad_pixels import BadPixels, PixelKind
from scsr_opt.calibration.gain import even_gain, gain_is_known
from scsr_opt.calibration.maps import Calibration
from scsr_opt.calibration.settings import BadPixelSettings
from scsr_opt.camera.recording import Recording, bad_pixels_of
from scsr_opt.camera.saturation import spike_counts
from scsr_opt.errors import InputError
from scsr_opt.pipeline.options import Options
from scsr_opt.pipeline.reconstruct import reconstruct
from scsr_opt.progress import NoProgress, Progress

# Frames that are read at once.
_FRAMES_AT_ONCE = 250


def calibrate(
    scenes: Sequence[Recording] = (),
    *,
    flat: Sequence[Recording] = (),
    dark: Sequence[Recording] = (),
    options: Options | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibration of a camera (bad pixels, gains, dark level) from its recordings.

    - `dark`, with the lens covered: a pixel's dark level is its mean rate; one whose rate is far above the others' is
      hot.
    - `flat`, of an evenly lit, still surface: a pixel's gain is its rate, without the dark level, over the median
      around it; one that is beyond all gains is bad, and dead if it never fired.
    - `scenes`, anything else: bad pixels as `reconstruct` finds them (an isolated one has to be found in two of several
      recordings, as a point of one scene is none of another), and gains where a scene moves, if there is no flat
      recording; each is solved for at the sensor's resolution.

    **Arguments:** `options`: of those solves; `progress`: receives the number of recordings done.

    **Raises:** `InputError` if there is no recording, or they are of sensors of different sizes.
    """
    every = [*scenes, *flat, *dark]
    if not every:
        raise InputError(
            "There is no recording to calibrate from: give one of a scene, of an even light, or of darkness."
        )
    shape = (every[0].height, every[0].width)
    for one in every:
        if (one.height, one.width) != shape:
            raise InputError(
                f"{one.name} has {one.width}x{one.height} pixels, but {every[0].name} has {shape[1]}x{shape[0]}: "
                f"calibrate one camera at a time."
            )
    options = Options() if options is None else options
    settings = options.settings.bad_pixels
    meter = NoProgress() if progress is None else progress
    meter.start(len(every), "Calibrating")
    try:
        bad, level, gain = BadPixels.none(shape), np.zeros(shape, np.float32), np.ones(shape, np.float32)
        if dark:
            level = _mean([_rate(one, meter) for one in dark])
            bad = bad.also(_hot(level, settings))
        if flat:
            light = np.maximum(_mean([_rate(one, meter) for one in flat]) - level, 0)
            bad = bad.also(_unbelievable(light, bad, options))
            gain = even_gain(light, bad.mask, settings=options.settings.gain)
        found = [_of_scene(one, bad, options, None if not flat else gain, meter) for one in scenes]
    finally:
        meter.finish()
    if found:
        bad = bad.also(_agreed([each for each, _ in found]))
        if not flat:
            gain = _known_mean([each for _, each in found])
    good = np.where(bad.mask, 1, gain)
    return Calibration(bad, good.astype(np.float32), np.where(bad.mask, 0, level).astype(np.float32))


def _rate(recording: Recording, meter: Progress) -> Float[np.ndarray, "h w"]:
    """Spikes per frame of each pixel, read in windows; 0 in pixels that are known to be bad."""
    count = np.zeros((recording.height, recording.width), np.int64)
    for start in range(0, recording.frames, _FRAMES_AT_ONCE):
        count += spike_counts(recording.window(start, min(start + _FRAMES_AT_ONCE, recording.frames)))
    meter.advance(1)
    return (count / recording.frames).astype(np.float32)


def _mean(maps: list[Float[np.ndarray, "h w"]]) -> Float[np.ndarray, "h w"]:
    return np.asarray(np.mean(maps, axis=0, dtype=np.float32))


def _hot(level: Float[np.ndarray, "h w"], settings: BadPixelSettings) -> BadPixels:
    """Pixels that fire in darkness far more than the others."""
    median = float(np.median(level))
    spread = 1.4826 * float(np.median(np.abs(level - median)))
    most = median + max(settings.dark_deviations * spread, settings.least_hot_rate)
    return BadPixels(np.where(level > most, PixelKind.HOT, PixelKind.GOOD).astype(np.uint8))


def _unbelievable(light: Float[np.ndarray, "h w"], bad: BadPixels, options: Options) -> BadPixels:
    """Pixels whose gain in an even light is beyond what gains are; dead if they see none."""
    believed = options.settings.gain.believed_range
    # A wide range is clipped to, so that what is at its ends is beyond.
    ratio = even_gain(light, bad.mask, settings=replace(options.settings.gain, believed_range=(0.0, 1e6)))
    beyond = (ratio < believed[0]) | (ratio > believed[1])
    kind = np.where(light == 0, PixelKind.DEAD, np.where(beyond, PixelKind.ISOLATED, PixelKind.GOOD))
    return BadPixels(np.where(bad.mask, PixelKind.GOOD, kind).astype(np.uint8))


def _of_scene(
    scene: Recording,
    bad: BadPixels,
    options: Options,
    gain: Float[np.ndarray, "h w"] | None,
    meter: Progress,
) -> tuple[BadPixels, Float[np.ndarray, "h w"]]:
    """Bad pixels that a scene shows, beside those known, and gains where it moves; not a number elsewhere."""
    known = replace(scene, bad_pixels=bad_pixels_of(scene, bad.mask))
    asked = replace(options, bad_pixels="auto", gain="blind" if gain is None else gain, crop=None)
    solution = reconstruct(known, scale=1, options=asked)
    meter.advance(1)
    unknown = np.full(bad.kind.shape, np.nan, np.float32)
    found = BadPixels.none((scene.height, scene.width)) if solution.bad_pixels is None else solution.bad_pixels
    if solution.motion is None or solution.gain is None or not solution.status.usable:
        return found, unknown
    moved = solution.motion.moved(min(int(options.frames), scene.frames))
    return found, np.where(gain_is_known(moved, options.settings.gain), solution.gain, unknown)


def _agreed(each: list[BadPixels]) -> BadPixels:
    """Pixels that scenes show as bad; isolated ones only where two of several do."""
    isolated = np.sum([one.kind == PixelKind.ISOLATED for one in each], axis=0)
    kind = np.where(isolated >= min(len(each), 2), PixelKind.ISOLATED, PixelKind.GOOD)
    for one in each:
        certain = (one.kind != PixelKind.ISOLATED) & one.mask
        kind = np.where(certain, one.kind, kind)
    return BadPixels(kind.astype(np.uint8))


def _known_mean(gains: list[Float[np.ndarray, "h w"]]) -> Float[np.ndarray, "h w"]:
    """Mean of the gains that are known; 1 where none is."""
    number = np.count_nonzero(np.isfinite(gains), axis=0)
    return np.where(number > 0, np.nansum(gains, axis=0) / np.maximum(number, 1), 1).astype(np.float32)
