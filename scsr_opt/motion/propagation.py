"""A motion, and pictures along it, propagated to another key frame, so that neither is estimated anew."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scsr_opt.motion.inversion import bilinear, inverse
from scsr_opt.motion.settings import DEFAULTS
from scsr_opt.motion.trajectory import Layers, Motion, key_frame_positions
from scsr_opt.motion.trajectory_settings import TrajectorySettings


def carry(motion: Motion, frames: float | int, settings: TrajectorySettings = DEFAULTS.trajectory) -> Motion:
    """The motion `frames` later (earlier, if below 0), along its own trajectories.

    A point at q with velocity v and acceleration a is then at q + v τ + ½ a τ², sensor pixels, with velocity v + a τ.
    Points that were hidden belong to the hindmost layer. The result has no trust, which belongs to the moments around
    one key frame (`with_trust`).
    """
    if frames == 0 or not motion.moves:
        return motion
    after = jnp.asarray([frames], jnp.float32)

    def later(
        velocity: Float[np.ndarray, "2 h w"], acceleration: Float[np.ndarray, "2 h w"]
    ) -> tuple[Float[np.ndarray, "2 h w"], Float[np.ndarray, "2 h w"]]:
        v, a = jnp.asarray(velocity), jnp.asarray(acceleration)
        of_velocity, of_acceleration = np.asarray(_read(v, a, inverse(v, a, after, settings=settings)[0]))
        return of_velocity + np.float32(frames) * of_acceleration, of_acceleration

    position, visible = (np.asarray(found[0]) for found in key_frame_positions(motion, after, settings=settings))
    height, width = motion.velocity.shape[1:]
    row = np.clip(np.rint(position[0]), 0, height - 1).astype(np.intp)
    column = np.clip(np.rint(position[1]), 0, width - 1).astype(np.intp)
    confidence = motion.confidence[row, column]
    if motion.layers is None:
        # What holds until then from there holds for as much less from here.
        reach = None if motion.reach is None else np.maximum(motion.reach[row, column] - abs(frames), 0)
        return Motion(*later(motion.velocity, motion.acceleration), confidence, reach=reach)
    layers = motion.layers
    fields = [later(v, a) for v, a in zip(layers.velocity, layers.acceleration, strict=True)]
    label = np.where(visible > 0, layers.label[row, column], np.argmin(layers.depth)).astype(np.int32)
    carried = Layers(np.stack([v for v, _ in fields]), np.stack([a for _, a in fields]), label, layers.depth)
    return Motion.of_layers(carried, confidence)


@jax.jit
def _read(
    velocity: Float[Array, "2 h w"], acceleration: Float[Array, "2 h w"], place: Float[Array, "2 h w"]
) -> Float[Array, "2 2 h w"]:
    """Velocity and acceleration at key-frame positions."""
    return jnp.stack([bilinear(field, place[0], place[1]) for field in (velocity, acceleration)])


def moved_along(
    motion: Motion, frames: float | int, scale: int, pictures: Any, settings: TrajectorySettings = DEFAULTS.trajectory
) -> Any:
    """`pictures`, a tree of arrays, with each array of the high-resolution picture's shape, (…, s·h, s·w), moved along
    `motion` for `frames` frames; other arrays are left as they are. `scale`: s."""
    if frames == 0 or not motion.moves:
        return pictures
    shape = tuple(scale * side for side in motion.velocity.shape[1:])
    leaves, structure = jax.tree.flatten(pictures)
    # An array that occurs several times is moved once.
    of_shape = {id(leaf): leaf for leaf in leaves if getattr(leaf, "shape", ())[-2:] == shape}
    position = key_frame_positions(motion, jnp.asarray([frames], jnp.float32), settings=settings)[0][0]
    there = _resampled([jnp.asarray(leaf) for leaf in of_shape.values()], position)
    moved = dict(zip(of_shape, there, strict=True))
    return jax.tree.unflatten(structure, [moved.get(id(leaf), leaf) for leaf in leaves])


@jax.jit
def _resampled(pictures: list[Float[Array, "... H W"]], position: Float[Array, "2 h w"]) -> list[Array]:
    """The pictures at key-frame positions that are given on the sensor's grid, sensor pixels."""
    if not pictures:
        return []
    height, width = pictures[0].shape[-2:]
    here = jnp.indices(position.shape[1:], position.dtype)
    shift = height // position.shape[1] * jax.image.resize(position - here, (2, height, width), "linear")
    rows, columns = jnp.indices((height, width), position.dtype) + shift
    return [bilinear(one.reshape(-1, height, width), rows, columns).reshape(one.shape) for one in pictures]
