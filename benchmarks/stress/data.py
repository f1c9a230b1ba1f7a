"""The recordings of `benchmarks.stress`, and the problems that are made of them."""

import functools
import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from benchmarks.methods import PRIORS
from benchmarks.stress.cases import Case
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.motion.validation import FASTEST
from scsr_opt.operators import Blur, DataTerm, PlacedSamples, accumulate, place
from scsr_opt.solvers import Problem

WHITE_RATE = 0.6


@dataclass(frozen=True, eq=False)
class Situation:
    """A recording: `spikes`; the `velocity` given with it, sensor pixels per frame; `bad` pixels; `key` frame."""

    spikes: UInt8[np.ndarray, "T h w"]
    velocity: Float[np.ndarray, "2 h w"]
    bad: Bool[np.ndarray, "h w"]
    key: int


def situation(case: Case) -> Situation:
    """The recording of a case: a texture of three waves and an edge passes before a sensor without noise.

    The given velocity need not be true: "wrong" is three times as much the other way, "discontinuous" another
    velocity for every pixel, "huge" and "not a number" what they are called.
    """
    rng = np.random.default_rng(case.seed)
    (height, width), frames = case.sensor, case.frames
    key = frames // 2
    s = case.scale
    true = {
        "static": (0.0, 0.0),
        "rows only": (0.047, 0.0),
        "columns only": (0.0, -0.047),
        "integer": (2 / s, -2 / s),  # so that the middles of exposures, at half frames, are whole pixels apart
    }.get(case.motion, (0.031, -0.043))
    after = np.arange(frames) - key
    rows = np.arange(height)[:, None] - true[0] * after[:, None, None]
    columns = np.arange(width)[None, :] - true[1] * after[:, None, None]
    waves = rng.uniform(-2.5, 2.5, (3, 3))
    texture = sum(np.sin(a * rows + b * columns + 3 * c) for a, b, c in waves) / 3
    texture = 0.55 + 0.2 * texture + 0.25 * np.sign(rows + 0.7 * columns - height / 2)
    if case.light in ("all-zero", "all-one"):
        spikes = np.full((frames, height, width), case.light == "all-one", np.uint8)
    else:
        brightest = 1 / WHITE_RATE * 1.5 if case.light == "saturated" else float(case.light)
        gathered = np.cumsum(np.clip(brightest * texture * WHITE_RATE, 0, 1), 0) + rng.uniform(0, 1, (height, width))
        spikes = np.diff(np.floor(gathered), axis=0, prepend=np.floor(gathered[:1])).astype(np.uint8)
    velocity = np.broadcast_to(np.array(true)[:, None, None], (2, height, width)).astype(np.float32)
    if case.motion == "wrong":
        velocity = np.float32(-3) * velocity
    elif case.motion == "discontinuous":
        velocity = rng.choice([-0.3, 0.0, 0.3], (2, height, width)).astype(np.float32)
    elif case.motion == "huge":
        velocity = np.full_like(velocity, FASTEST)
    elif case.motion == "not a number":
        velocity = np.where(rng.random((height, width)) < 0.5, velocity, np.float32(np.nan))
    bad = rng.random((height, width)) < case.bad
    return Situation(spikes, velocity, bad, key)


def has_samples(seen: Situation) -> bool:
    """True if two spikes of a good pixel certainly see one place of the key frame, so that there is something to make a
    picture from; motions that are not the same everywhere are not looked at."""
    if not np.ptp(seen.velocity, axis=(1, 2)).any():
        last = np.array(seen.spikes.shape[1:]) - 1
        for row, column in np.argwhere(~seen.bad):
            at = np.flatnonzero(seen.spikes[:, row, column])
            # Where in the key frame what it sees lies, at each of its spikes.
            place = (row, column) - seen.velocity[:, 0, 0] * (at - seen.key)[:, None]
            inside: np.ndarray = np.all((place >= 0) & (place <= last), axis=1)
            if (inside[1:] & inside[:-1]).any():
                return True
    return False


def picture_shape(case: Case) -> tuple[int, int]:
    return case.scale * case.sensor[0], case.scale * case.sensor[1]


def lens_of(case: Case) -> Blur | None:
    """The lens of a case, in JAX's precision of the moment. Its PSF is four standard deviations wide each way; the
    wider of the two that are tried has the picture's width as σ, so that the PSF is wider than the picture by far."""
    return None if case.lens is None else Blur.gaussian(picture_shape(case), case.lens)


@functools.lru_cache(maxsize=64)
def _placed(case: Case) -> PlacedSamples:
    seen = situation(case)
    samples = spike_intervals(seen.spikes, white_rate=WHITE_RATE, bad_pixels=seen.bad)
    samples = eqx.tree_at(lambda v: v.weight, samples, samples.weight / np.float32(case.frames))
    n = samples.row.size
    # Few lengths, so that little is compiled anew.
    length = 4096 * 4 ** max(0, math.ceil(math.log(max(n, 1) / 4096, 4)))
    padded = jax.tree.map(lambda v: jnp.asarray(np.pad(v, (0, length - n))), samples)
    path = trajectory_of(Motion.of_velocity(seen.velocity), key=seen.key, start=0, stop=case.frames)
    return place(padded, path, scale=case.scale, shape=picture_shape(case))


def placed_of(case: Case) -> PlacedSamples:
    """The samples of a case and where they were taken, in float32 (whatever its precision)."""
    same = Case(
        "", sensor=case.sensor, scale=case.scale, frames=case.frames, light=case.light, motion=case.motion,
        bad=case.bad, seed=case.seed,
    )  # fmt: skip
    with jax.enable_x64(False):
        return _placed(same)


def in_precision(tree: PlacedSamples, precision: str) -> PlacedSamples:
    """The samples with numbers in the precision of the arithmetic; JAX has to be set to it."""
    dtype = jnp.float64 if precision == "float64" else jnp.float32
    return jax.tree.map(lambda v: jnp.asarray(np.asarray(v), dtype) if eqx.is_inexact_array(v) else v, tree)


def stored(term: DataTerm, precision: str) -> DataTerm:
    """The term with M and c as they come out of storage."""
    if precision != "bfloat16":
        return term
    rounded = tuple(
        jnp.asarray(np.asarray(v).astype(jnp.bfloat16).astype(np.float32)) for v in (term.stencil.planes, term.target)
    )
    return eqx.tree_at(lambda t: (t.stencil.planes, t.target), term, rounded)


def problem_of(case: Case) -> Problem:
    """The problem of a case, accumulated in its precision, to which JAX has to be set."""
    placed = in_precision(placed_of(case), case.precision)
    term = stored(accumulate(placed, optics=lens_of(case)), case.precision)
    return Problem(term, PRIORS[case.prior], jnp.asarray(case.strength, term.target.dtype))


def addends(case: Case) -> int:
    """The most numbers that were added up for one entry of M or c."""
    placed = placed_of(case)
    used = np.asarray(placed.weight) > 0
    corner, width = np.asarray(placed.taps.index)[0][used], placed.shape[1]
    taps = np.concatenate([corner + offset for offset in (0, 1, width, width + 1)])
    return int(np.bincount(taps).max(initial=0)) if taps.size else 0


def initial_image(case: Case, dtype: jnp.dtype) -> Float[Array, "H W"]:
    shape, rng = picture_shape(case), np.random.default_rng(case.seed + 1)
    made = {
        "zero": lambda: np.zeros(shape),
        "noise": lambda: rng.uniform(0, 1, shape),
        "garbage": lambda: 1e3 * rng.normal(size=shape),
        "1e12": lambda: 1e12 * rng.normal(size=shape),
        "1e30": lambda: 1e30 * rng.normal(size=shape),
    }.get(case.start, lambda: np.full(shape, 0.5))
    # Through float32, so that all precisions begin with the same picture.
    return jnp.asarray(made().astype(np.float32), dtype)
