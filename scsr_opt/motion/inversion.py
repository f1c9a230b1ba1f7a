"""The inverse of a motion: which point q of the key frame comes to lie on a pixel p after τ frames.

That is q + d(q, τ) = p with d = v τ + ½ a τ²: at once where the motion is affine, else by fixed-point iteration.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scsr_opt._kernels.device import on_device
from scsr_opt.motion.settings import DEFAULTS
from scsr_opt.motion.trajectory_settings import TrajectorySettings

Place = TypeVar("Place")
Found = TypeVar("Found")
Sums = TypeVar("Sums")

ROUNDING = 1e-5
"""Deviation of an affine field in float32 from exact values, relative to its largest value."""


def inverse(
    velocity: Float[Array | np.ndarray, "2 h w"],
    acceleration: Float[Array | np.ndarray, "2 h w"],
    after: Float[Array | np.ndarray, " n"],
    *,
    every: int = 1,
    settings: TrajectorySettings = DEFAULTS.trajectory,
) -> Float[Array, "n 2 rows columns"]:
    """The key-frame point q with q + v(q) τ + ½ a(q) τ² = p, sensor pixels, for every pixel p and each τ of `after`.

    Solved in closed form where the motion is affine, else by fixed-point iteration from q = p. The error shrinks by
    ‖∇d‖ in each iteration, the relative change of displacement from pixel to pixel: well under ½ where a motion is
    smooth. Where it is not, as at motion boundaries, the point is meaningless; of a dense estimate that can be a third
    of the pixels 50 frames away (docs/decisions/0019).

    **Arguments:** `velocity`, `acceleration`: sensor pixels per frame and per frame². `after`: frames from the key
    frame. `every`: only each `every`-th row and column is solved for.
    """
    velocity, acceleration = np.asarray(velocity), np.asarray(acceleration)
    longest = float(np.abs(np.asarray(after)).max())
    affine, numbers = affine_numbers(velocity, acceleration, longest, settings.inverse_tolerance_px)
    if affine:
        return on_device(_affine_inverses(numbers, np.asarray(after), velocity.shape[1:], every))
    # Interpolation takes most of the time, and a field of zeros needs none.
    curved = acceleration if np.any(acceleration) else None
    fields = on_device(velocity), None if curved is None else on_device(curved)
    # Moment by moment: one program serves any number of them.
    found = [_iterated_inverse(*fields, tau, every, settings) for tau in np.asarray(after)]
    return on_device(np.stack([np.asarray(position) for position in found]))


def affine_numbers(
    velocity: Float[np.ndarray, "2 h w"], acceleration: Float[np.ndarray, "2 h w"], longest: float, tolerance: float
) -> tuple[bool, Float[np.ndarray, "2 2 3"]]:
    """Whether a motion is affine up to a displacement of `tolerance` sensor pixels in `longest` frames, and the numbers
    of its velocity and acceleration (`deviation_from_affine`)."""
    (off, numbers), (more, others) = deviation_from_affine(velocity), deviation_from_affine(acceleration)
    return off * longest + more * longest**2 / 2 <= tolerance, np.stack([numbers, others])


def deviation_from_affine(field: Float[np.ndarray, "2 h w"]) -> tuple[float, Float[np.ndarray, "2 3"]]:
    """Largest deviation of a field from the affine one through three of its corners, and that one's numbers, down and
    right: the value at pixel (0, 0), its change from row to row, and from column to column."""
    height, width = field.shape[1:]
    corner = field[:, 0, 0]
    down, right = (field[:, -1, 0] - corner) / max(height - 1, 1), (field[:, 0, -1] - corner) / max(width - 1, 1)
    numbers = np.stack([corner, down, right], axis=1).astype(np.float32)
    if not field.any():
        return 0.0, numbers
    return float(np.abs(field - affine_field(numbers, height, width)).max()), numbers


def affine_field(
    numbers: Float[np.ndarray, "2 3"], height: int, width: int, top: int = 0, left: int = 0
) -> Float[np.ndarray, "2 h w"]:
    """The affine field with these numbers, whose pixel (0, 0) lies at (`top`, `left`) of the picture."""
    rows = np.arange(height, dtype=np.float32)[:, None] - np.float32(top)
    columns = np.arange(width, dtype=np.float32) - np.float32(left)
    return np.stack([begin + down * rows + right * columns for begin, down, right in numbers])


def _affine_inverses(
    numbers: Float[np.ndarray, "2 2 3"], after: Float[np.ndarray, " n"], shape: tuple[int, int], every: int
) -> Float[np.ndarray, "n 2 rows columns"]:
    """`inverse` of an affine motion."""
    rows, columns = (np.arange(0, length, every, dtype=np.float32) for length in shape)
    found = np.empty((after.size, 2, rows.size, columns.size), np.float32)
    for tau, place in zip(after, found, strict=True):
        place[0], place[1] = _affine_inverse(numbers, tau, rows[:, None], columns)
    return found


def _affine_inverse(
    numbers: Float[Array | np.ndarray, "2 2 3"],
    tau: Float[Array | np.floating, ""],
    rows: Float[Array | np.ndarray, "rows _"],
    columns: Float[Array | np.ndarray, "... columns"],
) -> tuple[Any, Any]:
    """Down and right of `inverse` at one moment in closed form, by NumPy or JAX: q + d + D q = p, d and D those of the
    moment."""
    (down, a, b), (right, c, d) = numbers[0] * tau + numbers[1] * (tau**2 / 2)
    a, d = 1 + a, 1 + d
    determinant = a * d - b * c
    below, beside = rows - down, columns - right
    return (d * below - b * beside) / determinant, (a * beside - c * below) / determinant


def inverse_at(
    velocity: Float[Array, "2 h w"],
    acceleration: Float[Array, "2 h w"] | None,
    affine: Bool[Array, ""],
    numbers: Float[Array, "2 2 3"],
    tau: Float[Array, ""],
    every: int,
    settings: TrajectorySettings,
) -> Float[Array, "2 rows columns"]:
    """`inverse` at one moment, to be called inside `jit`: `acceleration` is None where it is zero, and `affine` and
    `numbers` are those of `affine_numbers`."""

    def solved() -> Float[Array, "2 rows columns"]:
        rows, columns = jnp.indices(velocity.shape[1:], velocity.dtype)[:, ::every, ::every]
        return jnp.stack(_affine_inverse(numbers, tau, rows, columns))

    return jax.lax.cond(affine, solved, lambda: _iterated_inverse(velocity, acceleration, tau, every, settings))


@partial(jax.jit, static_argnames=("every", "settings"))
def _iterated_inverse(
    velocity: Float[Array, "2 h w"],
    acceleration: Float[Array, "2 h w"] | None,
    tau: Float[Array, ""],
    every: int,
    settings: TrajectorySettings,
) -> Float[Array, "2 rows columns"]:
    """`inverse` at one moment by fixed-point iteration."""
    here = jnp.indices(velocity.shape[1:], velocity.dtype)[:, ::every, ::every]
    fields = [velocity] if acceleration is None else [velocity, acceleration]
    powers = tau, 0.5 * tau**2

    # Rows and columns apart, and the change is computed in the next iteration, for the reason given at `in_turn`.
    def refine(carry: tuple[list[Array], list[Array], Array]) -> tuple[list[Array], list[Array], Array]:
        q, _, done = carry
        better = [
            p - sum(bilinear(field[axis][None], *q)[0] * power for field, power in zip(fields, powers, strict=False))
            for axis, p in enumerate(here)
        ]
        return better, q, done + 1

    def go_on(carry: tuple[list[Array], list[Array], Array]) -> Array:
        q, before, done = carry
        change = jnp.maximum(*(jnp.max(jnp.abs(now - then)) for now, then in zip(q, before, strict=True)))
        unfinished = (done < settings.inverse_steps) & (change > settings.inverse_tolerance_px)
        return (done == 0) | unfinished

    begin = list(here), list(here), jnp.zeros((), jnp.int32)
    return jnp.stack(jax.lax.while_loop(go_on, refine, begin)[0])


class Corner(NamedTuple):
    """A position for bilinear interpolation: the `number`, in the flattened picture, of the upper left of the four
    pixels around it, and the distances `down` and `right` from that pixel, in [0, 1]."""

    number: Int[Array, "..."]
    down: Float[Array, "..."]
    right: Float[Array, "..."]


def corner_of(row: Array, column: Array, height: int, width: int) -> Corner:
    """`Corner` of positions on a picture of (height, width), clamped to its border; NaN is clamped, too."""
    row, column = jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)
    top = jnp.clip(row.astype(jnp.int32), 0, max(height - 2, 0))
    left = jnp.clip(column.astype(jnp.int32), 0, max(width - 2, 0))
    return Corner(top * width + left, row - top.astype(row.dtype), column - left.astype(column.dtype))


def interpolated(picture: Float[Array, "h w"], at: Corner) -> Float[Array, "..."]:
    """`picture` interpolated bilinearly at positions."""
    height, width = picture.shape
    below, beside, flat = (width if height > 1 else 0), (1 if width > 1 else 0), picture.reshape(-1)
    # Each corner is read once: otherwise this takes two to ten times as long.
    offsets = (0, beside, below, below + beside)
    a, b, c, d = (flat.at[at.number + offset].get(mode="promise_in_bounds") for offset in offsets)
    upper, lower = a + at.right * (b - a), c + at.right * (d - c)
    return upper + at.down * (lower - upper)


@jax.jit
def read_picture(
    picture: Float[Array, "h w"], row: Float[Array, "rows columns"], column: Float[Array, "rows columns"]
) -> Float[Array, "rows columns"]:
    """`picture` interpolated bilinearly at (row, column), clamped to its border: for use outside `jit`, where one
    program serves any number of pictures."""
    return interpolated(picture, corner_of(row, column, *picture.shape))


def bilinear(field: Float[Array, "c h w"], row: Array, column: Array) -> Float[Array, "c ..."]:
    """`field` interpolated bilinearly at (row, column), clamped to its border; NaN reads the border."""
    at = corner_of(row, column, *field.shape[1:])
    # Channel by channel: all in one gather took ten times as long.
    return jnp.stack([interpolated(channel, at) for channel in field])


def in_turn(
    place: Callable[[Array], Place],
    look: Callable[[Array, Place], Found],
    add: Callable[[Array, Found, Sums], Sums],
    sums: Sums,
    begin: Int[Array, ""] | int,
    end: Int[Array, ""] | int,
) -> Sums:
    """`sums` after `add(k, look(k, place(k)), sums)` for each k from `begin` up to `end`, for one k at least.

    A software-pipelined loop: a position is computed in one iteration, interpolated at in the next, and the value is
    added in the one after. In one iteration, XLA compiles an interpolation into each sum that uses it, and its position
    into each of its four corners, which takes three and two times as long.
    """

    def turn(k: Array, carry: tuple[Place, Found, Sums]) -> tuple[Place, Found, Sums]:
        placed, found, sums = carry
        return place(jnp.minimum(k + 2, last)), look(k + 1, placed), add(k, found, sums)

    begin, last = jnp.asarray(begin, jnp.int32), jnp.asarray(end, jnp.int32) - 1
    first = place(jnp.minimum(begin + 1, last)), look(begin, place(begin)), sums
    _, found, sums = jax.lax.fori_loop(begin, last, turn, first)
    return add(last, found, sums)
