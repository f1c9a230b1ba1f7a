"""Shares of the light of several lamps that each pixel of a sensor gets.

`scsr_opt.motion.light` finds the course of each lamp and how much of it every tile of the sensor gets. With the motion
known, each pixel's share is found (`along_motion`); where each lamp lights a part of the sensor of its own, the parts'
edges are then moved to where a picture explains the samples best (`parts_by`).
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, median_filter, minimum_filter

from scsr_opt.camera.light import Light
from scsr_opt.camera.samples import Samples
from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.light_settings import LightSettings
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.short_borders import with_short_borders
from scsr_opt.motion.trajectory import Motion, key_frame_positions


def along_motion(light: Light, pictures: MotionFrames, motion: Motion, key: int, settings: MotionSettings) -> Light:
    """`light` with the share that each pixel has of every lamp, where tiles have had one until now.

    With the motion known, light steps by δ = ΣMD / ΣM² over a window, D and M being difference and mean of neighbouring
    pictures half a step before and after along the motion: windows may then be as small as noise allows. The shares A
    are those of least squares in (course of the window) = common + Σ A·course.

    **Arguments:** `pictures` over `light`; `motion`, found by them; `key`, frames of the key frame after the clip's
    first.
    """
    limits, after = settings.light, np.asarray(pictures.after)
    time, level = after + key, light.share[0]
    taken = np.asarray(pictures.picture)
    height, width = level.shape
    here = np.indices((height, width), np.float32)
    position, _ = key_frame_positions(motion, (after[1:] + after[:-1]) / 2, settings=settings.trajectory)
    row, column = (
        np.clip(np.rint(of), 0, most - 1).astype(int)
        for of, most in zip(np.moveaxis(np.asarray(position), 1, 0), (height, width), strict=True)
    )
    half = np.diff(after)[:, None, None, None] / 2 * np.moveaxis(motion.velocity[:, row, column], 0, 1)
    earlier, later = (
        np.stack(
            [map_coordinates(each, here + way * by, order=1, mode="nearest") for each, by in zip(of, half, strict=True)]
        )
        for of, way in ((taken[:-1], -1), (taken[1:], 1))
    )

    def summed(values: Float[np.ndarray, "n h w"]) -> Float[np.ndarray, "n h w"]:
        return gaussian_filter(values, (0, limits.edge_px, limits.edge_px), mode="nearest", truncate=3)

    mean = (later + earlier) / 2
    weight = mean / (mean.mean(0) + limits.dark_rate)
    steps = summed(weight * (later - earlier)) / (summed(weight * mean) + np.float32(1e-6))
    # Where the scene changes at once, as at a cut, steps add up to more than numbers can hold.
    steps = np.clip(steps, -limits.most_step, limits.most_step)
    # Edges of the light rest while the scene passes them, and seem to be steps: not over the light that is known.
    seen = light.at(time) * np.exp(np.pad(np.cumsum(steps, axis=0), ((1, 0), (0, 0), (0, 0))))
    common, *courses = (np.interp(time, light.time, course) for course in light.course)
    seen *= common.mean() / seen.mean(0)
    basis = np.stack(courses)
    basis -= basis.mean(1, keepdims=True)
    amounts = np.einsum("rn,nyx->ryx", np.linalg.pinv(basis).T, seen - common[:, None, None])
    before = light.share[1:] / level
    amounts = median_filter(amounts, (1, limits.edge_median_px, limits.edge_median_px), mode="nearest")
    amounts = np.stack([_apart(*each, limits) for each in zip(amounts, before, strict=True)])
    known = np.stack([np.ones(level.size), *before.reshape(len(before), -1)])
    numbers = np.linalg.lstsq(known.T, level.reshape(-1), rcond=None)[0]
    level = np.clip(numbers[0] + np.einsum("r,ryx->yx", numbers[1:], amounts), level.min(), level.max())
    return dataclasses.replace(light, share=np.concatenate([level[None], level * amounts]))


def _apart(
    amount: Float[np.ndarray, "h w"], before: Float[np.ndarray, "h w"], settings: LightSettings
) -> Float[np.ndarray, "h w"]:
    """The amounts within the range that they had before; one of two, where most pixels had nearly one or the other: of
    lamps that light parts of their own, no pixel at the edge has a mean."""
    least, most = before.min(), before.max()
    middle = (least + most) / 2
    if not middle < most:  # all pixels have as much of it
        return np.full_like(amount, least)
    low, high = (np.median(before[side]) for side in (before <= middle, before > middle))
    near = settings.apart_tolerance * (high - low)
    if (np.minimum(abs(before - low), abs(before - high)) <= near).mean() < settings.apart_share:
        return np.clip(amount, least, most)
    return np.where(amount <= (low + high) / 2, low, high)


class Parts(NamedTuple):
    """Parts of a sensor, each in the light of a lamp of its own.

    **Fields:** `share`: (k, parts), shares of the courses of a light in each; `number`: (h, w), the part of each pixel.
    """

    share: Float[np.ndarray, "k parts"]
    number: Int[np.ndarray, "h w"]

    def edge(self, px: int) -> Bool[np.ndarray, "h w"]:
        """Pixels that have one of another part within `px` rows and columns."""
        side = 2 * px + 1
        return maximum_filter(self.number, side) != minimum_filter(self.number, side)


def parts_of(light: Light, settings: LightSettings = DEFAULTS.light) -> Parts | None:
    """The parts of the sensor that lamps light; None where their light passes from one into the other."""
    share, number = np.unique(light.share.reshape(len(light.share), -1), axis=1, return_inverse=True)
    if light.uniform or not 1 < share.shape[1] <= 2 ** (settings.most_lamps - 1):
        return None
    return Parts(share, number.reshape(light.share.shape[1:]))


def parts_by(
    light: Light,
    parts: Parts,
    samples: Samples,
    predicted: Float[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"],
    coverage: Float[np.ndarray, " n"],
    settings: LightSettings = DEFAULTS.light,
) -> Parts:
    """`parts` of a light, the pixels near their edges in those whose light explains their samples, with short borders.

    A sample has measured M = Y ℓ, ℓ being the mean light of its exposure, of a picture that predicts P there. In part k
    it would have measured g P ℓ_k, where g, one number for each pixel, is the error of the prediction: N(1, τ²), with
    a τ that grows the less was seen of what the pixel sees. The misfit of part k is twice its negative log-likelihood:
    the least of Σ ω (M − g P ℓ_k)² / σ² + (g − 1)² / τ² over g, plus ln(1 + τ² Σ ω (P ℓ_k)² / σ²).

    **Arguments:** `samples`, corrected by `light`; `predicted` (n,), what a picture that was solved for without pixels
    near edges predicts for them, times the pixel's gain; `weight` (n,); `coverage` (n,), the weight of the samples of
    that picture where each sample looks, 1 in the mean.
    """
    shape, size = parts.number.shape, parts.number.size
    pixel = samples.row * np.int32(shape[1]) + samples.column
    each = [Light(light.time, course[None], np.ones((1, 1, 1))) for course in light.course]
    start, stop = np.asarray(samples.start), np.asarray(samples.stop)
    duration = np.maximum(stop - start, np.float32(1e-3))
    over = np.stack([(one.gathered(stop) - one.gathered(start)) / duration for one in each])
    light_now = np.einsum("kn,kn->n", parts.share[:, parts.number.reshape(-1)[pixel]], over)
    measured = samples.value * light_now

    def summed(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " hw"]:
        return np.bincount(pixel, values, size)

    number, total = summed((weight > 0).astype(float)), summed(weight)
    usual = summed(weight * (measured - predicted * light_now) ** 2)[number > 0] / number[number > 0]
    noise = max(float(np.median(usual)) if usual.size else 0.0, float(np.finfo(np.float32).tiny))  # σ²
    seen = summed(weight * coverage) / np.where(total > 0, total, 1)
    spread = settings.prediction_error
    precision = (np.maximum(seen, spread) / spread) ** 2  # 1/τ²

    def misfit(share: Float[np.ndarray, " k"]) -> Float[np.ndarray, "h w"]:
        there = predicted * (share @ over)
        square, product, energy = (summed(weight * of) / noise for of in (there**2, there * measured, measured**2))
        least = energy + precision - (product + precision) ** 2 / (square + precision)
        return (least + np.log1p(square / precision)).reshape(shape)

    cost = np.stack([misfit(share) / 2 for share in parts.share.T])
    cost = np.minimum(cost - cost.min(0), settings.most_evidence)
    near = parts.edge(settings.uncertain_px)
    return parts._replace(number=with_short_borders(cost, parts.number, near, settings.border_evidence))
