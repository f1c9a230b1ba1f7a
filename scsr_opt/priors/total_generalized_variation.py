"""Total generalised variation of second order: edges stay edges, and slopes stay slopes."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from scsr_opt._kernels.programs import compiled
from scsr_opt._validation import iteration_count, positive
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.strengths import divisible
from scsr_opt.priors.total_variation import Dual, gradient, gradient_adjoint, lengths, to_unit_ball

# ‖(X, w) ↦ (∇X − w, E w)‖² ≤ the larger eigenvalue of [[8, √8], [√8, 1 + 8]]; without X it is 9.
_NORM_SQUARED = (17 + 33**0.5) / 2


class Bending(NamedTuple):
    """E w, the symmetrised derivative of a vector field: down of `down`, right of `right`, and √2 times the mean of the
    mixed ones, so that its Euclidean length is that of the symmetric matrix."""

    down: Float[Array, "H W"]
    right: Float[Array, "H W"]
    mixed: Float[Array, "H W"]


class SlopeState(NamedTuple):
    """`slope` w, and the dual variables of ∇X − w (length ≤ 1) and of E w (length ≤ ratio); none scales with λ."""

    slope: Dual
    edges: Dual
    bends: Bending


class TotalGeneralizedVariation(Prior[SlopeState]):
    """Ψ(X) = min over w of Σ_p |∇X(p) − w(p)| + α Σ_p |E w(p)|, TGV of second order (Bredies, Kunisch, Pock, 2010,
    "Total generalized variation").

    w is a vector field that follows the slope of X, and E w its symmetrised derivative: an edge is paid for as in
    `TotalVariation`, a slope only where it changes. Affine pictures cost nothing, up to the border: differences that
    would reach outside the picture do not exist. For shaded and curved surfaces, out of which total variation makes
    stairs. An iteration of FISTA costs some twenty-five times as much as with total variation.

    The proximal step is min over (X, w) of ½‖X − f‖² + λ(…) by `iterations` primal–dual steps (Chambolle and Pock,
    2011, "A first-order primal-dual algorithm for convex problems with applications to imaging"), from w and the dual
    variables of the last call. It is inexact and not monotone, and the stronger λ, the more steps it takes. How far
    above its minimum F is where FISTA ends, with 10 / 20 / 40 / 80 steps when warm-started: 1e-4 / 6e-7 / 1e-7 / 0 at
    the best λ for a photograph, 1e-2 / 4e-6 / 7e-8 / 7e-8 at four times that, 0.2 / 5e-3 / 7e-6 / 2e-6 at 16 times. 40
    take 1.4 times as long as 10, in iterations of which a third suffices. A single step from `initial_state` wants
    several hundred.

    `value` finds w by `value_iterations` such steps with X fixed, from w = 0. Being taken at an actual w it is an upper
    bound on Ψ, 0.5 to 1 % above it after 50 steps and 0.1 to 0.3 % after 100 (photograph, clean, noisy and denoised);
    it costs as much as a proximal step of that many iterations. Its derivative is that at fixed w.

    **Arguments:**
    - `ratio`: α > 0, in pixels; below about 1 bends are cheap and edges blur into them, far above 2 it is total
      variation.
    - `iterations`, `value_iterations`: ≥ 1.

    **Errors:** `InputError` for other values.
    """

    # Primal steps are these multiples of the strength, or of the mean |∇X| where X is fixed: they have the picture's
    # unit, as w has, so that a picture in other units takes the same steps. Measured on denoising at several strengths:
    # 0.1 to 0.3 are best for 10 to 200 steps, 1 is 3 times slower; with X fixed 0.03, and 0.3 is 5 times slower.
    STEP: ClassVar[float] = 0.2
    VALUE_STEP: ClassVar[float] = 0.03

    ratio: float = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    value_iterations: int = eqx.field(static=True)

    def __init__(self, ratio: float | int = 2.0, iterations: int = 40, value_iterations: int = 50):
        self.ratio = positive("TotalGeneralizedVariation", "the ratio", ratio)
        self.iterations = iteration_count("TotalGeneralizedVariation", iterations, "iterations")
        self.value_iterations = iteration_count(
            "TotalGeneralizedVariation", value_iterations, "iterations of the value"
        )

    @compiled
    def value(self, image: Float[Array, "H W"]) -> Float[Array, ""]:
        """Ψ(image), from above, to the accuracy of `value_iterations`."""
        slopes = gradient(image)
        fixed = jax.lax.stop_gradient(slopes)
        # The unit: positive for a flat picture too, where any step serves.
        tiny = jnp.finfo(image.dtype).tiny ** 0.5
        unit = jnp.maximum(jnp.mean(lengths(fixed.down**2 + fixed.right**2)), tiny)
        primal, dual = self.VALUE_STEP * unit, 1 / (9 * self.VALUE_STEP * unit)

        def advance(state: SlopeState, _: None) -> tuple[SlopeState, None]:
            slope, ahead = _follow(state, primal)
            return SlopeState(slope, *self._ascend(state, fixed, ahead, dual)), None

        state, _ = jax.lax.scan(advance, self.initial_state(image), None, length=self.value_iterations)
        misfit = jax.tree.map(lambda g, w: g - w, slopes, state.slope)
        bends = bending(state.slope)
        squares = bends.down**2 + bends.right**2 + bends.mixed**2
        return jnp.sum(lengths(misfit.down**2 + misfit.right**2) + self.ratio * lengths(squares))

    def initial_state(self, image: Float[Array, "H W"]) -> SlopeState:
        """All zero: no slope, and nothing known of edges and bends."""
        zero = jnp.zeros_like(image)
        return SlopeState(Dual(zero, zero), Dual(zero, zero), Bending(zero, zero, zero))

    @compiled
    def prox(
        self, image: Float[Array, "H W"], strength: Float[ArrayLike, ""], state: SlopeState
    ) -> tuple[Float[Array, "H W"], SlopeState]:
        """argmin over X of ½‖X − image‖² + strength·Ψ(X), to the accuracy of `iterations` steps from `state`.

        **Arguments:**
        - `image`: f.
        - `strength`: λ, in the unit of the image. At 0 (below 1e-19 in float32), the image and the state are returned
          as they are.
        - `state`: from `initial_state` or from an earlier call for a picture of the same shape.

        **Returns:** the minimiser, and the state to start from next time.
        """
        off, strength = divisible(strength, image.dtype)
        primal, dual = self.STEP * strength, 1 / (_NORM_SQUARED * self.STEP * strength)

        def best(edges: Dual) -> Array:
            """X where the edges' dual variable is given."""
            return image - strength * gradient_adjoint(edges)

        def advance(carry: tuple[Array, SlopeState], _: None) -> tuple[tuple[Array, SlopeState], None]:
            picture, state = carry
            # Its proximal step with respect to ½‖X − f‖²/λ.
            moved = (picture + self.STEP * best(state.edges)) / (1 + self.STEP)
            slope, ahead = _follow(state, primal)
            edges, bends = self._ascend(state, gradient(2 * moved - picture), ahead, dual)
            return (moved, SlopeState(slope, edges, bends)), None

        (_, following), _ = jax.lax.scan(advance, (best(state.edges), state), None, length=self.iterations)
        following = jax.tree.map(lambda old, new: jnp.where(off, old, new), state, following)
        return jnp.where(off, image, best(following.edges)), following

    def _ascend(self, state: SlopeState, slopes: Dual, slope: Dual, step: Array) -> tuple[Dual, Bending]:
        """The dual variables after a step, ∇X and w being given."""
        edges = to_unit_ball(jax.tree.map(lambda p, g, w: p + step * (g - w), state.edges, slopes, slope))
        bends = jax.tree.map(lambda q, e: q + step * e, state.bends, bending(slope))
        squares = bends.down**2 + bends.right**2 + bends.mixed**2
        shrink = self.ratio * jax.lax.rsqrt(jnp.maximum(squares, self.ratio**2))
        return edges, jax.tree.map(lambda q: shrink * q, bends)


def bending(slope: Dual) -> Bending:
    """E w: differences within the picture, 0 where one would reach outside; w past the last row and column is none."""
    height, width = slope.down.shape
    row, column = np.arange(height)[:, None], np.arange(width)
    above = jnp.pad(slope.down[:-1], ((1, 0), (0, 0)))
    before = jnp.pad(slope.right[:, :-1], ((0, 0), (1, 0)))
    after = jnp.pad(slope.down[:, 1:], ((0, 0), (0, 1)))
    below = jnp.pad(slope.right[1:], ((0, 1), (0, 0)))
    mixed = 0.5**0.5 * (after - slope.down + (below - slope.right))
    return Bending(
        jnp.where((row > 0) & (row < height - 1), slope.down - above, 0),
        jnp.where((column > 0) & (column < width - 1), slope.right - before, 0),
        jnp.where((row < height - 1) & (column < width - 1), mixed, 0),
    )


def bending_adjoint(bends: Bending) -> Dual:
    """E* of a field of bends."""
    (slope,) = jax.linear_transpose(bending, Dual(bends.down, bends.right))(bends)
    return slope


def _follow(state: SlopeState, step: Array) -> tuple[Dual, Dual]:
    """w after a step, and the point ahead of it that the dual steps take."""
    push = jax.tree.map(lambda p, e: p - e, state.edges, bending_adjoint(state.bends))
    slope = jax.tree.map(lambda w, v: w + step * v, state.slope, push)
    return slope, jax.tree.map(lambda new, old: 2 * new - old, slope, state.slope)
