"""Priors of the form Ψ(X) = φ(K X): what they offer to splitting methods, and their proximal step by a dual method."""

import abc
import functools
import math
from collections.abc import Callable
from typing import ClassVar, Generic

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float

from scsr_opt._kernels.leafwise import leaf_by_leaf
from scsr_opt._kernels.programs import compiled
from scsr_opt.priors.prior import Prior, State
from scsr_opt.priors.strengths import divisible


class Analysis(Prior[State], Generic[State]):
    """A prior Ψ(X) = φ(K X), K a linear map and φ convex and simple: the proximal step of its conjugate is known.

    A field (an array or a pytree of arrays) is what K makes of a picture; `State`, the dual variable p, is one too. It
    is kept free of the strength: the dual variable of λΨ is λp, so that p remains a good start when λ or a step size
    changes. The proximal step

        prox(f) = argmin over X of ½‖X − f‖² + λφ(K X) = f − λK*p,   p = argmin of ½‖f − λK*p‖² + λφ*(p)

    is found by `iterations` projected gradient steps on p. Their lengths, in units of 1/(λ²‖K‖²), are one over the
    zeros of the Chebyshev polynomial on [0.2, 1], small and large in turns: on a quadratic no k lengths shrink all that
    has these eigenvalues further than the k of a cycle. From one cycle of up to five to the next goes the momentum of
    the fast gradient projection, for what has smaller ones (FGP; Beck and Teboulle, 2009, "Fast gradient-based
    algorithms for constrained total variation image denoising and deblurring"). FGP itself, steps of 1 with momentum
    from each to the next, has a proof that long steps with projections between them have not; five of its steps left
    up to half as many outer iterations more than four of these (docs/decisions/0011).

    With a strength w(p) for each pixel instead of λ (`separable` priors) it is f − wK*p, and dual steps are as long as
    a bound of K diag(w) K* on each value of the field allows (`bounds`; Pock and Chambolle, 2011, "Diagonal
    preconditioning for first order primal-dual algorithms in convex optimization").

    A proximal step from the p of a similar problem, the last one of an outer iteration for example, needs few: give the
    returned state to the next call. Four to ten are then enough. For a single one from `initial_state` use 100 or more,
    and `gap` to see how far it got.

    **Fields:** `iterations`: dual steps in each proximal step, ≥ 1; made up to whole cycles of the same length.
    """

    iterations: eqx.AbstractVar[int]

    # Whether φ* may couple the leaves of a field, pixel by pixel, while K is a few operations: see `leaf_by_leaf`.
    coupled: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def norm_squared(self) -> float:
        """An upper bound on ‖K‖²."""

    def bounds(self, strength: Float[Array, "*pixels"]) -> Float[Array, "*pixels"]:
        """b with K diag(strength) K* ≤ diag(b), for each pixel the same in all leaves of a field where φ* couples them;
        one number for all where the strength is one. A prior that is `separable` has to have its own."""
        return self.norm_squared * strength

    @abc.abstractmethod
    def analysis(self, image: Float[Array, "H W"]) -> State:
        """K X, a field."""

    @abc.abstractmethod
    def adjoint(self, field: State) -> Float[Array, "H W"]:
        """K* applied to a field."""

    @abc.abstractmethod
    def penalties(self, field: State) -> Float[Array, "..."]:
        """φ(field) as an array of the shape of the field's leaves, whose sum it is."""

    @abc.abstractmethod
    def conjugates(self, dual: State) -> Float[Array, "..."]:
        """φ*(dual) in the same way, for a dual variable that `conjugate_prox` returned; zeros where φ is a norm."""

    @abc.abstractmethod
    def conjugate_prox(self, field: State, step: Float[Array, "*pixels"]) -> State:
        """argmin over p of ½‖p − field‖² + step·φ*(p). Where φ is a norm: the nearest p in the dual unit ball."""

    def value(self, image: Float[Array, "H W"]) -> Float[Array, ""]:
        """Ψ(image) = φ(K image), in the image's unit."""
        return jnp.sum(self.penalties(self.analysis(image)))

    def shrink(self, field: State, threshold: Float[Array, ""]) -> State:
        """argmin over z of ½‖z − field‖² + threshold·φ(z), by Moreau's identity; threshold > 0."""
        scaled = jax.tree.map(lambda v: v / threshold, field)
        dual = self.conjugate_prox(scaled, 1 / threshold)
        return jax.tree.map(lambda v, p: v - threshold * p, field, dual)

    def initial_state(self, image: Float[Array, "H W"]) -> State:
        """The dual variable zero: all that is known before a first step."""
        return jax.tree.map(jnp.zeros_like, self.analysis(image))

    def prox(
        self, image: Float[Array, "H W"], strength: Float[ArrayLike, "*pixels"], state: State
    ) -> tuple[Float[Array, "H W"], State]:
        """argmin over X of ½‖X − image‖² + strength·Ψ(X), to the accuracy of `iterations` steps from `state`.

        **Arguments:**
        - `image`: f.
        - `strength`: λ, in the unit of the image, or where the prior is `separable` one for each pixel. At 0 (below
          1e-19 in float32) the image is returned as it is, and the state of one strength but for rounding; a pixel of
          strength 0 keeps its value, and the others' are found beside it.
        - `state`: from `initial_state` or from an earlier call for a picture of the same shape.

        **Returns:** the minimiser, and the dual variable to start from next time.
        """
        return self.prox_within(image, strength, state, _unbounded)

    @compiled
    def prox_within(
        self,
        image: Float[Array, "H W"],
        strength: Float[ArrayLike, "*pixels"],
        state: State,
        nearest: Callable[[Float[Array, "H W"]], Float[Array, "H W"]],
    ) -> tuple[Float[Array, "H W"], State]:
        """`prox` over the pictures of a closed convex set only, `nearest` being the projection onto it.

        The minimiser is then nearest(f − λK*p), and the dual objective has the same Lipschitz constant (Beck and
        Teboulle, 2009, §4). The result is within the set after any number of steps.
        """
        # Barriers hide numbers from XLA, and keep it from computing pictures anew for each use.
        if jnp.ndim(strength) == 0:
            off, strength = divisible(strength, image.dtype)
            # Steps of length 0, and not a choice at the end: that would make the last step more kernels than others.
            along = jnp.where(off, 0, jnp.ones_like(strength))
            bound = divisor = jax.lax.optimization_barrier(self.bounds(strength))
            rate, last = along / bound, jnp.where(off, 0, strength)
        else:
            strength, divisor = jnp.asarray(strength, image.dtype), jnp.ones((), image.dtype)
            # Values of the field that only pixels of strength 0 meet in change no picture, and may take any value:
            # to choose for each would cost a sixth more of memory's traffic.
            _, bound = divisible(self.bounds(strength), image.dtype)
            strength, rate, divisor = jax.lax.optimization_barrier((strength, 1 / bound, divisor))
            along, last = rate, strength
        cycles, lengths = dual_cycles(self.iterations)

        def step(length: float, picture: Array, dual: State, along: Array, rate: Array) -> State:
            moved = jax.tree.map(lambda p, z: p + length * along * z, dual, self.analysis(picture))
            return self.conjugate_prox(moved, length * rate)

        def cycle(dual: State) -> State:
            for length in lengths:
                # Divided as a picture, not as a field: on CPUs XLA writes the result of a division to memory once,
                # where it would compute sums anew for each neighbour that reads them or copy them for each.
                picture = nearest(image - strength * self.adjoint(dual)) / divisor
                one = functools.partial(step, length)
                given = picture, dual, along, rate
                dual = leaf_by_leaf(one, *given) if self.coupled else one(*given)
            return dual

        def ascend(carry: tuple[State, State], momentum: Array) -> tuple[tuple[State, State], None]:
            dual, ahead = carry
            moved = cycle(ahead)
            ahead = jax.tree.map(lambda new, old: new + momentum * (new - old), moved, dual)
            return (moved, ahead), None

        # Unrolled, the first picture of a cycle is computed in one pass with the last of the one before.
        (dual, _), _ = jax.lax.scan(
            ascend, (state, state), _momenta(cycles, image.dtype), unroll=cycles if cycles <= 2 else 1
        )
        return nearest(image - last * self.adjoint(dual)), dual

    def gap(self, image: Float[Array, "H W"], strength: Float[ArrayLike, ""], state: State) -> Float[Array, ""]:
        """Duality gap of the proximal problem at X = image − λK*p: how far X's objective is above the minimum, at most.

        Also ½‖X − prox‖² ≤ gap. It is λ (φ(K X) + φ*(p) − ⟨K X, p⟩), a sum of terms that are not negative (Fenchel
        and Young; but for rounding), so it loses no digits to cancellation. It is 0 exactly at the minimiser, where p
        is a subgradient.

        **Arguments:** `image` and `strength` as they were given to `prox`, and the `state` that it returned.
        """
        strength = jnp.asarray(strength, image.dtype)
        field = self.analysis(image - strength * self.adjoint(state))
        products = sum(jax.tree.leaves(jax.tree.map(lambda z, p: z * p, field, state)))
        # Summed last: term by term little is lost to cancellation.
        return strength * jnp.sum(self.penalties(field) + self.conjugates(state) - products)


def _unbounded(image: Float[Array, "H W"]) -> Float[Array, "H W"]:
    return image


def dual_cycles(iterations: int, *, most: int = 5, smallest: float = 0.2) -> tuple[int, list[float]]:
    """The number of cycles that make at least `iterations` dual steps, and the lengths of the steps of a cycle, in
    units of 1/(λ²‖K‖²).

    **Arguments:** `most`: steps of a cycle; `smallest`: the smallest eigenvalue that they are made for, as a share of
    the largest. At 0.1 long steps and the projections that follow them kept each other going.
    """
    cycles = -(-iterations // most)
    number = -(-iterations // cycles)
    angles = [math.pi * (2 * k + 1) / (2 * number) for k in range(number)]
    rising = [2 / (1 + smallest + (1 - smallest) * math.cos(angle)) for angle in angles]
    return cycles, [rising[k // 2] if k % 2 == 0 else rising[-1 - k // 2] for k in range(number)]


def _momenta(iterations: int, dtype: DTypeLike) -> Float[Array, " n"]:
    """(t_k − 1) / t_{k+1} of Beck and Teboulle for k = 1, 2, …"""
    t, momenta = 1.0, []
    for _ in range(iterations):
        following = (1 + (1 + 4 * t**2) ** 0.5) / 2
        momenta.append((t - 1) / following)
        t = following
    return jnp.asarray(momenta, dtype)
