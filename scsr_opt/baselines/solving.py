"""Eq. 4 with total variation, from placed samples to the picture: the solve that some baselines end with.

It is kept apart from `reconstruct`, so that the baselines stay what they are when that becomes better.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from scsr_opt.baselines.settings import DEFAULT
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.sampling import PlacedSamples, accumulate
from scsr_opt.priors.total_variation import TotalVariation
from scsr_opt.solvers.loop import run
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA


def solved(placed: PlacedSamples, start: Float[np.ndarray, "H W"], strength: float) -> Float[np.ndarray, "H W"]:
    """argmin over X of ½ Σ_j ω_j (r_j·B X − Y_j)² + λ TV(X), by FISTA from the picture `start`.

    **Arguments:**
    - `placed`: Y_j, ω_j and r_j; without any that takes part, `start` is returned.
    - `strength`: λ.
    """
    if not np.asarray(placed.weight).any():
        return start
    # To the end: where a solve stops early, rounding decides where.
    solver = FISTA(iterations=1000, tolerance=1e-6)
    prior, λ = TotalVariation(iterations=10), jnp.asarray(strength, jnp.float32)
    uncorrected = term = accumulate(placed)
    outcome = run(solver, Problem(term, prior, λ), jnp.asarray(start))
    for _ in range(DEFAULT.corrections if placed.finest > 1 else 0):
        term = with_exposure(uncorrected, placed, jnp.asarray(outcome.image))
        outcome = run(solver, Problem(term, prior, λ), jnp.asarray(outcome.image), similar=outcome.state)
    return outcome.image
