"""Motion that the user hands in, checked."""

from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import ArrayLike

from scsr_opt.arrays import as_array, own
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion

FASTEST = 1e6
"""Sensor pixels per frame that a velocity may have either way; squares and sums of it are still numbers in float32."""


def given(velocity: ArrayLike | Sequence[float | int], height: int, width: int) -> Motion:
    """A velocity handed in by the user: (2, h, w), or two numbers for the whole scene; sensor pixels per frame.

    **Errors:** `InputError` for another shape, or values that are not finite or above `FASTEST`.
    """
    array = as_array(velocity, "velocity")
    try:
        if np.iscomplexobj(array):
            raise TypeError
        with np.errstate(over="ignore"):
            field = array.astype(np.float32)
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
    wrong = int(np.count_nonzero(~(np.abs(field) <= FASTEST)))
    if wrong:
        raise InputError(
            f"velocity holds {wrong} values that are not finite, or above {FASTEST:g} sensor pixels per frame; use 0 "
            f"where it is unknown."
        )
    return Motion.of_velocity(field)


def checked(motion: Motion, height: int, width: int) -> Motion:
    """A motion handed in by the user, as it is, in arrays that nobody else writes to.

    **Errors:** `InputError` if a field has another shape than a sensor of (h, w) asks for, or values that are not
    finite, or if a label names no layer.
    """
    motion = jax.tree.map(lambda field: own(field, "A field of velocity"), motion)
    given(motion.velocity, height, width)
    picture = (height, width)
    wanted: dict[str, tuple[np.ndarray, tuple[int, ...]]] = {
        "acceleration": (motion.acceleration, (2, *picture)), "confidence": (motion.confidence, picture)
    }  # fmt: skip
    if motion.layers is not None:
        layers, number = motion.layers, np.size(motion.layers.depth)
        if np.shape(layers.depth) != (number,) or not np.isfinite(layers.depth).all():
            raise InputError(
                f"velocity.layers.depth is {np.asarray(layers.depth).tolist()}; it must be one number a layer, the "
                f"larger the nearer."
            )
        fields = {"velocity": layers.velocity, "acceleration": layers.acceleration}
        wanted |= {f"layers.{name}": (field, (number, 2, *picture)) for name, field in fields.items()}
        wanted["layers.label"] = (layers.label, picture)
    if motion.trust is not None:
        after = np.asarray(motion.trust.after)
        if after.ndim != 1 or after.size < 2 or not np.all(np.isfinite(after)) or not np.all(np.diff(after) > 0):
            raise InputError("velocity.trust.after must be two or more times in frames, each after the one before.")
        wanted["trust.share"] = (motion.trust.share, (after.size, *picture))
    for name, (field, shape) in wanted.items():
        if np.shape(field) != shape:
            raise InputError(f"velocity.{name} has shape {np.shape(field)}; for this recording it must be {shape}.")
        if not np.isfinite(field).all():
            raise InputError(f"velocity.{name} holds values that are not finite; use 0 where it is unknown.")
    if motion.layers is not None and not np.isin(motion.layers.label, np.arange(len(motion.layers.depth))).all():
        raise InputError(
            f"velocity.layers.label holds other numbers than those of the {len(motion.layers.depth)} layers, from 0."
        )
    if motion.layers is not None:
        moves = Motion.of_layers(motion.layers, motion.confidence)
        if not np.allclose(moves.velocity, motion.velocity) or not np.allclose(moves.acceleration, motion.acceleration):
            raise InputError(
                "velocity.velocity or velocity.acceleration is not that of the layers which its labels name; make such "
                "a motion by Motion.of_layers."
            )
    return motion
