"""Step sizes as objects: `Separable`, `NormBound`, `SpectralNorm`, `Fixed` and `Backtracking` for proximal-gradient
steps, `Balance` for the two steps of a primal–dual method."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scsr_opt._validation import finite, iteration_count, positive
from scsr_opt.errors import InputError
from scsr_opt.operators.checks import spectral_norm
from scsr_opt.operators.downsample import Downsample
from scsr_opt.solvers.problem import Problem, lipschitz_bound


class StepSize(eqx.Module):
    """A rule for β of X ← prox(X − β∇f(X)). With L = ‖BᵀMB‖, every β ≤ 1/L makes the objective fall; where each
    pixel has its own, every β with BᵀMB ≤ diag(1/β)."""

    @abc.abstractmethod
    def first(self, problem: Problem) -> Float[Array, "*pixels"]:
        """β of the first iteration: one for all pixels, or one for each."""

    def needs_bound(self, problem: Problem) -> bool:
        """True where it needs `lipschitz_bound`, which is then worth keeping from solve to solve (`with_bound`)."""
        return False

    def trial(self, step_size: Float[Array, "*pixels"]) -> Float[Array, "*pixels"]:
        """β to try in the next iteration, after one with `step_size`."""
        return step_size

    def too_long(self, step_size: Float[Array, "*pixels"], curvature: Float[Array, ""]) -> Bool[Array, ""] | None:
        """Whether a step has to be taken again with `shorter` β, its curvature being ⟨d, BᵀMB d⟩/‖d‖² along the step d
        that was made. None if that is never so and need not be asked."""
        return None

    def shorter(self, step_size: Float[Array, "*pixels"], curvature: Float[Array, ""]) -> Float[Array, "*pixels"]:
        """β after one that was too long."""
        return step_size


class Separable(StepSize):
    """β of each pixel: one over the sum of its row of BᵀMB.

    No entry of B or M is negative, so that BᵀMB ≤ diag(BᵀMB·1), and f lies below a quadratic whose pixels are apart
    (De Pierro, 1995, "A modified expectation maximization algorithm for penalized likelihood estimation in emission
    tomography"; Erdogan and Fessler, 1999, "Ordered subsets algorithms for transmission tomography"). One application
    of BᵀMB finds it. L is that of the places seen most: where less was seen, steps of 1/L are shorter than they need to
    be, and a car that passes took twice as many of them (docs/decisions/0011). The proximal step is then that of a
    `separable` prior; with one that is not, and where nothing moves, so that all places are seen alike, it is
    `NormBound`.

    **Fields:** `widest` ≥ 1: how many times the shortest β the longest may be. Where hardly anything was seen, the
    prior decides, and it is its proximal step that longer ones would have to wait for.
    """

    widest: float | int = 10.0

    def __check_init__(self):
        if not finite(self.widest) >= 1:
            raise InputError(f"Separable was given widest={self.widest!r}; it is a finite factor of at least 1.")

    def first(self, problem: Problem) -> Float[Array, "*pixels"]:
        data = problem.data
        if self.needs_bound(problem):
            return NormBound().first(problem)
        rows = data.normal(jnp.ones(data.shape, data.target.dtype))
        most = jnp.max(rows)
        # Where no sample counts, f is constant, and every number is a bound.
        return jnp.where(most < jnp.finfo(most.dtype).tiny, 1, 1 / jnp.maximum(rows, most / self.widest))

    def needs_bound(self, problem: Problem) -> bool:
        return not problem.prior.separable or isinstance(problem.data.aperture, Downsample)


class NormBound(StepSize):
    """β = 1 over a certain upper bound of L (Collatz; `lipschitz_bound`).

    On pictures that were tried the bound is 0.04 to 6 % above L, for four applications of BᵀMB.
    """

    def first(self, problem: Problem) -> Float[Array, ""]:
        return 1 / lipschitz_bound(problem.data)

    def needs_bound(self, problem: Problem) -> bool:
        return True


class SpectralNorm(StepSize):
    """β = 1 over an upper bound of L from power iteration.

    The bound holds with probability 99.9 % (`scsr_opt.operators.spectral_norm`); its margin over the estimate is
    exp(ln(824 √n) / (2k − 1)) after k iterations on n pixels: 1.27 for 30 iterations at n = 1.6 million. `NormBound` is
    certain, tighter and cheaper where no entry of B or M is negative; this one needs no such thing.

    **Fields:** `iterations` k ≥ 1, each two applications of BᵀMB.
    """

    iterations: int = 30

    def __check_init__(self):
        iteration_count("SpectralNorm", self.iterations, "iterations")

    def first(self, problem: Problem) -> Float[Array, ""]:
        data = problem.data
        dtype = data.target.dtype
        # The margin is that of all iterations, so all are done: rtol 0.
        found = spectral_norm(data.normal, data.shape, iterations=self.iterations, rtol=0.0, dtype=dtype)
        return 1 / jnp.where(found.upper < jnp.finfo(dtype).tiny, 1, found.upper)  # as of `lipschitz_bound`


class Fixed(StepSize):
    """β as given. Above 1/L FISTA, and above 2/L ISTA, need not converge.

    **Fields:** `value`: β > 0.
    """

    value: float | int

    def __check_init__(self):
        positive("Fixed", "the step size", self.value)

    def first(self, problem: Problem) -> Float[Array, ""]:
        return jnp.asarray(self.value, problem.data.target.dtype)


class Backtracking(StepSize):
    """The largest β that passes a test of the step (Beck and Teboulle, 2009; that β may grow again is from Scheinberg,
    Goldfarb and Bai, 2014, "Fast first-order methods for composite convex optimization with backtracking").

    A step d is sufficient if f(A + d) ≤ f(A) + ⟨∇f(A), d⟩ + ‖d‖²/(2β). f is a quadratic, so this means that the
    curvature along d is at most 1/β, and it follows from two gradients that are known. A step that fails is made again
    with β `shrink` times as long, and the next iteration tries `growth` times the β of the last. Where few directions
    are as steep as L, steps are longer than 1/L; where most are, the repeated proximal steps make it slower.

    **Fields:** `growth` ≥ 1, 0 < `shrink` < 1.
    """

    growth: float | int = 1.1
    shrink: float | int = 0.7

    def __check_init__(self):
        if not (finite(self.growth) >= 1 and 0 < finite(self.shrink) < 1):
            raise InputError(
                f"Backtracking was given growth={self.growth!r} and shrink={self.shrink!r}; growth is a finite factor "
                "of at least 1, shrink one between 0 and 1."
            )

    def first(self, problem: Problem) -> Float[Array, ""]:
        return 1 / lipschitz_bound(problem.data)

    def needs_bound(self, problem: Problem) -> bool:
        return True

    def trial(self, step_size: Float[Array, ""]) -> Float[Array, ""]:
        return self.growth * step_size

    def too_long(self, step_size: Float[Array, ""], curvature: Float[Array, ""]) -> Bool[Array, ""]:
        # The margin is rounding's: late in a run d is small, and gradients differ in their last digits.
        return curvature * step_size > 1 + 1e3 * jnp.finfo(step_size.dtype).eps

    def shorter(self, step_size: Float[Array, ""], curvature: Float[Array, ""]) -> Float[Array, ""]:
        return self.shrink * step_size


class Balance(eqx.Module):
    """The two step sizes of a primal–dual method: σ = κ L / ‖K‖² for the dual variable λp, and the longest τ for the
    picture that the method allows with it.

    κ = 1 gives both sides the same weight. Above, the dual variable moves faster and the picture slower: better where λ
    is small beside the noise that has to be taken away.

    **Fields:** `ratio` κ > 0.
    """

    ratio: float | int = 1.0

    def __check_init__(self):
        positive("Balance", "the ratio", self.ratio)

    def dual(self, lipschitz: Float[Array, ""], norm_squared: float | int) -> Float[Array, ""]:
        """σ."""
        return self.ratio * lipschitz / norm_squared
