"""jaxopt: ProximalGradient, plain and accelerated, in one compiled loop.

It has no proximal step of total variation; the one used here is the dual fast gradient projection of Beck and
Teboulle (2009), which starts anew each time because jaxopt's proximal steps have no memory.
"""

import warnings
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.peers.in_jax import check, forward
from benchmarks.peers.problems import Case
from benchmarks.peers.rows import Method, report

warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)

import jaxopt  # noqa: E402


def gradient(x: Float[Array, "H W"]) -> Float[Array, "2 H W"]:
    """∇X, by padding and slices, which XLA fuses."""
    wide = jnp.pad(x, ((0, 1), (0, 1)), mode="edge")
    return jnp.stack([wide[1:, :-1] - x, wide[:-1, 1:] - x])


def adjoint(p: Float[Array, "2 H W"]) -> Float[Array, "H W"]:
    """∇*p for a p with zeros in its last row and column."""
    return jnp.pad(p[0, :-1], ((1, 0), (0, 0))) - p[0] + jnp.pad(p[1, :, :-1], ((0, 0), (1, 0))) - p[1]


def prox(inner: int) -> Callable[[Array, Array, Array], Array]:
    """The proximal step of λ·scale·TV by `inner` dual steps."""

    def of(u: Array, strength: Array, scale: Array = 1.0) -> Array:
        λ = strength * scale

        def ascend(_, carry):
            p, ahead, t = carry
            moved = ahead + gradient(u - λ * adjoint(ahead)) / (8 * λ)
            moved = moved / jnp.maximum(1, jnp.sqrt(jnp.sum(moved**2, axis=0)))
            following = (1 + jnp.sqrt(1 + 4 * t**2)) / 2
            return moved, moved + (t - 1) / following * (moved - p), following

        zero = jnp.zeros((2, *u.shape), u.dtype)
        p, _, _ = jax.lax.fori_loop(0, inner, ascend, (zero, zero, jnp.ones((), u.dtype)))
        return u - λ * adjoint(p)

    return of


def methods(case: Case) -> Iterator[Method]:
    apply, value = forward(case), jnp.asarray(case.value, jnp.float32)
    check(case, jax.jit(apply)(jnp.asarray(case.truth, jnp.float32)), case.truth)
    start, strength = jnp.asarray(case.start, jnp.float32), float(case.strength)
    step_size = 1 / (1.001 * case.lipschitz)

    def data(x: Array) -> Array:
        return 0.5 * jnp.sum((apply(x) - value) ** 2)

    settings = [("accelerated", inner, True, step_size) for inner in (5, 10, 20, 50)]
    settings += [("plain", 20, False, step_size), ("accelerated, line search", 20, True, 0.0)]
    for name, inner, accelerated, step in settings:
        solver = jaxopt.ProximalGradient(
            data, prox=prox(inner), stepsize=step, acceleration=accelerated, implicit_diff=False
        )

        @jax.jit
        def loop(iterations, start, solver=solver):
            def one(_, carry):
                return tuple(solver.update(*carry, strength))

            return jax.lax.fori_loop(0, iterations, one, (start, solver.init_state(start, strength)))[0]

        yield Method(f"ProximalGradient {name}, TV({inner})", lambda n, loop=loop: lambda: np.asarray(loop(n, start)))


if __name__ == "__main__":
    report(methods)
