"""`Motion` at a key frame and its `Trajectory`: where in the key frame the surface lies that a pixel sees at time t.

This is the warp T of Eq. 2, seen from the sensor. Motion is given at the key frame: the surface at q is at q + d(q, τ)
after τ frames, with d = v τ + ½ a τ² (velocity v, acceleration a). A sample, however, is measured at a pixel p, and
needs the q with q + d(q, τ) = p. That inverse is computed at moments `SPACING` frames apart and interpolated between
them: at 40,000 frames a second nothing moves far in four frames.
"""

import operator
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped
from numpy.typing import ArrayLike

from scsr_opt._arrays import as_array
from scsr_opt._kernels.device import on_device
from scsr_opt._kernels.programs import ready
from scsr_opt.errors import InputError, shown
from scsr_opt.motion.inversion import (
    ROUNDING,
    affine_field,
    affine_numbers,
    bilinear,
    deviation_from_affine,
    in_turn,
    inverse,
    inverse_at,
    read_picture,
)
from scsr_opt.motion.settings import DEFAULTS
from scsr_opt.motion.trajectory_settings import TrajectorySettings

SPACING = 4
"""Frames between two moments at which the inverse is computed. Linear interpolation between them is wrong by at most
a·(spacing)²/8 with an acceleration a: a thousandth of a pixel for a turn of 0.01 rad per frame at radius 10."""

# Layers are padded to a multiple of this number: a background, and up to three more.
_LAYERS = 4


class _Copied(eqx.Module):
    """A module that is copied and unpickled by a call of its class. Otherwise equinox (0.13.8) would take the copy for
    a module that is still being made, and hold it for as long as the process lives."""

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), tuple(getattr(self, field.name) for field in fields(self))


class Layers(_Copied):
    """Surfaces that move on their own, one in front of another.

    **Fields:**
    - `velocity`, `acceleration`: (layers, 2, h, w), of every layer over the whole picture, as in `Motion`.
    - `label`: (h, w), the layer that the key frame shows at a pixel.
    - `depth`: (layers,), larger for nearer layers.
    """

    velocity: Float[np.ndarray, "layers 2 h w"]
    acceleration: Float[np.ndarray, "layers 2 h w"]
    label: Int[np.ndarray, "h w"]
    depth: Int[np.ndarray, " layers"]

    def within(self, background: "Motion", rows: slice, columns: slice) -> "Layers":
        """These layers of a part of the sensor, continued to the whole sensor, with `background` around them.

        A layer that has the background's motion becomes the background and keeps its depth; if there is none, the
        background is one more layer, behind all others.
        """
        here = background.velocity[..., rows, columns]
        same = [k for k, velocity in enumerate(self.velocity) if np.array_equal(velocity, here)]
        ground = same[0] if same else len(self.velocity)
        height, width = background.velocity.shape[1:]
        sides = [side.indices(length)[:2] for side, length in zip((rows, columns), (height, width), strict=True)]
        beyond = [(begin, length - end) for (begin, end), length in zip(sides, (height, width), strict=True)]

        def continued(fields: np.ndarray, around: np.ndarray) -> np.ndarray:
            wide = np.pad(fields, ((0, 0), (0, 0), *beyond), mode="edge")
            for one, field in zip(wide, fields, strict=True):
                off, numbers = deviation_from_affine(field)
                if off <= ROUNDING * np.abs(field).max():  # kept affine: `inverse` is then in closed form
                    one[:] = affine_field(numbers, height, width, sides[0][0], sides[1][0])
            return np.concatenate([wide[:ground], around[None], wide[ground + 1 :]])

        label = np.full((height, width), ground, np.int32)
        label[rows, columns] = self.label
        depth = self.depth if same else np.append(self.depth, self.depth.min() - 1).astype(np.int32)
        return Layers(
            continued(self.velocity, background.velocity), continued(self.acceleration, background.acceleration),
            label, depth,
        )  # fmt: skip


class Trust(_Copied):
    """Weight of samples by the time they were measured at, relative to their weight if the motion were exact
    (`scsr_opt.motion.reliability`).

    **Fields:** `after` (n,): frames from the key frame, increasing; `share` (n, h, w): the weight in [0, 1] of samples
    of that time, by pixel of the key frame.
    """

    after: Float[np.ndarray, " n"]
    share: Float[np.ndarray, "n h w"]


class Motion(_Copied):
    """Motion around a key frame.

    **Fields:**
    - `velocity`: (2, h, w), sensor pixels per frame, of the surface seen at each pixel of the KEY frame ([0] rows,
      [1] columns).
    - `acceleration`: (2, h, w), sensor pixels per frame².
    - `confidence`: (h, w) in [0, 1]: 1 where the velocity is well determined, 0 where nothing supports it.
    - `layers`: surfaces that move on their own; None where one smooth motion serves the whole picture.
    - `trust`: how well the motion holds at each moment; None means perfectly.
    - `reach`: (h, w), frames before and after the key frame within which the motion holds and samples are used
      (`scsr_opt.motion.estimators.reach`); None, or infinite, means throughout the recording.
    """

    velocity: Float[np.ndarray, "2 h w"]
    acceleration: Float[np.ndarray, "2 h w"]
    confidence: Float[np.ndarray, "h w"]
    layers: Layers | None = None
    trust: Trust | None = None
    reach: Float[np.ndarray, "h w"] | None = None

    @classmethod
    def of_velocity(cls, velocity: ArrayLike, confidence: Float[np.ndarray, "h w"] | None = None) -> "Motion":
        """Straight motion at constant speed.

        **Arguments:** `velocity`: (2, h, w), sensor pixels per frame. `confidence`: (h, w); 1 everywhere if None.

        **Raises:** `InputError` if NumPy cannot read the velocity, or it does not hold numbers.
        """
        try:
            velocity = as_array(velocity, "velocity").astype(np.float32, copy=False)
        except (TypeError, ValueError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"velocity is {shown(velocity)}; it must be (2, h, w) numbers in sensor pixels per frame."
            ) from None
        if confidence is None:
            confidence = np.ones(velocity.shape[1:], np.float32)
        return cls(velocity, np.zeros_like(velocity), np.asarray(confidence, np.float32))

    @classmethod
    def constant(cls, velocity: ArrayLike | Sequence[float | int], shape: tuple[int, int]) -> "Motion":
        """One velocity for the whole scene.

        **Arguments:** `velocity`: two numbers (down, right), sensor pixels per frame. `shape`: (h, w) of the sensor.

        **Raises:** `InputError` unless there are two finite numbers, and two whole ones of at least 1.
        """
        try:
            height, width = map(operator.index, shape)
        except (TypeError, ValueError, OverflowError):
            height = width = 0
        if min(height, width) < 1:
            raise InputError(
                f"shape is {shown(shape)}; it must be (rows, columns) of the sensor, two whole numbers of at least 1."
            )
        try:
            with np.errstate(over="ignore"):  # becomes infinite, and is refused as such
                pair = as_array(velocity, "velocity").astype(np.float32)
        except (TypeError, ValueError, OverflowError):
            pair = np.zeros(0, np.float32)
        if pair.shape != (2,) or not np.isfinite(pair).all():
            raise InputError(
                f"velocity is {shown(velocity)}; it must be two finite numbers (down, right) in sensor pixels per "
                f"frame."
            )
        return cls.of_velocity(np.broadcast_to(pair[:, None, None], (2, height, width)).copy())

    @classmethod
    def none(cls, height: int, width: int) -> "Motion":
        """The motion of a scene at rest."""
        return cls.of_velocity(np.zeros((2, height, width), np.float32))

    @classmethod
    def of_layers(cls, layers: Layers, confidence: Float[np.ndarray, "h w"]) -> "Motion":
        """The motion in which each key-frame pixel moves with its layer. `confidence`: (h, w)."""
        chosen = layers.label[None, None]
        velocity = np.take_along_axis(layers.velocity, chosen, 0)[0]
        acceleration = np.take_along_axis(layers.acceleration, chosen, 0)[0]
        return cls(velocity, acceleration, confidence, layers)

    def part(self, rows: slice, columns: slice) -> "Motion":
        """The motion of these rows and columns of the sensor."""
        return jax.tree.map(lambda field: field[..., rows, columns] if field.ndim > 1 else field, self)

    def within(self, background: "Motion", rows: slice, columns: slice) -> "Motion":
        """This motion of a part of the sensor, with `background`, one smooth motion, around that part."""
        if self.velocity.shape == background.velocity.shape:
            return self

        def inserted(field: np.ndarray, around: np.ndarray) -> np.ndarray:
            whole = np.array(around)
            whole[..., rows, columns] = field
            return whole

        return Motion(
            inserted(self.velocity, background.velocity),
            inserted(self.acceleration, background.acceleration),
            inserted(self.confidence, background.confidence),
            None if self.layers is None else self.layers.within(background, rows, columns),
            reach=None if self.reach is None else inserted(self.reach, np.full(background.speed.shape, np.inf)),
        )

    @property
    def moves(self) -> bool:
        """Whether any velocity or acceleration is not zero."""
        return bool(self.velocity.any() or self.acceleration.any())

    @property
    def speed(self) -> Float[np.ndarray, "h w"]:
        """Length of the velocity, sensor pixels per frame."""
        return np.hypot(*self.velocity)

    def moved(self, frames: int) -> Float[np.ndarray, "h w"]:
        """Displacement at each pixel in `frames` frames, sensor pixels; infinite beyond float32."""
        with np.errstate(over="ignore"):
            return self.speed * np.float32(frames)


class Trajectory(eqx.Module):
    """Key-frame positions for all sensor pixels at moments `first`, `first` + SPACING, …

    **Fields:**
    - `first`: time of the first moment, frames.
    - `position`: (n, 2, h, w), sensor pixels: where in the key frame the point lies that a pixel sees at the moment.
    - `visible`: (n, h, w) in [0, 1]: visibility of that point in the key frame, times the motion's trust. Samples are
      weighted by it.
    """

    first: Float[Array, ""]
    position: Float[Array, "n 2 h w"]
    visible: Float[Array, "n h w"]

    @property
    def tables(self) -> tuple[Float[Array, " entries"], Float[Array, " entries"], Float[Array, " entries"]]:
        """Rows, columns and visibility in the order of pixels, then moments: samples come pixel by pixel, so they read
        memory in sequence."""
        # Three tables: one with rows of three numbers took three times as long.
        down, right, visible = (
            jnp.moveaxis(field, 0, -1).reshape(-1) for field in (self.position[:, 0], self.position[:, 1], self.visible)
        )
        return down, right, visible

    def between(self, row: Int[Array, " m"], column: Int[Array, " m"], time: Float[Array, " m"]) -> "Between":
        """The entries of the tables between which pixels (row, column) at `time`, frames, are interpolated."""
        moments, _, _, width = self.position.shape
        pixel = (row * width + column) * moments
        if moments == 1:
            return Between(pixel, pixel, jnp.zeros_like(time))
        steps = jnp.clip((time - self.first) / SPACING, 0, moments - 1)
        whole = jnp.minimum(steps.astype(row.dtype), moments - 2)
        return Between(pixel + whole, pixel + whole + 1, steps - whole.astype(time.dtype))

    def at(
        self, row: Int[Array, " m"], column: Int[Array, " m"], time: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Float[Array, " m"], Float[Array, " m"]]:
        """Key-frame row and column, sensor pixels, and visibility of the points that pixels (row, column) see at
        `time`, frames."""
        between = self.between(row, column, time)
        down, right, visible = map(between.read, self.tables)
        return down, right, visible

    def part(self, rows: slice, columns: slice) -> "Trajectory":
        """The trajectory, (n, 2, rows, columns), of a part of the sensor. The slices need a start and a stop; positions
        count from the part's corner, as its pixels do."""
        if (rows.stop - rows.start, columns.stop - columns.start) == self.position.shape[2:]:
            return self
        corner = np.array([rows.start, columns.start], np.float32)
        position = np.asarray(self.position)[..., rows, columns] - corner[:, None, None]
        return Trajectory(self.first, on_device(position), on_device(np.asarray(self.visible)[:, rows, columns]))

    @property
    def usable(self) -> Float[np.ndarray, "n h w"]:
        """`visible`, and 0 where the point that a pixel sees lies outside the key frame."""
        height, width = self.position.shape[2:]
        # A tolerance, so that rounding does not take the border row of a scene at rest out of the picture.
        lowest, highest = np.float32(-1e-4), np.array([height - 1 + 1e-4, width - 1 + 1e-4], np.float32)
        found = np.zeros(self.visible.shape, np.float32)
        position, seen = np.asarray(self.position), np.asarray(self.visible)
        for share, (down, right), visible in zip(found, position, seen, strict=True):
            inside = (down >= lowest) & (right >= lowest) & (down <= highest[0]) & (right <= highest[1])
            np.copyto(share, visible, where=inside)
        return found

    @property
    def speeds(self) -> "Changes":
        """Speed of the key-frame position of the point that each pixel sees, sensor pixels per frame. Large where one
        surface passes in front of another, as the position then jumps from one to the other."""

        def speed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
            # Not np.hypot, which takes care of numbers that are not here and ten times as long.
            (down, right) = after - before
            return np.sqrt(down**2 + right**2)

        return self._changes(np.asarray(self.position), speed)

    @property
    def unsteady(self) -> "Changes":
        """Change of the visibility of the point that each pixel sees, per frame."""
        return self._changes(np.asarray(self.visible), lambda before, after: np.abs(after - before))

    def _changes(self, field: np.ndarray, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> "Changes":
        """`Changes` of a field (n, …, h, w), by the `change` from a moment to the next, (h, w)."""
        moments, *_, height, width = field.shape
        steps = np.zeros((moments, height, width), np.float32)
        for k in range(moments - 1):
            steps[k] = change(field[k], field[k + 1]) / np.float32(SPACING)
        steps[-1] = steps.max(0)
        for k in range(moments - 2):
            np.maximum(steps[k], steps[k + 1], out=steps[k])
        return Changes(float(self.first), steps)


class Between(NamedTuple):
    """Linear interpolation in a trajectory's tables, between entry `before` and entry `after`; `share` in [0, 1] is the
    weight of `after`."""

    before: Int[Array, " m"]
    after: Int[Array, " m"]
    share: Float[Array, " m"]

    def read(self, table: Float[Array, " entries"]) -> Float[Array, " m"]:
        """The interpolated values of one table."""
        before, after = (table.at[entry].get(mode="promise_in_bounds") for entry in (self.before, self.after))
        return before + self.share * (after - before)


class Changes(NamedTuple):
    """Rate of change, per frame, of a quantity of the point that each pixel sees.

    **Fields:** `first`: time of the first moment, frames; `steps` (n, h, w): the largest rate over the two steps from
    each moment on; the last row is the largest of all.
    """

    first: float
    steps: Float[np.ndarray, "n h w"]

    @property
    def most(self) -> Float[np.ndarray, "h w"]:
        """The largest rate of each pixel."""
        return self.steps[-1]

    def during(
        self,
        row: Int[np.ndarray | Array, " n"],
        column: Int[np.ndarray | Array, " n"],
        start: Float[np.ndarray | Array, " n"],
        stop: Float[np.ndarray | Array, " n"],
    ) -> Float[np.ndarray, " n"]:
        """Largest rate of pixels (row, column) during exposures from `start` to `stop`, frames; the largest of all
        moments where an exposure is longer than two steps."""
        moments, height, width = self.steps.shape
        row, column, start, stop = (np.asarray(v) for v in (row, column, start, stop))
        if moments == 1:
            return np.zeros(row.shape, np.float32)
        first = np.clip((start - np.float32(self.first)) / SPACING, 0, moments - 2).astype(np.int32)
        last = np.clip((stop - np.float32(self.first)) / SPACING, 0, moments - 2).astype(np.int32)
        which = np.where(last <= first + 1, first, np.int32(moments - 1))
        return self.steps.reshape(-1)[which * np.int32(height * width) + row * np.int32(width) + column]


def trajectory_of(
    motion: Motion, *, key: int, start: int, stop: int, settings: TrajectorySettings = DEFAULTS.trajectory
) -> Trajectory:
    """The trajectory of a motion through frames `start` to `stop` (exclusive) around key frame `key`.

    With layers, a pixel sees the nearest one that comes to lie there; where there is none, the point that it sees was
    hidden in the key frame, and `visible` is 0.

    **Raises:** `InputError` in a forked process, and where JAX finds no device.
    """
    ready()
    moments = np.arange(start, stop - 1 + SPACING, SPACING, dtype=np.float32)
    if motion.trust is None and not motion.moves:
        moments = moments[:1]  # at rest one moment serves all
    after = moments - np.float32(key)
    position, visible = key_frame_positions(motion, after, settings=settings)
    return Trajectory(on_device(moments[0]), position, _times_trust(motion.trust, visible, position, after))


def key_frame_positions(
    motion: Motion,
    after: Float[Array | np.ndarray, " n"],
    *,
    every: int = 1,
    settings: TrajectorySettings = DEFAULTS.trajectory,
) -> tuple[Float[Array, "n 2 rows columns"], Float[Array, "n rows columns"]]:
    """Key-frame position, sensor pixels, and visibility of the point that each pixel sees `after` frames from the key
    frame; only for each `every`-th row and column."""
    layers = motion.layers
    if layers is None:
        position = inverse(motion.velocity, motion.acceleration, after, every=every, settings=settings)
        return position, on_device(np.ones(position.shape[:1] + position.shape[2:], np.float32))
    nearest = np.argsort(-layers.depth, kind="stable")
    velocity, acceleration = layers.velocity[nearest], layers.acceleration[nearest]
    member = (layers.label == nearest[:, None, None]).astype(np.float32)
    longest = float(np.abs(np.asarray(after)).max())
    tolerance = settings.inverse_tolerance_px
    affine = [affine_numbers(v, a, longest, tolerance) for v, a in zip(velocity, acceleration, strict=True)]
    plain, numbers = np.array([is_affine for is_affine, _ in affine]), np.stack([of for _, of in affine])
    fields = velocity, acceleration if acceleration.any() else None, plain, numbers, member
    given = *jax.tree.map(_with_spare_layers, fields), np.int32(len(velocity))
    # Moment by moment, so that pictures stay in the cache, and one program serves any number of moments.
    found = [_layered_position(*given, tau, every, settings) for tau in np.asarray(after)]
    position, visible = (on_device(np.stack([np.asarray(one) for one in of])) for of in zip(*found, strict=True))
    return position, visible


def _with_spare_layers(fields: Shaped[np.ndarray, "layers *shape"]) -> Shaped[Array, "more *shape"]:
    """Layers of zeros added up to a multiple of `_LAYERS`: one program then serves one layer more or less."""
    spare = -len(fields) % _LAYERS
    return on_device(np.pad(fields, [(0, spare)] + [(0, 0)] * (fields.ndim - 1)))


@partial(jax.jit, static_argnames=("every", "settings"))
def _layered_position(
    velocity: Float[Array, "layers 2 h w"],
    acceleration: Float[Array, "layers 2 h w"] | None,
    affine: Bool[Array, " layers"],
    numbers: Float[Array, "layers 2 2 3"],
    member: Float[Array, "layers h w"],
    count: Int[Array, ""],
    tau: Float[Array, ""],
    every: int,
    settings: TrajectorySettings,
) -> tuple[Float[Array, "2 rows columns"], Float[Array, "rows columns"]]:
    """`key_frame_positions` of the first `count` layers, the nearest first, `tau` frames from the key frame."""
    partial_share, whole_share = settings.partial_share, settings.whole_share
    nowhere = jnp.zeros_like(velocity[0, :, ::every, ::every])

    def place(k: Array) -> Array:
        faster = None if acceleration is None else acceleration[k]
        return inverse_at(velocity[k], faster, affine[k], numbers[k], tau, every, settings)

    def look(k: Array, here: Array) -> tuple[Array, Array]:
        return here, bilinear(member[k][None], here[0], here[1])[0]

    def nearer(_: Array, found: tuple[Array, Array], so_far: tuple[Array, Array]) -> tuple[Array, Array]:
        (here, belongs), (position, part) = found, so_far
        # Where the point belongs to no layer, it is that of the layer with the largest share.
        better = (part <= partial_share) & (belongs > part)
        return jnp.where(better[None], here, position), jnp.where(better, belongs, part)

    nobody = nowhere, jnp.full_like(nowhere[0], -1)
    position, part = in_turn(place, look, nearer, nobody, 0, count)
    return position, jnp.clip((part - partial_share) / (whole_share - partial_share), 0, 1)


def _times_trust(
    trust: Trust | None,
    visible: Float[Array, "m h w"],
    position: Float[Array, "m 2 h w"],
    after: Float[np.ndarray, " m"],
) -> Float[Array, "m h w"]:
    """`visible` times the trust in the motion at the key-frame point that is seen."""
    if trust is None:
        return visible
    # Interpolated between two known moments; constant before the first and after the last.
    at = np.interp(after, trust.after, np.arange(trust.after.size))
    before = np.minimum(at.astype(int), trust.after.size - 2)
    found = np.array(visible)
    parts = (at - before).astype(np.float32)
    for share, (down, right), k, part in zip(found, np.asarray(position), before, parts, strict=True):
        share *= np.asarray(read_picture(trust.share[k] + part * (trust.share[k + 1] - trust.share[k]), down, right))
    return on_device(found)
