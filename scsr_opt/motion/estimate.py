"""Which motion a recording shows: none, one for the whole scene, one for each layer, or one for each pixel."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter, minimum_filter

from scsr_opt.errors import InputError
from scsr_opt.motion.alignment import Stretches, smooth, stretches
from scsr_opt.motion.dense import dense
from scsr_opt.motion.estimator import Estimator
from scsr_opt.motion.evidence import contradicted, mispredicted, missed, typical_noise
from scsr_opt.motion.layers import layered
from scsr_opt.motion.parametric import parametric
from scsr_opt.motion.phase import PhaseCorrelation
from scsr_opt.motion.trajectory import Motion
from scsr_opt.motion.trust import trusted

# The share of the pixels that may contradict before the next richer motion is tried: of nothing moves, of one motion
# for all.
_TOLERATED_AT_REST = 0.001
_TOLERATED_GLOBAL = 0.01
# What must be left of what contradicted the background, at most, for anything richer to be believed.
_HELPS = 0.8
# Layers know of edges and of what is hidden, which the dense estimate does not. They are not believed where labels are
# so scattered that most pixels lie near an edge between them (within so many pixels): in 6 of 22 scenes, where the
# dense estimate then was up to 3 dB better.
_EDGE = 3
_SCATTERED = 0.5
# Nor where they predict the recording worse than it, by more than this factor.
_WORSE = 1.01


class Still(Estimator):
    """Nothing moves."""

    def __call__(self, pictures: Stretches) -> Motion:
        return Motion.none(*pictures.picture.shape[1:])


class Global(Estimator):
    """One motion for the whole scene (`together`): affine, or a translation only."""

    affine: bool = True

    def __call__(self, pictures: Stretches) -> Motion:
        return together(pictures, affine=self.affine)[0]


class Dense(Estimator):
    """A velocity for each pixel (`dense`); no edges, no occlusion."""

    def __call__(self, pictures: Stretches) -> Motion:
        return dense(pictures)


class Automatic(Estimator):
    """The simplest motion that the recording does not contradict: none, one affine motion for all, or layers.

    Few numbers are estimated far better than many, so the richer ones are used only where they are needed.
    """

    def __call__(self, pictures: Stretches) -> Motion:
        still = Motion.none(*pictures.picture.shape[1:])
        moving = contradicted(pictures, still).mean()
        if moving <= _TOLERATED_AT_REST:
            return still
        whole, left = together(pictures)
        if left <= _TOLERATED_GLOBAL:
            return whole
        background, unexplained = (whole, left) if left < moving / 2 else (still, moving)
        everywhere = dense(pictures, start=background)
        layers = layered(pictures, background, everywhere)
        motion = layers if _serve(pictures, layers, everywhere) else everywhere
        # A recording of noise contradicts any motion: then more of it explains nothing, or predicts nothing.
        helps = contradicted(pictures, motion).mean() < _HELPS * unexplained
        noise = typical_noise(pictures, everywhere)
        better = helps and mispredicted(pictures, motion, noise) < mispredicted(pictures, background, noise)
        return motion if better else background


def _serve(pictures: Stretches, layers: Motion, everywhere: Motion) -> bool:
    """Do the layers predict the recording as well as the dense estimate does, where they say that something is seen?"""
    if layers.layers is None:
        return True
    label = layers.layers.label
    inner = maximum_filter(label, 2 * _EDGE + 1) == minimum_filter(label, 2 * _EDGE + 1)
    if inner.mean() < _SCATTERED:
        return False
    noise = typical_noise(pictures, everywhere)
    (by_layers, seen), (by_pixel, inside) = (missed(pictures, motion, noise) for motion in (layers, everywhere))
    both = (seen > 0.5) & (inside > 0.5)
    return bool(by_layers[both].mean() <= _WORSE * by_pixel[both].mean())


def together(pictures: Stretches, *, affine: bool = True) -> tuple[Motion, float]:
    """One motion for the whole scene (`parametric`), and the share of the pixels that contradict it.

    Where that is too much, phase correlation gives another start, if it is itself contradicted by fewer. In dim light
    near times, by which the fit begins, show nothing: at 0.12 spikes per frame of white it missed 0.3 px per frame by
    0.27 from rest, by 0.03 from there.
    """
    motion = parametric(pictures, affine=affine)
    left = _left(pictures, motion)
    start = PhaseCorrelation()(pictures) if left > _TOLERATED_GLOBAL else None
    if start is not None and _left(pictures, start) < left:
        other = parametric(pictures, affine=affine, start=start)
        left_then = _left(pictures, other)
        if left_then < left:
            return other, left_then
    return motion, left


def _left(pictures: Stretches, motion: Motion) -> float:
    """The share of the pixels that contradict a motion of the whole scene; all, if it carries most out of view."""
    longest = float(jnp.max(jnp.abs(pictures.after)))
    leaves = np.abs(np.median(motion.velocity, axis=(1, 2))) * longest > 0.5 * np.array(pictures.picture.shape[1:])
    return 1.0 if leaves.any() else float(contradicted(pictures, motion).mean())


def estimate_motion(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    key: int,
    white_rate: float | int = 0.6,
    estimator: Estimator | None = None,
    bad_pixels: np.ndarray | None = None,
) -> Motion:
    """The motion around frame `key` (index into `spikes`) by `estimator`, `Automatic` if not given, with its trust.

    Pixels in `bad_pixels` are filled from their neighbours before anything is compared. A recording of fewer than three
    frames shows no motion.
    """
    frames, height, width = spikes.shape
    if frames < 3 or min(height, width) < 2:
        return Motion.none(height, width)
    pictures = stretches(spikes, key=key, white_rate=white_rate)
    if bad_pixels is not None and bad_pixels.any():
        pictures = pictures._replace(picture=filled(pictures.picture, ~bad_pixels))
    motion = (Automatic() if estimator is None else estimator)(pictures)
    return trusted(pictures, motion)


def filled(pictures: Float[Array, "n h w"], good: np.ndarray) -> Float[Array, "n h w"]:
    """The pictures with all but the good pixels replaced by a Gaussian mean of good ones around them."""
    weight = jnp.asarray(good, pictures.dtype)
    reach = jnp.asarray(1.0)
    nearby = smooth(pictures * weight[None], reach) / jnp.maximum(smooth(weight, reach), 1e-6)[None]
    return jnp.where(jnp.asarray(good)[None], pictures, nearby)


def given(velocity: ArrayLike | Sequence[float | int], height: int, width: int) -> Motion:
    """A velocity handed in by the user: (2, h, w), or two numbers for the whole scene; sensor pixels per frame.

    **Errors:** `InputError` for another shape or values that are not finite.
    """
    try:
        field = np.asarray(velocity, np.float32)
    except (TypeError, ValueError):
        raise InputError(
            f"velocity is {velocity!r}; it must be an array of shape (2, {height}, {width}), two numbers (rows, "
            "columns) in sensor pixels per frame, or an Estimator."
        ) from None
    if field.shape == (2,):
        field = np.broadcast_to(field[:, None, None], (2, height, width)).copy()
    if field.shape != (2, height, width):
        raise InputError(
            f"velocity has shape {np.shape(velocity)}; it must be (2, {height}, {width}) or two numbers "
            "(rows, columns), in sensor pixels per frame."
        )
    if not np.isfinite(field).all():
        raise InputError(
            f"velocity holds {int((~np.isfinite(field)).sum())} values that are not finite; use 0 where it is unknown."
        )
    return Motion.of_velocity(field)
