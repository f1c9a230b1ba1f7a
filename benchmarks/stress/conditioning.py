"""Condition numbers of the normal operator BᵀMB, by its dense matrix, and of the systems that solvers solve."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from benchmarks.stress.bounds import UNIT, chain
from benchmarks.stress.cases import MOTIONS, Case
from benchmarks.stress.data import addends, problem_of
from scsr_opt.priors import HuberTotalVariation
from scsr_opt.solvers import lipschitz_bound

# Where slopes are below the knee, Huber-TV of this strength is a quadratic with curvature λ/δ.
STRENGTH = 1e-3


class Condition(NamedTuple):
    """**Fields:** `scale`, `motion`; `pixels` of the picture; `largest` eigenvalue; `bound` of it by which steps are
    chosen, over it; `seen`, share of the eigenvalues that are above float32's rounding; `condition`, the largest over
    the smallest of those; `with_prior` and `with_penalty`, of BᵀMB + (λ/δ)K*K and of BᵀMB + ρK*K; `spectrum`, all
    eigenvalues over the largest, falling."""

    scale: int
    motion: str
    pixels: int
    largest: float
    bound: float
    seen: float
    condition: float
    with_prior: float
    with_penalty: float
    spectrum: Float[np.ndarray, " n"]


def conditions(*, quick: bool) -> list[Condition]:
    """The condition numbers for each kind of motion, at the scales."""
    return [condition(scale, motion) for scale in ((2,) if quick else (2, 4, 8)) for motion in MOTIONS[:5]]


def condition(scale: int, motion: str) -> Condition:
    """The condition numbers by all eigenvalues, in float64, of a recording of 41 frames."""
    case = Case(precision="float64", sensor=(6, 8) if scale < 8 else (4, 5), scale=scale, motion=motion)
    with jax.enable_x64(True):
        problem = problem_of(case)
        height, width = problem.data.shape
        n = height * width
        basis = jnp.eye(n).reshape(n, height, width)
        prior = HuberTotalVariation()
        normal = np.asarray(jax.lax.map(problem.data.normal, basis)).reshape(n, n)
        smooth = np.asarray(jax.lax.map(lambda e: prior.adjoint(prior.analysis(e)), basis)).reshape(n, n)
        lipschitz = float(lipschitz_bound(problem.data))
    spectrum = np.linalg.eigvalsh((normal + normal.T) / 2)[::-1]
    largest = float(spectrum[0])
    above = spectrum > (addends(case) + chain(case)) * UNIT["float32"] * largest

    def number(matrix: np.ndarray) -> float:
        values = np.linalg.eigvalsh((matrix + matrix.T) / 2)
        return float(values[-1] / values[0])

    return Condition(
        scale=scale,
        motion=motion,
        pixels=n,
        largest=largest,
        bound=lipschitz / largest,
        seen=float(above.mean()),
        condition=largest / float(spectrum[above][-1]),
        with_prior=number(normal + STRENGTH / prior.knee * smooth),
        with_penalty=number(normal + lipschitz / prior.norm_squared * smooth),
        spectrum=spectrum / largest,
    )
