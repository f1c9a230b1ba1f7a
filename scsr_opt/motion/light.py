"""The light of each moment, found where lamps flicker or clouds pass: brightness changes that no motion explains.

Motion changes what a pixel sees, too, so that both are found together. In a tile of the sensor whose surface moves at a
velocity v, a short picture I of the recording differs from the one before by

    ΔI = δ·I − τ v·∇I + noise,

δ being the relative step of the light and τ the time between the two: linear in δ, one for each step, and in v, one for
some 25 steps (brightness constancy generalised: Negahdaripour, 1998). Steps add up to the course of the tile's light.
That of the scene is their robust mean: an object that moves in changes few tiles.

Steps of a scene without flicker add up to something, too, since a velocity and linear slopes are not all that moves.
But those errors differ from tile to tile, where lamps light neighbours alike. So the light is taken to change where the
courses of tiles agree with their neighbours'.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.ndimage import gaussian_filter, map_coordinates

from scsr_opt.camera.light import Light
from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.spike_times import SpikeTimes
from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.light_settings import LightSettings
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.trajectory import Motion

Spikes = Shaped[np.ndarray, "T h w"]
Courses = Float[np.ndarray, "tiles n"]


class _Tiles(NamedTuple):
    """Squares of a sensor, `side` pixels a side: `top` and `left` (tiles,), in rows of `across`."""

    top: Int[np.ndarray, " tiles"]
    left: Int[np.ndarray, " tiles"]
    side: int
    grid: tuple[int, int]

    def cut(self, field: Shaped[np.ndarray, "*n h w"]) -> Shaped[np.ndarray, "*n tiles side side"]:
        """The field in each tile."""
        along = np.arange(self.side)
        rows, columns = self.top[:, None, None] + along[:, None], self.left[:, None, None] + along
        return field[..., rows, columns]

    def some(self, most: int) -> "_Tiles":
        """`most` of the tiles, evenly over the sensor."""
        rows, columns = self.grid
        fewer = max(1.0, (rows * columns / most) ** 0.5)
        chosen = [np.unique(np.linspace(0, n - 1, max(1, int(n / fewer))).round().astype(int)) for n in (rows, columns)]
        number = (chosen[0][:, None] * columns + chosen[1]).reshape(-1)
        return _Tiles(self.top[number], self.left[number], self.side, (chosen[0].size, chosen[1].size))

    @classmethod
    def of(cls, shape: tuple[int, int], side: int) -> "_Tiles":
        """All tiles of a sensor; at its last rows and columns they may overlap."""
        side = min(side, *shape)
        begins = [np.linspace(0, n - side, max(1, round(n / side))).round().astype(int) for n in shape]
        top, left = (of.reshape(-1) for of in np.meshgrid(*begins, indexing="ij"))
        return cls(top, left, side, (begins[0].size, begins[1].size))


class FoundLight(NamedTuple):
    """The light of a clip.

    **Fields:** `light`, None where it does not change; `suspected`: of the `tiles` (None where none were looked at),
    those whose brightness changes beyond `light` as their neighbours' does, as far as one velocity for each tile tells.
    """

    light: Light | None
    tiles: _Tiles | None = None
    suspected: Bool[np.ndarray, " tiles"] = np.zeros(0, bool)


def find_light(
    spikes: Spikes,
    *,
    bad_pixels: Bool[np.ndarray, "h w"] | None = None,
    before: int = 0,
    after: int = 0,
    read: Callable[[int, int], Spikes] | None = None,
    settings: MotionSettings = DEFAULTS,
) -> FoundLight:
    """The light of each pixel and moment of a clip.

    **Arguments:**
    - `spikes`: (T, h, w), 0 and 1. `bad_pixels`: (h, w), not looked at.
    - `before`, `after`: frames that the recording has before and after the clip; `read`: reads frames from one to
      another (exclusive), counted from the clip's first. Where the light changes, they tell how often it does, and its
      mean.
    - `settings`: tiles and thresholds.
    """
    limits = settings.light
    frames, height, width = spikes.shape
    if frames < limits.least_frames or min(height, width) < limits.least_side_px:
        return FoundLight(None)
    good = np.ones((height, width), bool) if bad_pixels is None else ~bad_pixels
    tiles = _Tiles.of((height, width), limits.tile_px)
    some = tiles.some(limits.most_tiles)
    edges = _edges(spikes, some, limits)
    if edges.size < limits.least_pictures + 1:
        return FoundLight(None)
    courses = _courses(spikes, edges, some, good, None, limits)
    changing = _agreeing(courses, some, limits)
    found = _flickers(courses, changing, limits)
    first = max(-before, (frames - limits.stretch_frames) // 2)
    last = min(frames + after, (frames + limits.stretch_frames) // 2)
    longer = _Stretch(spikes, edges, 0)
    if read is not None and last - first > frames and (found or _suspicious(courses, changing, limits)):
        longer = _Stretch.read(read, first, last, some, limits)
        if not found:
            long = _courses(*longer.pictures, some, good, None, limits)
            found = _flickers(long, _agreeing(long, some, limits), limits)
    if not found:
        return FoundLight(None, some, changing)
    light = _light_of(longer, frames, tiles, some, good, limits)
    left = _agreeing(_courses(spikes, edges, some, good, light, limits), some, limits)
    return FoundLight(light, some, left)


def unexplained_share(
    found: FoundLight, pictures: MotionFrames, motion: Motion, settings: MotionSettings = DEFAULTS
) -> float:
    """Share of the tiles whose brightness changes as their neighbours' does, though neither motion nor light explain
    it: along the motion of each pixel, too, which a tile's one velocity is not.

    **Arguments:** `found`, by `find_light`; `pictures` over its light; `motion`, found by them.
    """
    if found.tiles is None or not found.suspected.any():
        return 0.0
    taken, after = np.asarray(pictures.picture), np.asarray(pictures.after)
    time = after[:, None, None, None]
    path = np.indices(motion.speed.shape) + motion.velocity * time + motion.acceleration * time**2 / 2
    last = np.array(motion.speed.shape)[:, None, None] - 1
    inside = np.all((path >= 0) & (path <= last), axis=1)
    seen = np.stack([map_coordinates(each, at, order=1) for each, at in zip(taken, path, strict=True)]) * inside
    usual = seen.sum(0) / np.maximum(inside.sum(0), 1)
    total, expected = (found.tiles.cut(of).sum((-2, -1)) for of in (seen, usual * inside))
    enough = found.tiles.cut(inside).mean((-2, -1)) >= settings.light.tracked_share
    courses = np.where(enough, total / np.maximum(expected, np.finfo(np.float32).tiny), 1).T
    limits = dataclasses.replace(settings.light, agreement=settings.light.tracked_agreement)
    return float((_agreeing(courses, found.tiles, limits) & found.suspected).mean())


class _Stretch(NamedTuple):
    """Frames of a recording around a clip: `spikes`, the `edges` of short pictures, counted from its first frame, and
    that frame, counted from the clip's."""

    spikes: Spikes
    edges: Float[np.ndarray, " edges"]
    start: int

    @classmethod
    def read(
        cls, read: Callable[[int, int], Spikes], first: int, last: int, tiles: _Tiles, settings: LightSettings
    ) -> "_Stretch":
        """The frames from `first` to `last`."""
        spikes = read(first, last)
        return cls(spikes, _edges(spikes, tiles, settings), first)

    @property
    def pictures(self) -> tuple[Spikes, Float[np.ndarray, " edges"]]:
        """Spikes and edges."""
        return self.spikes, self.edges

    @property
    def time(self) -> Float[np.ndarray, " n"]:
        """Middle of each picture, frames from the clip's first."""
        return (self.edges[1:] + self.edges[:-1]) / 2 + self.start

    def around(self, frames: int, margin: int) -> "_Stretch":
        """The pictures of the clip of so many frames, and those of a margin."""
        begin, end = max(self.start, -margin), min(self.start + len(self.spikes), frames + margin)
        kept = (self.edges + self.start >= begin) & (self.edges + self.start <= end - 1)
        spikes = self.spikes[begin - self.start : end - self.start]
        return _Stretch(spikes, self.edges[kept] + self.start - begin, begin)


def _edges(spikes: Spikes, tiles: _Tiles, settings: LightSettings) -> Float[np.ndarray, " edges"]:
    """Edges of the short pictures: from where most pixels have fired to where most fire for the last time."""
    frames = len(spikes)
    times = SpikeTimes.of(tiles.cut(spikes))
    fired = times.count > 0
    if not fired.any():
        return np.zeros(0)
    gaps = times.first[fired], frames - 1 - times.last[fired]
    early, late = (min(int(np.quantile(gap, settings.measured_share)), frames // 4) for gap in gaps)
    number = (frames - 1 - early - late) // settings.frames_per_picture
    return np.linspace(early, frames - 1 - late, number + 1)


def _courses(
    spikes: Spikes,
    edges: Float[np.ndarray, " edges"],
    tiles: _Tiles,
    good: Bool[np.ndarray, "h w"],
    light: Light | None,
    settings: LightSettings,
) -> Courses:
    """Logarithm of the light in each picture between these edges, of mean 0, by tile; what `light` leaves of it,
    where that is given."""
    lit = None
    if light is not None:
        share = light.share if light.uniform else tiles.cut(light.share).reshape(len(light.share), -1, tiles.side)
        lit = dataclasses.replace(light, share=share)
    fired = tiles.cut(spikes)
    below = fired.reshape(len(fired), -1, tiles.side)
    pictures = interval_rates(below, edges, white_rate=1.0, light=lit).reshape(-1, *fired.shape[1:])
    # Where a pixel fires in nearly every frame, it does not tell more light from less.
    used = tiles.cut(good) & (fired.mean(0) < settings.saturated_rate)

    def smoothed(of: np.ndarray) -> np.ndarray:
        sigma = (0,) * (of.ndim - 2) + (settings.presmoothing_px,) * 2
        return gaussian_filter(of, sigma, mode="nearest")

    share = np.maximum(smoothed(used.astype(np.float32)), 1e-3)
    pictures = smoothed(pictures * used) / share
    change, mean = np.diff(pictures, axis=0), (pictures[1:] + pictures[:-1]) / 2
    down, right = (np.asarray(np.gradient(mean, axis=axis)) for axis in (2, 3))
    # Noise grows with the light.
    weight = used / (pictures.mean(0) + settings.dark_rate)

    def product(one: np.ndarray, other: np.ndarray) -> Float[np.ndarray, "steps tiles"]:
        return np.einsum("pyx,npyx,npyx->np", weight, one, other)

    tiny = np.float32(1e-9)
    square = product(mean, mean) + tiny
    step, by_down, by_right = (product(mean, of) / square for of in (change, down, right))
    begins = np.arange(0, len(change), settings.steps_of_a_velocity)

    def over(one: np.ndarray, other: np.ndarray, less: np.ndarray) -> Float[np.ndarray, "stretches tiles"]:
        return np.add.reduceat(product(one, other) - square * less, begins, axis=0)

    a, b, d = over(down, down, by_down**2), over(down, right, by_down * by_right), over(right, right, by_right**2)
    e, f = over(down, change, by_down * step), over(right, change, by_right * step)
    determinant = a * d - b * b + tiny + 1e-6 * a * d
    moved = np.stack([d * e - b * f, a * f - b * e]) / determinant
    moved = np.repeat(moved, np.diff(np.append(begins, len(change))), axis=1)
    steps = step - moved[0] * by_down - moved[1] * by_right
    courses = np.pad(np.cumsum(steps, axis=0), ((1, 0), (0, 0))).T
    return courses - courses.mean(1, keepdims=True)


def _around(courses: Courses, tiles: _Tiles) -> Courses:
    """Median course of the tiles beside each, by side and by corner."""
    rows, columns = tiles.grid
    field = np.pad(courses.reshape(rows, columns, -1), ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    beside = [
        field[1 + i : 1 + i + rows, 1 + j : 1 + j + columns] for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)
    ]
    return np.nanmedian(np.stack(beside), axis=0).reshape(courses.shape)


def _agreeing(courses: Courses, tiles: _Tiles, settings: LightSettings) -> Bool[np.ndarray, " tiles"]:
    """Tiles whose light changes, and as that of the tiles beside them does."""
    if len(courses) < 2:
        return np.zeros(len(courses), bool)
    change, apart = courses.std(1), (courses - _around(courses, tiles)).std(1)
    return (change > settings.least_change) & (change > settings.agreement * apart)


def _flickers(courses: Courses, changing: Bool[np.ndarray, " tiles"], settings: LightSettings) -> bool:
    """Whether the light changes: in enough tiles, or in their mean by more than it could by chance."""
    share = changing.mean() if changing.sum() >= settings.least_tiles else 0.0
    if share >= settings.least_share:
        return True
    if share < settings.least_common_share:
        return False
    common = _common(courses)
    chance = np.median((courses - common).std(1)) / len(courses) ** 0.5
    return bool(common.std() > max(settings.least_common_change, settings.deviations * chance))


def _suspicious(courses: Courses, changing: Bool[np.ndarray, " tiles"], settings: LightSettings) -> bool:
    """Whether the light may change, so that it is worth looking at more frames."""
    lower = dataclasses.replace(
        settings,
        least_share=settings.suspicious_ratio * settings.least_share,
        least_common_change=settings.suspicious_ratio * settings.least_common_change,
        least_common_share=0.0,
        least_tiles=0,
        deviations=settings.suspicious_ratio * settings.deviations,
    )
    return _flickers(courses, changing, lower)


def _common(courses: Courses) -> Float[np.ndarray, " n"]:
    """Mean of the courses, those far from the others left out (Geman and McClure's weights)."""
    common = np.median(courses, axis=0)
    for _ in range(8):
        distance = ((courses - common) ** 2).mean(1)
        weight = 1 / (1 + distance / (np.median(distance) + 1e-9)) ** 2
        common = weight @ courses / weight.sum()
    return common


def _light_of(
    longer: _Stretch,
    frames: int,
    tiles: _Tiles,
    some: _Tiles,
    good: Bool[np.ndarray, "h w"],
    settings: LightSettings,
) -> Light:
    """The light of a clip of so many frames in which it changes, from a stretch around it."""

    def lights(of: _Stretch, tiles: _Tiles) -> Courses:
        """The light of each tile. In dim light a pixel's intervals reach over several pictures, so that changes look
        smaller than they are: what is left of them over a first course is looked at again."""
        found = np.exp(_common(_courses(*of.pictures, tiles, good, None, settings)))
        now = Light(of.time - of.start, found[None], np.ones((1, 1, 1)))
        return now.at(now.time)[:, 0, 0] * np.exp(_courses(*of.pictures, tiles, good, now, settings))

    # Frames beyond the clip's ends, too: there most pixels are between two of their spikes.
    near = longer.around(frames, settings.margin_frames)
    every, time = lights(near, tiles), near.time
    every /= every[:, (time > 0) & (time < frames - 1)].mean(1, keepdims=True)
    common = _common(every)
    parts = _lamps(every - common, tiles, settings)

    whole, moments = lights(longer, some), longer.time
    frequency = _frequency(moments, _common(whole / whole.mean(1, keepdims=True)), settings)
    mean, depth = _mean_and_depth(moments, whole, frequency)
    levels = whole[:, (moments > 0) & (moments < frames - 1)].mean(1) / mean

    def map_of(values: Float[np.ndarray, " tiles"]) -> Float[np.ndarray, "h w"]:
        return _enlarged(values.reshape(tiles.grid), good.shape)

    if not parts:
        return Light(time, common[None], np.full((1, 1, 1), np.median(levels)), frequency, depth)
    fit = np.stack([np.ones(len(levels)), *(_at_tiles(amount, tiles, some) for amount, _ in parts)])
    numbers = np.linalg.lstsq(fit.T, levels, rcond=None)[0]
    amounts = np.stack([map_of(amount) for amount, _ in parts])
    level = numbers[0] + np.einsum("r,ryx->yx", numbers[1:], amounts)
    share = np.concatenate([level[None], level * amounts])
    return Light(time, np.stack([common, *(course for _, course in parts)]), share, frequency, depth)


def _lamps(
    deviations: Courses, tiles: _Tiles, settings: LightSettings
) -> list[tuple[Float[np.ndarray, " tiles"], Float[np.ndarray, " n"]]]:
    """Further lamps: for each, how much of it every tile gets, and its course, beside the light common to all tiles.

    A lamp more is taken as long as enough tiles differ from the common course as the tiles beside them do.
    """
    found = []
    for _ in range(settings.most_lamps - 1):
        if _agreeing(deviations, tiles, settings).mean() < settings.lamp_share:
            break
        # The course that most tiles have some of: of each no more counts than is usual.
        size = deviations.std(1, keepdims=True)
        course = np.linalg.svd(deviations / np.maximum(size, np.median(size)), full_matrices=False)[2][0]
        amount = deviations @ course
        found.append((amount, course))
        deviations = deviations - amount[:, None] * course
    return found


def _at_tiles(values: Float[np.ndarray, " tiles"], tiles: _Tiles, some: _Tiles) -> Float[np.ndarray, " some"]:
    """The values of some of the tiles."""
    number = {place: k for k, place in enumerate(zip(tiles.top.tolist(), tiles.left.tolist(), strict=True))}
    return values[[number[place] for place in zip(some.top.tolist(), some.left.tolist(), strict=True)]]


def _enlarged(values: Float[np.ndarray, "rows columns"], shape: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    """A value for each pixel, straight between the middles of tiles."""
    places = [(np.arange(n) + 0.5) * m / n - 0.5 for n, m in zip(shape, values.shape, strict=True)]
    return map_coordinates(values, np.meshgrid(*places, indexing="ij"), order=1, mode="nearest")


def _frequency(time: Float[np.ndarray, " n"], light: Float[np.ndarray, " n"], settings: LightSettings) -> float | None:
    """Frequency, cycles per frame, of the wave that explains most of this course; None if it explains too little."""
    span = time[-1] - time[0]
    tried = np.geomspace(settings.least_cycles / span, 1 / (4 * settings.frames_per_picture), 400)
    explained = [_explained(time, light, one) for one in tried]
    best = int(np.argmax(explained))
    close = np.linspace(tried[max(best - 1, 0)], tried[min(best + 1, tried.size - 1)], 41)
    finest = max(close, key=lambda one: _explained(time, light, one))
    return float(finest) if _explained(time, light, finest) >= settings.explained_share else None


def _waves(time: Float[np.ndarray, " n"], frequency: float) -> Float[np.ndarray, "n 3"]:
    phase = 2 * np.pi * frequency * time
    return np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=1)


def _explained(time: Float[np.ndarray, " n"], light: Float[np.ndarray, " n"], frequency: float) -> float:
    waves = _waves(time, frequency)
    left = light - waves @ np.linalg.lstsq(waves, light, rcond=None)[0]
    return 1 - float(np.sum(left**2) / np.sum((light - light.mean()) ** 2))


def _mean_and_depth(
    time: Float[np.ndarray, " n"], light: Courses, frequency: float | None
) -> tuple[Float[np.ndarray, " tiles"], float]:
    """Mean of each course, over whole cycles where the light repeats, and the median of their swings over it."""
    if frequency is None:
        common = _common(light / light.mean(1, keepdims=True))
        return light.mean(1), float(np.ptp(common) / (common.max() + common.min()))
    mean, even, odd = np.linalg.lstsq(_waves(time, frequency), light.T, rcond=None)[0]
    return mean, float(np.median(np.hypot(even, odd) / mean))
