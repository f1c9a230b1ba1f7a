"""Pixels that do not tell the light: dead, hot, stuck, and those behind dust that lies on the sensor.

They are told from the scene by two properties.

- `isolated_pixels`: a lens spreads a point over its neighbours, so that no picture of it holds a point that stands out
  from its neighbours far more than anything does around there. A picture that is sharp, as text and fine texture are,
  holds many, and then none is taken for a bad pixel. In a scene at rest a bright point may be a light, and is kept
  where the recording gives any reason to think so.
- `resting_pixels`: where the scene moves, a point of it is seen by many pixels, and they predict what each should have
  measured. What is darker or brighter than that by the same factor all the time rests on the sensor. A single row or
  grain of dust is found so, and a pixel whose gain is far off.
"""

import enum
import math
import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Real, UInt8
from scipy.ndimage import binary_dilation, gaussian_filter, maximum_filter, minimum_filter
from scipy.sparse import csr_array

from scsr_opt._threads import in_threads
from scsr_opt.calibration.settings import BadPixelSettings
from scsr_opt.camera.saturation import SATURATED_SHARE

# Candidates whose surroundings are looked at together, and pixels around each.
_TOGETHER = 1 << 14
# Side of the squares over which motion is smoothed, and over which errors of prediction are alike, sensor pixels.
_MOTION_SQUARE, _ERROR_SQUARE = 8, 12


class PixelKind(enum.IntEnum):
    """State of a pixel: good, or the reason why it must not be used."""

    GOOD = 0
    GIVEN = 1
    DEAD = 2
    HOT = 3
    ISOLATED = 4
    RESTING = 5


@dataclass(frozen=True, eq=False)
class BadPixels:
    """Pixels that must not be used, and why.

    **Fields:** `kind`: (h, w), a `PixelKind` for each pixel.
    """

    kind: UInt8[np.ndarray, "h w"]

    @classmethod
    def given(cls, mask: Bool[np.ndarray, "h w"]) -> "BadPixels":
        """Bad pixels that the user gives, by a mask (h, w)."""
        return cls(np.where(mask, PixelKind.GIVEN, PixelKind.GOOD).astype(np.uint8))

    @classmethod
    def none(cls, shape: tuple[int, int]) -> "BadPixels":
        """No pixel of a sensor of this shape."""
        return cls(np.zeros(shape, np.uint8))

    @property
    def mask(self) -> Bool[np.ndarray, "h w"]:
        """(h, w), true where a pixel must not be used."""
        return self.kind != PixelKind.GOOD

    @property
    def numbers(self) -> dict[str, int]:
        """Number of the pixels of each kind of bad ones, by its name in lower case."""
        counts = np.bincount(self.kind.ravel(), minlength=len(PixelKind))
        return {kind.name.lower(): int(counts[kind]) for kind in PixelKind if kind is not PixelKind.GOOD}

    def also(self, others: "BadPixels") -> "BadPixels":
        """These pixels, and the others where these are good."""
        return BadPixels(np.where(self.mask, self.kind, others.kind))

    def part(self, rows: slice, columns: slice) -> "BadPixels":
        """Bad pixels of a rectangle of the sensor."""
        return BadPixels(self.kind[rows, columns])


def isolated_pixels(
    count: Real[np.ndarray, "h w"],
    frames: int,
    *,
    bad: Bool[np.ndarray, "h w"] | None = None,
    settings: BadPixelSettings = BadPixelSettings(),
) -> BadPixels:
    """Pixels that deviate from their neighbours far more than any pixel around.

    A pixel's deviation is that of ln(spikes) from the median of its eight neighbours. It stands out if it lies beyond
    all but one of them, if these do not share its deviation, and if that is several times the third largest within 7
    pixels.

    **Arguments:** `count`: spikes of each pixel (over its gain) in `frames` frames; `bad`: pixels known to be bad.
    """
    height, width = count.shape
    kind = np.zeros((height, width), np.uint8)
    reach = settings.around_px
    if min(height, width) <= 2 * reach or frames < settings.least_frames:
        return BadPixels(kind)
    count = np.asarray(count, np.float64)
    if bad is not None and bad.any():
        count = np.where(bad, _median_of_neighbours(count, bad), count)
    log = np.log1p(count)
    lowest, middle, highest = _of_neighbours(log)
    deviation = log - middle
    beyond = np.maximum(lowest - log, log - highest)
    least = settings.least_deviation
    wanted = (np.abs(deviation) >= least) & (beyond >= settings.least_beyond_share * least)
    wanted &= np.abs(count - np.expm1(middle)) >= settings.least_spikes
    wanted &= np.maximum(np.expm1(lowest) - count, count - np.expm1(highest)) >= settings.least_beyond_spikes
    if bad is not None:
        wanted &= ~bad
    candidates = np.flatnonzero(wanted)
    if candidates.size == 0:
        return BadPixels(kind)

    size = np.abs(deviation)
    others = np.concatenate(
        [
            np.stack([_third_largest(of, some, width, reach) for of in (size, count, -count)])
            for some in np.array_split(candidates, -(-candidates.size // _TOGETHER))
        ],
        axis=1,
    )
    largest, brightest, darkest = others[0], others[1], -others[2]
    here, change = count.ravel()[candidates], deviation.ravel()[candidates]
    low, around, high = (np.expm1(of.ravel()[candidates]) for of in (lowest, middle, highest))
    # A lens gives its neighbours a part of a point's light.
    further = _median_at_distance_2(count, candidates)
    single = (around - further) * np.sign(change) < settings.most_spread * np.abs(here - further)
    outlying = single & (np.abs(change) >= settings.outlying_factor * largest)
    saturated = here >= SATURATED_SHARE * frames
    below = settings.hot_surround_share * frames

    dead = single & (here == 0) & (low >= settings.dead_neighbour_spikes) & (darkest >= settings.dead_surround_spikes)
    hot = single & saturated & (high <= below) & (brightest <= below)
    dark = outlying & (change < 0) & ~dead
    bright = outlying & (change > 0) & ~saturated
    lights = bright & (here + 1 > settings.light_ratio * (around + 1))
    bright &= ~lights
    # The scene has points of light of its own, or these are some: more than a sensor has dark ones.
    if lights.any() or np.count_nonzero(bright) > np.count_nonzero(dark | dead):
        bright[:] = False
    if np.count_nonzero(lights) > settings.lights_share * np.count_nonzero(hot):
        hot[:] = False
    for found, what in ((dark | bright, PixelKind.ISOLATED), (dead, PixelKind.DEAD), (hot, PixelKind.HOT)):
        kind.ravel()[candidates[found]] = what
    left_out = kind > 0 if bad is None else bad | (kind > 0)
    kind[_beside(kind == PixelKind.ISOLATED, left_out, count, deviation, settings)] = PixelKind.ISOLATED
    return BadPixels(kind)


def _beside(
    isolated: Bool[np.ndarray, "h w"],
    left_out: Bool[np.ndarray, "h w"],
    count: Float[np.ndarray, "h w"],
    deviation: Float[np.ndarray, "h w"],
    settings: BadPixelSettings,
) -> Bool[np.ndarray, "h w"]:
    """Pixels beside isolated ones that deviate from the good ones around in the same way, by half as much."""
    found = np.zeros_like(isolated)
    if not isolated.any():
        return found
    signed = np.where(isolated, np.sign(deviation), 0)
    wide = np.pad(signed, 1)
    height, width = signed.shape
    near = np.sum([wide[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)
    pixels = np.flatnonzero((near != 0) & ~left_out)
    change = np.log1p(count) - np.log1p(_median_of_neighbours(count, left_out))
    around = _third_largest(np.where(left_out, 0, np.abs(deviation)), pixels, width, settings.around_px)
    least = settings.grown_share * np.maximum(settings.least_deviation, settings.outlying_factor * around)
    found.ravel()[pixels] = change.ravel()[pixels] * np.sign(near.ravel()[pixels]) >= least
    return found


def _shifted(values: Float[np.ndarray, "h w"], fill: str = "reflect") -> Float[np.ndarray, "8 h w"]:
    """The eight neighbours of each pixel; beyond the border the picture is mirrored."""
    height, width = values.shape
    wide = np.pad(values, 1, mode=fill)  # type: ignore[call-overload]
    places = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
    return np.stack([wide[y : y + height, x : x + width] for y, x in places])


def _of_neighbours(values: Float[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "h w"], ...]:
    """Second smallest, median and second largest of each pixel's neighbours: one of them may be bad, too."""
    ordered = np.sort(_shifted(values), axis=0)
    return ordered[1], (ordered[3] + ordered[4]) / 2, ordered[6]


def _median_of_neighbours(values: Float[np.ndarray, "h w"], bad: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Median of the good neighbours of each pixel; 0 where there is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # where all are bad
        return np.nan_to_num(np.nanmedian(_shifted(np.where(bad, np.nan, values)), axis=0))


def _median_at_distance_2(values: Float[np.ndarray, "h w"], pixels: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Median of the sixteen pixels around the neighbours of each pixel."""
    ring = np.ones((5, 5), bool)
    ring[1:4, 1:4] = False
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, 2, mode="reflect"), (5, 5))
    return np.median(windows[np.divmod(pixels, values.shape[1])][:, ring], axis=1)


def _third_largest(
    values: Float[np.ndarray, "h w"], pixels: Int[np.ndarray, " n"], width: int, reach: int
) -> Float[np.ndarray, " n"]:
    """Third largest value within `reach` of each pixel, itself and its neighbours left out."""
    side = 2 * reach + 1
    ring = np.ones((side, side), bool)
    ring[reach - 1 : reach + 2, reach - 1 : reach + 2] = False
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, reach, mode="reflect"), (side, side))
    around = windows[pixels // width, pixels % width][:, ring]
    return np.partition(around, -3, axis=1)[:, -3]


def resting_pixels(
    pictures: Float[np.ndarray, "n h w"],
    after: Float[np.ndarray, " n"],
    velocity: Float[np.ndarray, "2 h w"],
    acceleration: Float[np.ndarray, "2 h w"],
    *,
    spikes: float | int,
    surface: Int[np.ndarray, "h w"] | None = None,
    bad: Bool[np.ndarray, "h w"] | None = None,
    settings: BadPixelSettings = BadPixelSettings(),
) -> BadPixels:
    """Pixels that are darker or brighter than a moving scene predicts, by the same factor all the time.

    The pictures are averaged where the motion puts them, and the mean is read where each pixel saw it. The logarithm of
    measured over predicted light has to be large, larger than that of the pixels around, and alike in each quarter of
    the time; and it must not go on along the motion, as an edge does whose motion is not exact. Twice, the second time
    without what was found the first.

    **Arguments:**
    - `pictures`: short pictures of the scene, intensity, at `after` frames from the key frame, ascending.
    - `velocity`, `acceleration`: of what each pixel sees in the key frame, sensor pixels per frame and per frame².
      They are smoothed: what rests must not have been taken for an object of its own.
    - `spikes`: that a pixel of intensity 1 fires in all the pictures.
    - `surface`: number of the surface that each pixel sees in the key frame, where there are several.
    - `bad`: pixels known to be bad.
    """
    count, height, width = pictures.shape
    shape = (height, width)
    nothing = BadPixels.none(shape)
    span = float(after[-1] - after[0])
    fast = np.hypot(velocity[0], velocity[1])
    if count < settings.quarters or min(shape) < 2 * settings.along_px[0]:
        return nothing
    if np.mean(fast * span >= settings.least_motion_px) * fast.size < 1:
        return nothing
    smooth = [_smoothed(of) for of in (*velocity, *acceleration)]
    moved = np.hypot(smooth[0], smooth[1]) * span
    good = np.ones(shape, bool) if bad is None else ~bad
    alike = _alike(velocity, settings.most_motion_difference_px / (span / 2), settings)
    if surface is not None:
        alike &= ~_near_border(surface, settings)
    rows = np.flatnonzero(good & alike & (moved >= settings.least_motion_px))
    if rows.size == 0:
        return nothing

    def prepared(b: int) -> tuple[csr_array, Float[np.ndarray, " m"]]:
        reading = _reading(smooth, float(after[b]), rows, shape)
        return reading, pictures[b].ravel()[rows].astype(np.float32)

    read = in_threads(prepared, range(count))
    found = judged = nearly = np.zeros(rows.size, bool)
    whole, limit = np.zeros(rows.size, np.float32), np.full(shape, math.inf)
    for _ in range(settings.rounds):
        total, weight = np.zeros(height * width, np.float32), np.zeros(height * width, np.float32)
        use = (~found).astype(np.float32)
        for reading, light in read:
            total += reading.T @ (use * light)
            weight += reading.T @ use
        scene = total / np.maximum(weight, 1e-6)
        measured, predicted, looks = np.zeros((3, settings.quarters, rows.size), np.float32)
        for b, (reading, light) in enumerate(read):
            trusted = np.minimum(weight, 1) * alike.ravel()
            known = (reading @ trusted > settings.least_known_share).astype(np.float32)
            quarter = b * settings.quarters // count
            measured[quarter] += known * light
            predicted[quarter] += known * (reading @ scene)
            looks[quarter] += known
        offset = count * settings.dark_light
        each = np.log((measured + offset / settings.quarters) / (predicted + offset / settings.quarters))
        expected: np.ndarray = predicted.sum(0)
        whole = np.log((measured.sum(0) + offset) / (expected + offset))
        judged = looks.sum(0) >= settings.least_looks_share * count
        # What changes for all pixels alike is the light.
        if judged.any():
            each = each - (np.median(each[:, judged], axis=1) - np.median(whole[judged]))[:, None]
        deviation = _placed(np.where(judged, whole, np.nan), rows, shape)
        of_others = np.abs(_placed(np.where(judged & ~found, whole, np.nan), rows, shape))
        chance = settings.resting_spikes / np.maximum(_placed(expected, rows, shape) / count * spikes, 1)
        limit = np.maximum(settings.least_resting_deviation, np.nan_to_num(chance, nan=math.inf))
        for share, factor in zip(settings.resting_quantiles, settings.resting_factors, strict=True):
            limit = np.maximum(limit, factor * _in_squares(of_others, share))
        agrees = each * np.sign(whole) >= settings.steady_share * np.abs(whole)
        steady = agrees.all(axis=0)
        # Beside a pixel that is found: in one quarter others may not have seen what the pixel sees.
        nearly = (agrees | (looks == 0)).all(axis=0) & (np.count_nonzero(looks, axis=0) >= settings.quarters - 1)
        found = judged & steady & (np.abs(whole) >= limit.ravel()[rows])
        found[found] = ~_goes_on(deviation, rows[found], smooth, settings)
    if np.count_nonzero(found) > settings.most_resting_share * rows.size:
        return nothing  # then it is the motion that is wrong, or the light
    kind = nothing.kind
    for sign in (-1, 1):
        seeds, allowed = np.zeros(height * width, bool), np.zeros(height * width, bool)
        seeds[rows[found & (whole * sign > 0)]] = True
        near = np.abs(whole) >= settings.grown_share * limit.ravel()[rows]
        allowed[rows[judged & nearly & near & (whole * sign > 0)]] = True
        if seeds.any():
            grown = binary_dilation(
                seeds.reshape(shape), np.ones((3, 3), bool), settings.grown_px, mask=allowed.reshape(shape)
            )
            kind[np.asarray(grown, bool)] = PixelKind.RESTING
    return BadPixels(kind)


def _reading(
    smooth: list[Float[np.ndarray, "h w"]], after: float, rows: Int[np.ndarray, " m"], shape: tuple[int, int]
) -> csr_array:
    """Matrix that reads a picture of the key frame, linearly interpolated, where some pixels look `after` frames later;
    0 for those that look beyond it."""
    height, width = shape
    row, column = (of.astype(np.float32) for of in np.divmod(rows, width))
    down, right, faster_down, faster_right = (of.ravel() for of in smooth)
    y, x = row, column
    for _ in range(3):  # the point q of the key frame with q + d(q) = p; d changes little over a pixel
        there = np.rint(y).clip(0, height - 1).astype(np.int32) * width + np.rint(x).clip(0, width - 1).astype(np.int32)
        y = row - np.float32(after) * (down[there] + np.float32(after / 2) * faster_down[there])
        x = column - np.float32(after) * (right[there] + np.float32(after / 2) * faster_right[there])
    inside = (y >= 0) & (x >= 0) & (y <= height - 1) & (x <= width - 1)
    top = np.floor(y).clip(0, height - 2).astype(np.int32)
    left = np.floor(x).clip(0, width - 2).astype(np.int32)
    lower, further = y - top, x - left
    corner = top * width + left
    places = np.stack([corner, corner + 1, corner + width, corner + width + 1], axis=1)
    shares = np.stack(
        [(1 - lower) * (1 - further), (1 - lower) * further, lower * (1 - further), lower * further], axis=1
    )
    shares = np.where(inside[:, None], shares, 0).astype(np.float32)
    starts = np.arange(0, 4 * rows.size + 1, 4, dtype=np.int32)
    return csr_array((shares.ravel(), places.ravel(), starts), shape=(rows.size, height * width))


def _placed(
    values: Float[np.ndarray, " m"], rows: Int[np.ndarray, " m"], shape: tuple[int, int]
) -> Float[np.ndarray, "h w"]:
    """Values of some pixels in their places; not a number elsewhere."""
    whole = np.full(shape[0] * shape[1], np.nan, np.float32)
    whole[rows] = values
    return whole.reshape(shape)


def _smoothed(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Medians over 3×3 squares of 8 pixels a side, linearly interpolated between their centres."""
    height, width = values.shape
    medians = _over_squares(values, _MOTION_SQUARE, 0.5)

    def between(length: int, squares: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        at = ((np.arange(length, dtype=np.float32) + np.float32(0.5)) / _MOTION_SQUARE - np.float32(0.5)).clip(
            0, squares - 1
        )
        first = np.minimum(at.astype(int), max(squares - 2, 0))
        return first, np.minimum(first + 1, squares - 1), (at - first).astype(np.float32)

    up, down, lower = between(height, medians.shape[0])
    left, right, further = between(width, medians.shape[1])
    rows = medians[up] * (1 - lower)[:, None] + medians[down] * lower[:, None]
    return rows[:, left] * (1 - further) + rows[:, right] * further


def _alike(velocity: Float[np.ndarray, "2 h w"], most: float, settings: BadPixelSettings) -> Bool[np.ndarray, "h w"]:
    """True where most of what is around moves alike, to `most` sensor pixels per frame: not at the border of an object,
    where something is seen that others have not seen."""
    low, high = settings.motion_quantiles
    shape = velocity.shape[1:]
    alike = np.ones(shape, bool)
    for of in velocity:
        differs = _over_squares(of, _MOTION_SQUARE, high) - _over_squares(of, _MOTION_SQUARE, low) > most
        wide = np.repeat(np.repeat(differs, _MOTION_SQUARE, axis=0), _MOTION_SQUARE, axis=1)
        alike &= ~wide[: shape[0], : shape[1]]
    return alike


def _near_border(surface: Int[np.ndarray, "h w"], settings: BadPixelSettings) -> Bool[np.ndarray, "h w"]:
    """True near the border of a surface; what is no larger than a grain of dust counts as what is around it."""
    shares = [
        gaussian_filter((surface == k).astype(np.float32), settings.surface_smoothing_px)
        for k in range(surface.max() + 1)
    ]
    smooth, side = np.argmax(shares, axis=0), 2 * settings.border_px + 1
    return maximum_filter(smooth, side) != minimum_filter(smooth, side)


def _in_squares(values: Float[np.ndarray, "h w"], share: float) -> Float[np.ndarray, "h w"]:
    """Quantile of the values over 3×3 squares of 12 pixels a side, for each pixel; infinite where nothing is known."""
    height, width = values.shape
    found = np.nan_to_num(_over_squares(values, _ERROR_SQUARE, share), nan=math.inf)
    return np.repeat(np.repeat(found, _ERROR_SQUARE, axis=0), _ERROR_SQUARE, axis=1)[:height, :width]


def _over_squares(values: Float[np.ndarray, "h w"], side: int, share: float) -> Float[np.ndarray, "rows columns"]:
    """Quantile over 3×3 squares of side × side pixels around each square; what is no number is left out."""
    height, width = values.shape
    rows, columns = -(-height // side), -(-width // side)
    wide = np.full((rows * side, columns * side), np.nan, np.float32)
    wide[:height, :width] = values
    squares = wide.reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    squares = np.pad(squares, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    around = [squares[y : y + rows, x : x + columns] for y in range(3) for x in range(3)]
    ordered = np.sort(np.concatenate(around, axis=2), axis=2)  # what is no number comes last
    last = np.count_nonzero(~np.isnan(ordered), axis=2, keepdims=True) - 1
    at = np.floor(share * np.maximum(last, 0) + 0.5).astype(int)
    return np.take_along_axis(ordered, at, axis=2)[..., 0]


def _goes_on(
    deviation: Float[np.ndarray, "h w"],
    pixels: Int[np.ndarray, " n"],
    smooth: list[Float[np.ndarray, "h w"]],
    settings: BadPixelSettings,
) -> Bool[np.ndarray, " n"]:
    """True for the pixels whose deviation goes on along the motion, either way: far, or nearer but not across it."""
    height, width = deviation.shape
    here = deviation.ravel()[pixels]

    def followed(down: Float[np.ndarray, "h w"], right: Float[np.ndarray, "h w"], way: int) -> np.ndarray:
        """Deviations at 1, 2, … pixels along the lines of a field, (m, n), of the sign of that of the pixel itself."""
        y, x = (at.astype(float) for at in np.divmod(pixels, width))
        inside, found = np.ones(pixels.size, bool), []
        for _ in range(max(settings.along_px)):
            at = np.rint(y).astype(int).clip(0, height - 1), np.rint(x).astype(int).clip(0, width - 1)
            length = np.maximum(np.hypot(down[at], right[at]), 1e-9)
            y, x = y + way * down[at] / length, x + way * right[at] / length
            at = np.rint(y).astype(int), np.rint(x).astype(int)
            inside &= (at[0] >= 0) & (at[1] >= 0) & (at[0] < height) & (at[1] < width)
            value = deviation[at[0].clip(0, height - 1), at[1].clip(0, width - 1)]
            found.append(np.where(inside, np.nan_to_num(value), 0))
        return np.sign(here) * np.stack(found)

    def further(sides: list[np.ndarray], reach: tuple[int, int]) -> np.ndarray:
        """The larger of the mean deviations on both sides."""
        return np.maximum(*(side[reach[0] - 1 : reach[1]].mean(0) for side in sides))

    along = [followed(smooth[0], smooth[1], way) for way in (-1, 1)]
    beside = [followed(smooth[1], -smooth[0], way) for way in (-1, 1)]
    far, near = (further(along, reach) for reach in (settings.along_px, settings.near_px))
    most = settings.along_share * np.abs(here)
    return (far >= most) | ((near >= most) & (near >= settings.along_ratio * further(beside, settings.near_px)))
