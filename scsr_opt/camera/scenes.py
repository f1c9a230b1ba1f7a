"""Scenes for the simulator: what the sensor looks at, at any moment, with the true motion.

A scene is a function of time to a high-resolution (HR) picture. The image-based ones here are made of stills that move
along **steady velocity fields** v(x) = L (x − c) + d: the path of a point is then a matrix exponential, the picture at
any time is one exact look-up in the still (nothing is warped twice), and the velocity asked for is the one that was
rendered. Standing still, translation, rotation, zoom and shear are all of this kind. Pictures are continued beyond
their edges by reflection, and the continuation moves along with them.

Conventions: positions in HR pixels, (row, column), the centre of the first pixel is (0, 0); times in spike frames,
frame t sits at time t; velocities in HR pixels per frame (a sensor pixel is `scale` HR pixels), [0] rows (down), [1]
columns (right). Grey levels are taken as linear intensity, 1 = white.
"""

import abc
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.linalg import expm

from scsr_opt._validation import number
from scsr_opt.camera.pictures import Picture, as_intensity
from scsr_opt.errors import InputError, shown

KEY_FRAME = 50.0
"""Key time where none is given: the middle of the simulator's 101 frames."""
# Of positions, times and speeds: where a picture lies after a million frames is still known to a hundredth of a pixel.
_MOST_COORDINATE = 1e6


@dataclass(frozen=True, eq=False)
class SteadyMotion:
    """Motion along a velocity field that does not change with time: v(x) = L (x − c) + d.

    **Fields:**
    - `drift`: d, HR pixels per frame.
    - `gradient`: L, (2, 2), per frame.
    - `centre`: c, HR pixels.
    """

    drift: tuple[float, float] = (0.0, 0.0)
    gradient: Float[np.ndarray, "2 2"] | None = None
    centre: tuple[float, float] = (0.0, 0.0)

    def velocity(self, rows: Float[np.ndarray, "H 1"], columns: Float[np.ndarray, "1 W"]) -> Float[np.ndarray, "2 H W"]:
        """Velocity at every pair of a row and a column, HR pixels per frame."""
        gradient = np.zeros((2, 2)) if self.gradient is None else self.gradient
        r, c = np.broadcast_arrays(rows - self.centre[0], columns - self.centre[1])
        return np.stack([gradient[i, 0] * r + gradient[i, 1] * c + self.drift[i] for i in range(2)])

    def picture(self, still: Picture, size: tuple[int, int], elapsed: float | int) -> Float[np.ndarray, "H W"]:
        """The view `elapsed` frames after `still` lay where it was given."""
        height, width = size
        rows, columns = np.arange(height, dtype=float), np.arange(width, dtype=float)
        if self.gradient is None or not self.gradient.any():
            if size == still.size and (elapsed == 0 or self.drift == (0.0, 0.0)):
                return still.values
            return still.grid(rows - self.drift[0] * elapsed, columns - self.drift[1] * elapsed)
        generator = np.zeros((3, 3))
        generator[:2, :2] = self.gradient
        generator[:2, 2] = self.drift
        back = expm(-elapsed * generator)
        r, c = rows[:, None] - self.centre[0], columns[None, :] - self.centre[1]
        return still.at(
            back[0, 0] * r + back[0, 1] * c + back[0, 2] + self.centre[0],
            back[1, 0] * r + back[1, 1] * c + back[1, 2] + self.centre[1],
        )


class Scene(abc.ABC):
    """A scene that a sensor can look at.

    **Attributes:**
    - `size`: (H, W), HR pixels.
    - `key`: the reference time, spike frames: pictures lie where they were given at this time.
    - `span`: first and last time that it is known at; endless by default.
    """

    size: tuple[int, int]
    key: float
    span: tuple[float, float] = (-math.inf, math.inf)

    @abc.abstractmethod
    def frame(self, t: float | int) -> Float[np.ndarray, "H W"]:
        """The picture at time `t`, intensity 0..1. It may be read-only."""

    @abc.abstractmethod
    def velocity(self, t: float | int) -> Float[np.ndarray, "2 H W"]:
        """Velocity, HR pixels per frame, of the surface seen in every pixel at time `t`.

        **Raises:** `InputError` if the scene's true motion is not known.
        """

    def surface(self, t: float | int) -> UInt8[np.ndarray, "H W"]:
        """Which surface is seen in every pixel at time `t`: 0 is the hindmost."""
        return np.zeros(self.size, np.uint8)


class _Still(Scene):
    """One picture under one steady motion."""

    def __init__(self, picture: Any, motion: SteadyMotion, key: float | int):
        self._picture = picture if isinstance(picture, Picture) else Picture(picture)
        self._motion = motion
        self.size = self._picture.size
        self.key = _number(key, "key", "a time in spike frames")

    def frame(self, t: float | int) -> Float[np.ndarray, "H W"]:
        return self._motion.picture(self._picture, self.size, t - self.key)

    def velocity(self, t: float | int) -> Float[np.ndarray, "2 H W"]:
        return self._motion.velocity(*_open_grid(self.size))


class Static(_Still):
    """Nothing moves.

    **Arguments:** `picture` (H, W), see `as_intensity`; `key`, spike frames.
    """

    def __init__(self, picture: Any, *, key: float | int = KEY_FRAME):
        super().__init__(picture, SteadyMotion(), key)


class Translation(_Still):
    """The whole picture moves at one velocity, as when the camera pans.

    **Arguments:**
    - `picture`: (H, W), see `as_intensity`.
    - `velocity`: (rows, columns), HR pixels per frame.
    - `key`: spike frames.

    **Raises:** `InputError` if `velocity` is not two numbers up to a million.
    """

    def __init__(self, picture: Any, velocity: Any, *, key: float | int = KEY_FRAME):
        super().__init__(picture, SteadyMotion(_pair(velocity, "velocity", "HR pixels per frame")), key)


class Affine(_Still):
    """The picture turns, grows, shears and drifts, all at once: v(x) = L (x − centre) + drift with constant L.

    **Arguments:**
    - `picture`: (H, W), see `as_intensity`.
    - `rotation`: radians per frame, clockwise on the screen.
    - `zoom`: relative growth per frame; lengths grow by exp(zoom) in each.
    - `shear`: columns per row and frame: what lies lower moves further right.
    - `drift`: (rows, columns), HR pixels per frame.
    - `centre`: (row, column), HR pixels; the picture's centre if None.
    - `key`: spike frames.

    **Raises:** `InputError` if a number is not finite, a drift above a million, a rotation above a whole turn, zoom or
    shear above 1.
    """

    def __init__(
        self,
        picture: Any,
        *,
        rotation: float | int = 0.0,
        zoom: float | int = 0.0,
        shear: float | int = 0.0,
        drift: Any = (0.0, 0.0),
        centre: Any = None,
        key: float | int = KEY_FRAME,
    ):
        still = Picture(picture)
        turn = _number(rotation, "rotation", "radians per frame", math.tau)
        grow = _number(zoom, "zoom", "relative growth per frame", 1.0)
        lean = _number(shear, "shear", "columns per row and frame", 1.0)
        gradient = np.array([[grow, turn], [lean - turn, grow]])
        middle = _middle(still.size) if centre is None else _pair(centre, "centre", "HR pixels")
        super().__init__(still, SteadyMotion(_pair(drift, "drift", "HR pixels per frame"), gradient, middle), key)


@dataclass(frozen=True)
class Ellipse:
    """An ellipse with the given semi-axes along the rows and the columns, HR pixels."""

    semi_rows: float | int
    semi_columns: float | int

    def __post_init__(self):
        _check_extent(self, self.semi_rows, self.semi_columns)

    def coverage(self, rows: Float[np.ndarray, "H 1"], columns: Float[np.ndarray, "1 W"]) -> Float[np.ndarray, "H W"]:
        """Share of each pixel that is covered, 0 to 1, at positions counted from the centre."""
        y, x = rows / self.semi_rows, columns / self.semi_columns
        radius = np.hypot(y, x)
        # Distance to the edge to first order, exact for a circle; |∇radius| has no value at the centre, where it is not
        # needed.
        slope = np.hypot(y / self.semi_rows, x / self.semi_columns) / np.maximum(radius, 1e-12)
        return np.where(radius < 1e-9, 1.0, (0.5 - (radius - 1) / np.maximum(slope, 1e-12)).clip(0, 1))


@dataclass(frozen=True)
class Box:
    """An upright rectangle that reaches so far from its centre along the rows and the columns, HR pixels."""

    half_rows: float | int
    half_columns: float | int

    def __post_init__(self):
        _check_extent(self, self.half_rows, self.half_columns)

    def coverage(self, rows: Float[np.ndarray, "H 1"], columns: Float[np.ndarray, "1 W"]) -> Float[np.ndarray, "H W"]:
        """Share of each pixel that is covered, 0 to 1, at positions counted from the centre."""
        return _covered(rows, self.half_rows) * _covered(columns, self.half_columns)


class _Layered(Scene):
    """An opaque shape cut from one picture before a background that stands still.

    Along its edge a pixel shows a mixture by area, so the picture changes smoothly as the shape moves; its surface and
    velocity are those of whichever covers more of it.
    """

    def __init__(self, background: Any, picture: Any, shape: Any, key: float | int):
        self._background = Picture(background, "The background")
        self._picture = Picture(picture)
        if not callable(getattr(shape, "coverage", None)):
            raise InputError(
                f"shape is {shown(shape)}, but it must be an Ellipse or a Box (anything with coverage(rows, columns))."
            )
        self._shape = shape
        self.size = self._background.size
        self.key = _number(key, "key", "a time in spike frames")

    @abc.abstractmethod
    def _centre(self, t: float | int) -> tuple[float, float]:
        """The shape's centre, HR pixels."""

    @abc.abstractmethod
    def _front(self, t: float | int) -> Float[np.ndarray, "H W"]:
        """The front picture, at least where the shape covers something."""

    @abc.abstractmethod
    def _front_velocity(self) -> Float[np.ndarray, "2 H W"]:
        """Velocity of the front surface, everywhere, HR pixels per frame."""

    def _cover(self, t: float | int) -> Float[np.ndarray, "H W"]:
        rows, columns = _open_grid(self.size)
        row, column = self._centre(t)
        return self._shape.coverage(rows - row, columns - column)

    def frame(self, t: float | int) -> Float[np.ndarray, "H W"]:
        cover = self._cover(t)
        return self._background.values * (1 - cover) + self._front(t) * cover

    def surface(self, t: float | int) -> UInt8[np.ndarray, "H W"]:
        return (self._cover(t) >= 0.5).astype(np.uint8)

    def velocity(self, t: float | int) -> Float[np.ndarray, "2 H W"]:
        return self._front_velocity() * self.surface(t)


class MovingObject(_Layered):
    """An opaque object moves in a straight line before a background that stands still, hiding and uncovering it.

    **Arguments:**
    - `background`: (H, W), see `as_intensity`.
    - `picture`: the object's, of any size; it lies centred on the object and moves with it.
    - `velocity`: (rows, columns), HR pixels per frame.
    - `shape`: `Ellipse` or `Box`; the largest ellipse in `picture` if None.
    - `position`: (row, column) of its centre at the key time, HR pixels; the middle of the scene if None.
    - `key`: spike frames.

    **Raises:** `InputError` if a picture cannot be used or a number is not finite.
    """

    def __init__(
        self,
        background: Any,
        picture: Any,
        velocity: Any,
        *,
        shape: Any = None,
        position: Any = None,
        key: float | int = KEY_FRAME,
    ):
        still = as_intensity(picture)
        super().__init__(
            background, still, Ellipse(still.shape[0] / 2, still.shape[1] / 2) if shape is None else shape, key
        )
        self._velocity = _pair(velocity, "velocity", "HR pixels per frame")
        self._position = _middle(self.size) if position is None else _pair(position, "position", "HR pixels")

    def _centre(self, t: float | int) -> tuple[float, float]:
        elapsed = t - self.key
        return (self._position[0] + self._velocity[0] * elapsed, self._position[1] + self._velocity[1] * elapsed)

    def _front(self, t: float | int) -> Float[np.ndarray, "H W"]:
        centre, own = self._centre(t), _middle(self._picture.size)
        rows, columns = (np.arange(self.size[i], dtype=float) - centre[i] + own[i] for i in range(2))
        return self._picture.grid(rows, columns)

    def _front_velocity(self) -> Float[np.ndarray, "2 H W"]:
        return SteadyMotion(self._velocity).velocity(*_open_grid(self.size))


class TurningDisc(_Layered):
    """A disc with a picture of its own turns about its centre before a background that stands still.

    **Arguments:**
    - `background`: (H, W), see `as_intensity`.
    - `picture`: the disc's, of any size; it lies centred on the disc.
    - `rotation`: radians per frame, clockwise on the screen.
    - `radius`: HR pixels; 0.4 of the scene's shorter side if None.
    - `centre`: (row, column), HR pixels; the middle of the scene if None.
    - `key`: spike frames; the picture is upright then.

    **Raises:** `InputError` if a picture cannot be used or a number is not finite.
    """

    def __init__(
        self,
        background: Any,
        picture: Any,
        rotation: float | int,
        *,
        radius: float | int | None = None,
        centre: Any = None,
        key: float | int = KEY_FRAME,
    ):
        behind = as_intensity(background, "The background")
        reach = 0.4 * min(behind.shape) if radius is None else radius
        super().__init__(behind, picture, Ellipse(reach, reach), key)
        turn = _number(rotation, "rotation", "radians per frame", math.tau)
        self._middle = _middle(self.size) if centre is None else _pair(centre, "centre", "HR pixels")
        self._gradient = np.array([[0.0, turn], [-turn, 0.0]])

    def _centre(self, t: float | int) -> tuple[float, float]:
        return self._middle

    def _front(self, t: float | int) -> Float[np.ndarray, "H W"]:
        own = _middle(self._picture.size)
        back = expm(-(t - self.key) * self._gradient)
        rows, columns = _open_grid(self.size)
        r, c = rows - self._middle[0], columns - self._middle[1]
        front = np.zeros(self.size)
        seen = self._cover(t) > 0  # the disc is a part of the scene: only there is the spline worth its time
        y, x = (back[i, 0] * r + back[i, 1] * c + own[i] for i in range(2))
        front[seen] = self._picture.at(y[seen], x[seen])
        return front

    def _front_velocity(self) -> Float[np.ndarray, "2 H W"]:
        return SteadyMotion((0.0, 0.0), self._gradient, self._middle).velocity(*_open_grid(self.size))


def _covered(position: Float[np.ndarray, "..."], half: float) -> Float[np.ndarray, "..."]:
    """The part of each pixel, one wide, that lies within ±half."""
    return (np.minimum(position + 0.5, half) - np.maximum(position - 0.5, -half)).clip(0, 1)


def _open_grid(size: tuple[int, int]) -> tuple[Float[np.ndarray, "H 1"], Float[np.ndarray, "1 W"]]:
    return np.arange(size[0], dtype=float)[:, None], np.arange(size[1], dtype=float)[None, :]


def _middle(size: tuple[int, int]) -> tuple[float, float]:
    return ((size[0] - 1) / 2, (size[1] - 1) / 2)


def _number(value: Any, name: str, unit: str, most: float = _MOST_COORDINATE) -> float:
    return number(value, name, lambda v: abs(v) <= most, f"from {-most:.3g} to {most:.3g}, {unit}")


def _pair(value: Any, name: str, unit: str) -> tuple[float, float]:
    try:
        first, second = (float(v) for v in value)
    except (TypeError, ValueError, OverflowError):
        first = second = math.nan
    if not (abs(first) <= _MOST_COORDINATE and abs(second) <= _MOST_COORDINATE):
        raise InputError(
            f"{name} is {shown(value)}, but it must be two finite numbers (rows, columns), in {unit}, of "
            f"{_MOST_COORDINATE:.3g} at most either way."
        )
    return (first, second)


def _check_extent(shape: Any, *extents: Any) -> None:
    for extent in extents:
        if not _number(extent, f"the extent of {type(shape).__name__}", "HR pixels") > 0:
            raise InputError(f"{shape} is empty, but its extents must be above 0, in HR pixels.")
