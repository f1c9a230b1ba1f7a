"""Summary of a scene for people: what each part of it needed, found from motion and samples.

It decides nothing: `Shortcuts` lists what work may be left out, and docs/architecture.md where. Each tile of the sensor
gets one `TileKind` by these tests of its spikes:

- *Moving or at rest*: by how long what a pixel sees hardly moves (`measure`), which follows from the motion.
- *Dark, saturated, uniform*: by the numbers of spikes in the tile, each with a false-alarm rate of 0.1 %.
- *Fast*: by the share of the samples whose place in the key frame is known and in view.
"""

import enum
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.special import chdtri, ndtri  # scipy.stats takes a third of a second to import

from scsr_opt.camera.saturation import SATURATED_SHARE, spike_counts
from scsr_opt.motion.trajectory import Motion
from scsr_opt.pipeline.settings import SceneSummarySettings


class TileKind(enum.IntEnum):
    """Kind of a tile. Where several apply, the first of `SATURATED`, `DARK`, `FAST` counts before the others."""

    STATIC = 0
    UNIFORM = 1
    MOVING = 2
    DARK = 3
    FAST = 4
    SATURATED = 5


# Where nothing moves, and why its measurements may not be merged all the same.
_AT_REST = "nothing moves; all spikes of a pixel are merged into one measurement"
_APART = "nothing moves; measurements are kept apart, as merging would save little or each is to be judged"
_REASONS = {
    TileKind.STATIC: _AT_REST,
    TileKind.UNIFORM: "nothing moves, all is equally bright; all spikes of a pixel are merged into one measurement",
    TileKind.MOVING: "something moves or changes; each interval between spikes has its own place; slow ones are merged",
    TileKind.DARK: "fewer than {dark_spikes:g} spikes a pixel; all are used, and the prior smooths the picture",
    TileKind.FAST: "most of what is seen there is hidden or out of view in the key frame; those intervals are left out",
    TileKind.SATURATED: f"pixels fire in {100 * SATURATED_SHARE:g} % of the frames or more; each run of spikes is "
    "merged into one measurement",
}


@dataclass(frozen=True)
class SceneSummary:
    """Kinds of the tiles of the sensor, and how many samples were used.

    **Fields:**
    - `kind`: (rows, columns) of `TileKind`, tiles of `tile` × `tile` sensor pixels (the last ones may be smaller).
    - `merged_for`: (rows, columns), frames over which a pixel's intervals are merged, the least in the tile.
    - `used`: (rows, columns), the share of the light whose place in the key frame is known and in view.
    - `scene`: the motion of the whole: "at rest", "one motion", "layers" or "a motion for each pixel".
    - `intervals`: measurements that there would be if nothing were left out; `samples`: those that are used.
    - `settings`: limits of the kinds.
    """

    kind: Int[np.ndarray, "rows columns"]
    merged_for: Int[np.ndarray, "rows columns"]
    used: Float[np.ndarray, "rows columns"]
    scene: str
    intervals: int
    samples: int
    settings: SceneSummarySettings = field(default_factory=SceneSummarySettings)

    @property
    def tile(self) -> int:
        """Side of a tile, sensor pixels."""
        return self.settings.tile_px

    def unmerged(self) -> "SceneSummary":
        """The summary where no samples could be merged: all of them are used."""
        return replace(self, intervals=self.samples)

    def share(self, kind: TileKind) -> float:
        """The share of the tiles that are of a kind."""
        return float(np.mean(self.kind == kind))

    def reason(self, kind: TileKind) -> str:
        """A sentence on how tiles of a kind are handled."""
        merged = bool((self.merged_for[self.kind == kind] > 1).any())
        reason = _APART if kind is TileKind.STATIC and not merged else _REASONS[kind]
        return reason.format(dark_spikes=self.settings.dark_spikes)

    @property
    def numbers(self) -> dict[str, Any]:
        """For a report: shares of the tiles by kind, and how many measurements there are instead of how many."""
        shares = {kind.name.lower(): round(self.share(kind), 4) for kind in TileKind}
        return {"scene": self.scene, "tiles": shares, "intervals": self.intervals, "samples": self.samples}

    def lines(self) -> list[str]:
        """Sentences for people: the scene, its samples, and how each kind of tile was handled."""
        saved = 100 * max(1 - self.samples / max(self.intervals, 1), 0)
        instead = f" instead of {self.intervals:,} ({saved:.0f} % fewer)" if self.samples != self.intervals else ""
        text = [
            f"Scene: {self.scene}.",
            f"Measurements: {self.samples:,}{instead}.",
            f"Share of the sensor, by squares of {self.tile}x{self.tile} pixels:",
        ]
        for kind in sorted(TileKind, key=self.share, reverse=True):
            share = 100 * self.share(kind)
            if share > 0:
                text.append(f"  {f'{share:.0f}' if share >= 1 else 'under 1'} %: {self.reason(kind)}.")
        return text


class SampleWeights(NamedTuple):
    """Weights of n samples: `pixel`, (n,), the flattened sensor pixel; `measured`, (n,), the weight before the motion
    is looked at; `placed`, (n,), that of what is in view in the key frame."""

    pixel: Int[np.ndarray, " n"]
    measured: Float[np.ndarray, " n"]
    placed: Float[np.ndarray, " n"]


def summarise_scene(
    spikes: Shaped[np.ndarray, "T h w"],
    motion: Motion,
    still_for: Int[np.ndarray, "h w"],
    merged_for: Int[np.ndarray, "h w"],
    *,
    weights: SampleWeights,
    noise: float,
    bad_pixels: Bool[np.ndarray, "h w"] | None = None,
    settings: SceneSummarySettings = SceneSummarySettings(),
) -> SceneSummary:
    """Summary of a clip, its motion and its samples.

    A tile is uniform if the numbers of spikes of its pixels differ no more than their noise makes them (χ² over the
    tile's pixels, with a false-alarm rate of 0.1 %), and dark or saturated if their mean is below or above the limit by
    more than noise would make it (one side of a normal distribution, the same rate).

    **Arguments:**
    - `still_for`, `merged_for`: frames over which what each pixel sees hardly moves, and those over which its
      intervals were merged.
    - `weights`: of the samples.
    - `noise`: standard deviation of a pixel's mean number of spikes per frame.
    - `bad_pixels`: (h, w), true where spikes are not used; a tile of no other pixels is dark.
    - `settings`: limits of the kinds.
    """
    frames, height, width = spikes.shape
    tile, false_alarms = settings.tile_px, settings.false_alarms
    good = np.ones((height, width), bool) if bad_pixels is None else ~bad_pixels
    count = spike_counts(spikes) * good
    fired = count.astype(np.float32) / np.float32(frames)
    # A pixel whose weight changes for a moment, as chance may have it, makes nothing move.
    still = still_for >= frames
    farthest = motion.speed + np.hypot(*motion.acceleration) * np.float32(frames / 2)
    as_little = np.asarray(farthest <= farthest[still].max(initial=0), np.float32)
    pixels = np.maximum(_tiles(good.astype(np.float32), np.add, tile), 1)
    mean = _tiles(fired, np.add, tile) / pixels
    scatter = _tiles(fired**2, np.add, tile) - pixels * mean**2
    # However regular spikes are, the phase of a pixel's first one is chance: the whole number of them between x and
    # x + 1 then has a variance of up to ¼.
    variance = max(noise**2, 1 / 4 / frames**2)
    flat = scatter <= variance * chdtri(np.maximum(pixels - 1, 1), false_alarms)  # quantiles of χ²
    doubt = -ndtri(false_alarms) * np.sqrt(variance / pixels)

    def of_tiles(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, "rows columns"]:
        summed = np.bincount(weights.pixel, values, minlength=height * width).reshape(height, width)
        return _tiles(summed.astype(np.float32), np.add, tile)

    share = of_tiles(weights.placed) / np.maximum(of_tiles(weights.measured), 1e-9)
    kind = np.full(mean.shape, int(TileKind.MOVING))
    rests = _tiles((still & good).astype(np.float32), np.add, tile) >= settings.still_share * pixels
    rests &= _tiles(as_little, np.minimum, tile) > 0
    kind[rests] = TileKind.STATIC
    kind[rests & flat] = TileKind.UNIFORM
    kind[share < settings.used_share] = TileKind.FAST
    kind[(mean + doubt) * frames < settings.dark_spikes] = TileKind.DARK
    # One spike is of the charge that was there before the first frame.
    kind[mean - doubt - 1 / frames >= SATURATED_SHARE] = TileKind.SATURATED
    return SceneSummary(
        kind=kind,
        merged_for=_tiles(merged_for.astype(np.float32), np.minimum, tile).astype(np.int32),
        used=share.astype(np.float32),
        scene=_scene(motion),
        intervals=int(count.sum()) + int(np.count_nonzero(good)),
        samples=int(np.count_nonzero(weights.placed)),
        settings=settings,
    )


def _scene(motion: Motion) -> str:
    if not motion.moves:
        return "at rest"
    if motion.layers is not None:
        return f"{len(motion.layers.depth)} layers"
    # An affine or perspective field has no third differences.
    third = max(float(np.abs(np.diff(motion.velocity, 3, axis=axis)).max(initial=0)) for axis in (1, 2))
    return "one motion" if third <= 1e-4 * float(np.abs(motion.velocity).max()) else "a motion for each pixel"


def _tiles(values: Float[np.ndarray, "h w"], reduced: np.ufunc, tile: int) -> Float[np.ndarray, "rows columns"]:
    """One number for each tile, from its pixels."""
    rows, columns = (np.arange(0, length, tile) for length in values.shape)
    return reduced.reduceat(reduced.reduceat(values, columns, axis=1), rows, axis=0)
