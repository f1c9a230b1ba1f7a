"""optimistix: LBFGS and NonlinearCG. It has no proximal solver, so total variation is smoothed,
Σ √(|∇X|² + ε²), with two ε: a smaller one takes longer, a larger one does not come within 0.1 % of the true minimum."""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from benchmarks.peers.in_jax import check, forward
from benchmarks.peers.peer_jaxopt import gradient
from benchmarks.peers.problems import Case
from benchmarks.peers.rows import Method, report


def methods(case: Case) -> Iterator[Method]:
    apply, value = forward(case), jnp.asarray(case.value, jnp.float32)
    check(case, jax.jit(apply)(jnp.asarray(case.truth, jnp.float32)), case.truth)
    start, strength = jnp.asarray(case.start, jnp.float32), float(case.strength)
    for ε in (3e-3, 1e-3):

        def objective(x: Array, _, ε=ε) -> Array:
            smooth = jnp.sqrt(jnp.sum(gradient(x) ** 2, axis=0) + ε**2)
            return 0.5 * jnp.sum((apply(x) - value) ** 2) + strength * jnp.sum(smooth)

        # Tolerances that are never met: the count of steps alone ends a run.
        for name, solver in (
            ("LBFGS", optx.LBFGS(rtol=1e-12, atol=1e-12)),
            ("NonlinearCG", optx.NonlinearCG(rtol=1e-12, atol=1e-12)),
        ):

            @eqx.filter_jit
            def minimise(start, most, objective=objective, solver=solver):
                return optx.minimise(objective, solver, start, max_steps=most, throw=False).value

            yield Method(f"{name}, TV smoothed with ε = {ε:g}", lambda n, go=minimise: lambda: np.asarray(go(start, n)))


if __name__ == "__main__":
    report(methods)
