"""Which motion a recording shows: none, one for the whole scene, or one for each pixel."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from scsr_opt.errors import InputError
from scsr_opt.motion.alignment import Stretches, drift, presmoothed, smooth, stretches
from scsr_opt.motion.dense import dense
from scsr_opt.motion.parametric import parametric
from scsr_opt.motion.trajectory import Motion

# A pixel contradicts a motion if another velocity in its window would explain the recording better by this much
# (likelihood ratio; χ² with 2 degrees of freedom if the noise were white, so that 100 would never be met by chance: on
# recordings of still scenes the largest value seen was 80, the median 3.5), and would take it more than half a pixel
# elsewhere.
_CONTRADICTION = 100.0
_DRIFT = 0.5
_WINDOW = 3.0
# The share of the pixels that may contradict before the next richer motion is tried: of nothing moves, of one motion
# for all.
_TOLERATED_AT_REST = 0.001
_TOLERATED_GLOBAL = 0.01


class Estimator(eqx.Module):
    """How the motion is found; called by `reconstruct` with the recording's stretches."""

    def __call__(self, pictures: Stretches) -> Motion:
        raise NotImplementedError


class Still(Estimator):
    """Nothing moves."""

    def __call__(self, pictures: Stretches) -> Motion:
        return Motion.none(*pictures.picture.shape[1:])


class Global(Estimator):
    """One motion for the whole scene (`parametric`): affine, or a translation only."""

    affine: bool = True

    def __call__(self, pictures: Stretches) -> Motion:
        return parametric(pictures, affine=self.affine)


class Dense(Estimator):
    """A velocity for each pixel (`dense`)."""

    def __call__(self, pictures: Stretches) -> Motion:
        return dense(pictures)


class Automatic(Estimator):
    """The simplest motion that the recording does not contradict: none, one affine motion for all, or a dense one.

    Few numbers are estimated far better than many, so the richer ones are used only where they are needed. A dense
    estimate starts from the global one where that explains most of the picture.
    """

    def __call__(self, pictures: Stretches) -> Motion:
        still = Motion.none(*pictures.picture.shape[1:])
        moving = contradicted(pictures, still).mean()
        if moving <= _TOLERATED_AT_REST:
            return still
        together = parametric(pictures)
        left = contradicted(pictures, together).mean()
        if left <= _TOLERATED_GLOBAL:
            return together
        return dense(pictures, start=together if left < moving / 2 else still)


def contradicted(pictures: Stretches, motion: Motion) -> np.ndarray:
    """(h, w) bool: where the recording contradicts `motion`, see above."""
    evidence, drifted = _evidence(
        presmoothed(pictures, 1.0), jnp.asarray(motion.velocity), jnp.asarray(motion.acceleration), jnp.asarray(_WINDOW)
    )
    return np.asarray((evidence > _CONTRADICTION) & (drifted > _DRIFT))


@jax.jit
def _evidence(
    pictures: Stretches,
    velocity: Float[Array, "2 h w"],
    acceleration: Float[Array, "2 h w"],
    window: Float[Array, ""],
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Score test of each window's velocity: twice the gain in log-likelihood of the best one, and how far that goes."""
    now = drift(pictures.picture, pictures.after, jnp.ones_like(pictures.after), velocity, acceleration)
    noise = smooth(now.residual / jnp.maximum(now.seen, 1), window) + 1e-8
    samples = 4 * np.pi * window**2  # effective number of pixels in a Gaussian window
    information = smooth(now.spread[:1, :1] * now.slope[:, None] * now.slope[None], window) / noise[None, None] * samples
    pull = -smooth(now.change[:1] * now.slope, window) / noise[None] * samples
    a, b, d = information[0, 0] + 1e-3, information[0, 1], information[1, 1] + 1e-3
    update = jnp.stack([d * pull[0] - b * pull[1], a * pull[1] - b * pull[0]]) / (a * d - b * b)[None]
    longest = jnp.max(jnp.abs(pictures.after))
    return (pull * update).sum(0), jnp.sqrt((update**2).sum(0)) * longest


def estimate(
    spikes: Shaped[np.ndarray, "T h w"],
    *,
    key: int,
    white_rate: float | int = 0.6,
    estimator: Estimator | None = None,
    bad_pixels: np.ndarray | None = None,
) -> Motion:
    """The motion around frame `key` (index into `spikes`) by `estimator`, `Automatic` if not given.

    Pixels in `bad_pixels` are filled from their neighbours before anything is compared. A recording of fewer than three
    frames shows no motion.
    """
    frames, height, width = spikes.shape
    if frames < 3 or min(height, width) < 2:
        return Motion.none(height, width)
    pictures = stretches(spikes, key=key, white_rate=white_rate)
    if bad_pixels is not None and bad_pixels.any():
        pictures = pictures._replace(picture=filled(pictures.picture, ~bad_pixels))
    return (Automatic() if estimator is None else estimator)(pictures)


def filled(pictures: Float[Array, "n h w"], good: np.ndarray) -> Float[Array, "n h w"]:
    """The pictures with all but the good pixels replaced by a Gaussian mean of good ones around them."""
    weight = jnp.asarray(good, pictures.dtype)
    reach = jnp.asarray(1.0)
    nearby = smooth(pictures * weight[None], reach) / jnp.maximum(smooth(weight, reach), 1e-6)[None]
    return jnp.where(jnp.asarray(good)[None], pictures, nearby)


def given(velocity: np.ndarray, height: int, width: int) -> Motion:
    """A velocity handed in by the user: (2, h, w), or two numbers for the whole scene; sensor pixels per frame.

    **Errors:** `InputError` for another shape or values that are not finite.
    """
    field = np.asarray(velocity, np.float32)
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
