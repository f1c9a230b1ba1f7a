"""Checks of a motion that a user gives."""

import jax
import numpy as np

from scsr_opt._arrays import own
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion

FASTEST = 1e6
"""Largest component of a velocity, sensor pixels per frame: its squares and sums are still finite in float32."""


def validate_motion(motion: Motion, height: int, width: int) -> Motion:
    """A copy of `motion`, checked for a sensor of (height, width).

    **Raises:** `InputError` if a field has another shape than this sensor needs or values that are not finite, if a
    velocity is above `FASTEST`, if a label names no layer, or if a velocity is not that of its layer.
    """
    motion = jax.tree.map(lambda field: own(field, "A field of motion"), motion)
    picture = (height, width)
    wanted: dict[str, tuple[np.ndarray, tuple[int, ...]]] = {
        "velocity": (motion.velocity, (2, *picture)),
        "acceleration": (motion.acceleration, (2, *picture)),
        "confidence": (motion.confidence, picture),
    }
    if motion.layers is not None:
        layers, number = motion.layers, np.size(motion.layers.depth)
        if np.shape(layers.depth) != (number,) or not np.isfinite(layers.depth).all():
            raise InputError(
                f"motion.layers.depth is {np.asarray(layers.depth).tolist()}; it must be one number a layer, the "
                f"larger the nearer."
            )
        fields = {"velocity": layers.velocity, "acceleration": layers.acceleration}
        wanted |= {f"layers.{name}": (field, (number, 2, *picture)) for name, field in fields.items()}
        wanted["layers.label"] = (layers.label, picture)
    if motion.trust is not None:
        after = np.asarray(motion.trust.after)
        if after.ndim != 1 or after.size < 2 or not np.all(np.isfinite(after)) or not np.all(np.diff(after) > 0):
            raise InputError("motion.trust.after must be two or more times in frames, each after the one before.")
        wanted["trust.share"] = (motion.trust.share, (after.size, *picture))
    if motion.reach is not None:
        if np.shape(motion.reach) != picture or not (motion.reach >= 0).all():
            raise InputError(
                f"motion.reach has shape {np.shape(motion.reach)}; it must be {picture}, frames of 0 or more; infinite "
                f"where the motion holds throughout."
            )
    for name, (field, shape) in wanted.items():
        if np.shape(field) != shape:
            raise InputError(f"motion.{name} has shape {np.shape(field)}; for this recording it must be {shape}.")
        if not np.isfinite(field).all():
            raise InputError(f"motion.{name} holds values that are not finite; use 0 where it is unknown.")
    if not (np.abs(motion.velocity) <= FASTEST).all():
        raise InputError(
            f"motion.velocity holds values above {FASTEST:g} sensor pixels per frame; use 0 where unknown."
        )
    if motion.layers is not None and not np.isin(motion.layers.label, np.arange(len(motion.layers.depth))).all():
        raise InputError(
            f"motion.layers.label holds other numbers than those of the {len(motion.layers.depth)} layers, from 0."
        )
    if motion.layers is not None:
        moves = Motion.of_layers(motion.layers, motion.confidence)
        if not np.allclose(moves.velocity, motion.velocity) or not np.allclose(moves.acceleration, motion.acceleration):
            raise InputError(
                "motion.velocity or motion.acceleration is not that of the layers which its labels name; make such "
                "a motion by Motion.of_layers."
            )
    return motion
