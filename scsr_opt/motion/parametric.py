"""Motion of the whole scene with few numbers: translation or affine, with acceleration."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scsr_opt.motion.alignment import Stretches, drift, presmoothed, smooth
from scsr_opt.motion.trajectory import Motion

# (frames from the key frame that take part, presmoothing in sensor pixels, Gauss–Newton steps): from near and blurred
# to everything and sharp.
_SCHEDULE = ((8, 2.5, 10), (16, 1.5, 6), (32, 1.2, 5), (np.inf, 1.0, 5))

# In a region that was found by contradicting something, a good part may belong to other surfaces: the motion is that of
# the share that agrees best, and the start is trusted enough to leave out the nearest times.
_MINORITY = 0.2


def parametric(
    pictures: Stretches,
    *,
    affine: bool = True,
    start: Motion | None = None,
    where: Bool[np.ndarray, "h w"] | None = None,
) -> Motion:
    """One velocity (and acceleration) for the whole scene, or one that varies linearly over the picture.

    Minimises the variance of the pictures along the motion, weighted down where it stays high (another motion,
    occlusion), by Gauss–Newton from near times to far ones. 2 numbers for a translation, 6 for affine motion, twice
    that with the acceleration that is fitted last. `start` gives a first velocity (its mean is used). With
    `where`, only these pixels of the key frame are looked at; the motion is still given everywhere.
    """
    height, width = pictures.picture.shape[1:]
    rows, columns = np.mgrid[0:height, 0:width]
    size = max(height, width)
    shapes = [np.ones((height, width)), (rows - (height - 1) / 2) / size, (columns - (width - 1) / 2) / size]
    basis = jnp.asarray(np.stack(shapes if affine else shapes[:1]), jnp.float32)
    velocity = jnp.zeros((basis.shape[0], 2), jnp.float32)
    if start is not None:
        known = start.velocity if where is None else start.velocity[:, where]
        velocity = velocity.at[0].set(jnp.asarray(known.reshape(2, -1).mean(1), jnp.float32))
    acceleration = jnp.zeros_like(velocity)
    region = jnp.ones((height, width), jnp.float32) if where is None else jnp.asarray(where, jnp.float32)
    schedule, majority = (_SCHEDULE, 0.5) if where is None else (_SCHEDULE[1:], _MINORITY)
    for reach, sigma, steps in schedule:
        part = (jnp.abs(pictures.after) <= reach).astype(jnp.float32)
        with_acceleration = reach == np.inf and pictures.after.shape[0] >= 4
        velocity, acceleration = _fit(
            presmoothed(pictures, sigma),
            part,
            region,
            basis,
            velocity,
            acceleration,
            jnp.asarray(steps),
            jnp.asarray(majority),
            with_acceleration,
        )
    field = np.asarray(jnp.einsum("phw,pc->chw", basis, velocity))
    change = np.asarray(jnp.einsum("phw,pc->chw", basis, acceleration))
    return Motion(field, change, np.ones((height, width), np.float32))


@partial(jax.jit, static_argnames=("with_acceleration",))
def _fit(
    pictures: Stretches,
    part: Float[Array, " n"],
    region: Float[Array, "h w"],
    basis: Float[Array, "p h w"],
    velocity: Float[Array, "p 2"],
    acceleration: Float[Array, "p 2"],
    steps: Int[Array, ""],
    majority: Float[Array, ""],
    with_acceleration: bool,
) -> tuple[Float[Array, "p 2"], Float[Array, "p 2"]]:
    orders = 2 if with_acceleration else 1
    unknowns = orders * 2 * basis.shape[0]

    def step(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        velocity, acceleration = carry
        now = drift(
            pictures.picture,
            pictures.after,
            part,
            jnp.einsum("phw,pc->chw", basis, velocity),
            jnp.einsum("phw,pc->chw", basis, acceleration),
        )
        # Cauchy weights: regions that move otherwise stop pulling as soon as the rest agrees.
        mismatch = smooth(now.residual / jnp.maximum(now.seen, 1), jnp.asarray(1.5))
        # Every third row and column say as much about it, and sorting all of them would take as long as the rest.
        usual = jnp.nanquantile(jnp.where(region > 0, mismatch, jnp.nan)[::3, ::3], majority)
        usual = jnp.where(jnp.isnan(usual), jnp.sum(region * mismatch) / jnp.maximum(jnp.sum(region), 1), usual)
        trust = region / (1 + (mismatch / (3 * usual + 1e-12)) ** 2)
        # Regressors: each basis picture times each component of the slope, once for the velocity, once for the
        # acceleration.
        regressors = (now.slope[:, None] * basis[None]).reshape(2 * basis.shape[0], -1)
        weights = (now.spread * trust[None, None]).reshape(2, 2, -1)
        matrix = jnp.concatenate(
            [
                jnp.concatenate([(regressors * weights[q, r][None]) @ regressors.T for r in range(orders)], axis=1)
                for q in range(orders)
            ]
        )
        right = jnp.concatenate([-regressors @ (now.change[q] * trust).reshape(-1) for q in range(orders)])
        # Unit diagonal: velocities and accelerations differ by orders of magnitude. A trace of damping keeps the step
        # finite where the picture has no texture.
        scale = 1 / jnp.sqrt(jnp.diag(matrix) + 1e-12)
        scaled = matrix * scale[:, None] * scale[None, :] + 1e-6 * jnp.eye(unknowns, dtype=matrix.dtype)
        update = (jnp.linalg.solve(scaled, right * scale) * scale).reshape(orders, 2, -1)
        velocity = velocity + update[0].T
        if with_acceleration:
            acceleration = acceleration + update[1].T
        return velocity, acceleration

    return jax.lax.fori_loop(0, steps, step, (velocity, acceleration))
