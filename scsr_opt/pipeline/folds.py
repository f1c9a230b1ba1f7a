"""Choice of the measurements that are held out, to be predicted by a picture made from the others (`StrengthSearch`).

One sample in five is. Where the scene moves by a sensor pixel, other pixels see what this one sees: all samples of one
pixel in five. Where it does not, one stretch of time in five, of eight frames and two intervals at least. Each gap in a
pixel's time adds an error at both its ends, which asks for more of a prior than all samples do. (The numbers are those
of `StrengthSettings`.)
"""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from scsr_opt.camera.samples import Samples
from scsr_opt.pipeline.settings import StrengthSettings

Sums = TypeVar("Sums")


def held_out(
    samples: Samples,
    moved: Float[np.ndarray, "h w"],
    *,
    merged: bool = False,
    settings: StrengthSettings = StrengthSettings(),
) -> Bool[np.ndarray, " n"]:
    """(n,), true for the samples that are held out.

    **Arguments:** `moved`, (h, w), sensor pixels by which the scene moves at each pixel; `merged`: whether samples are
    stretches of time already where nothing moves; `settings`: how many are held out.
    """
    every = settings.held_out_every
    pixel = np.asarray(samples.row) * np.int32(moved.shape[1]) + np.asarray(samples.column)
    whole, phase = moved >= settings.held_out_motion_px, _phase(moved.shape)
    held = (whole & (phase % every == 0)).reshape(-1)[pixel]
    if whole.all():
        return held
    duration = np.asarray(samples.stop - samples.start)
    typical = 0.0 if merged else float(np.average(duration, weights=samples.weight + np.float32(1e-9)))
    length = np.float32(max(settings.held_out_frames, 2 * typical))
    resting = np.flatnonzero(~whole.reshape(-1)[pixel])
    start, stop = (np.asarray(of)[resting] for of in (samples.start, samples.stop))
    stretch = np.floor((start + stop) / (2 * length)).astype(np.int32)
    held[resting] = (stretch + phase.reshape(-1)[pixel[resting]]) % every == 0
    return held


def _phase(shape: tuple[int, ...]) -> Int[np.ndarray, "h w"]:
    """A number for each pixel, (h, w). Modulo `StrengthSettings.held_out_every` it is 0 where a pixel is held out; or
    it is the number of the stretch of time that is, another from pixel to pixel, so that no time is missing.

    Pixels of one number are a knight's move apart, so that no two are neighbours but across the middle of a side of
    even length. Counted from the border inwards, by the farther and the nearer of the two distances: of a mirrored or
    turned recording the same samples are held out. Which ones are moves λ by a tenth, and a picture by 0.02.
    """
    rows, columns = (np.minimum(np.arange(n), np.arange(n)[::-1]).astype(np.int32) for n in shape)
    return 2 * np.maximum(rows[:, None], columns) + np.minimum(rows[:, None], columns)


def light_at_rest(
    spikes: Shaped[np.ndarray, "T h w"], *, ends: float | int, settings: StrengthSettings = StrengthSettings()
) -> Float[np.ndarray, "2 2 h w"]:
    """Sums over the samples of a scene at rest that are kept, [0], and that are held out, [1]: the light that each
    pixel gathered, in thresholds, [0], and the frames that it took, [1].

    The samples are those of `spike_intervals`, split by `held_out`; `ends` as there. They are never made one by one,
    which takes a third of the time.
    """
    fired, phase = spikes.astype(bool, copy=False), _phase(spikes.shape[1:])
    return np.asarray(_light_at_rest(fired, phase, np.float32(ends), settings))


@partial(jax.jit, static_argnames="settings")
def _light_at_rest(
    fired: Bool[Array, "T h w"], phase: Int[Array, "h w"], ends: Float[Array, ""], settings: StrengthSettings
) -> Float[Array, "2 2 h w"]:
    nothing = jnp.zeros(phase.shape, jnp.float32)
    # As a sample's duration is its weight, Σ duration² over Σ duration.
    squares, times = _visited(
        fired, ends, lambda sums, time, worth, *_: (sums[0] + worth * time**2, sums[1] + worth * time), (nothing,) * 2
    )
    length = jnp.maximum(settings.held_out_frames, 2 * squares.sum() / jnp.maximum(times.sum(), 1e-9))

    def add(
        sums: Float[Array, "2 2 h w"],
        time: Float[Array, "h w"],
        worth: Float[Array, "h w"],
        light: Float[Array, "h w"],
        middle: Float[Array, "h w"],
    ) -> Float[Array, "2 2 h w"]:
        held = ((middle // length).astype(jnp.int32) + phase) % settings.held_out_every == 0
        found = worth[None] * jnp.stack([light, time])
        return sums + jnp.where(jnp.stack([~held, held])[:, None], found[None], 0)

    return _visited(fired, ends, add, jnp.zeros((2, 2, *phase.shape), jnp.float32))


def _visited(fired: Bool[Array, "T h w"], ends: Float[Array, ""], add: Callable[..., Sums], sums: Sums) -> Sums:
    """Fold `add` over all inter-spike intervals and ends, of all pixels at once.

    `add(sums, time, worth, light, middle)` is given, (h, w) each: duration (frames), weight of a frame (0 where a pixel
    has no such interval), light gathered (thresholds), and middle of the exposure (frame).
    """

    def frame(carry: tuple[Array, Array, Sums], now: tuple[Array, Array]) -> tuple[tuple[Array, Array, Sums], None]:
        begin, seen, sums = carry
        t, fired = now
        worth = jnp.where(fired, jnp.where(seen, 1, ends), 0)
        sums = add(sums, t - begin, worth, jnp.where(seen, 1.0, 0.5), (begin + t) / 2)
        return (jnp.where(fired, t, begin), seen | fired, sums), None

    frames = jnp.arange(len(fired), dtype=ends.dtype)
    # Frame t covers [t − ½, t + ½].
    first = jnp.full(fired.shape[1:], -0.5, ends.dtype), jnp.zeros(fired.shape[1:], bool), sums
    (begin, seen, sums), _ = jax.lax.scan(frame, first, (frames, fired))
    end = jnp.asarray(len(fired) - 0.5, ends.dtype)
    return add(sums, end - begin, jnp.broadcast_to(ends, begin.shape), jnp.where(seen, 0.5, 0.0), (begin + end) / 2)
