"""Bounds that a case of `benchmarks.stress` has to keep, derived from how numbers are rounded, never fitted.

Notation: F = f + λΨ with Ψ(X) = φ(KX), p the dual variable, L ≥ ‖BᵀMB‖, u the unit roundoff (2⁻²⁴ in float32, 2⁻⁵³ in
float64). A sum or a chain of k operations is known to k·u of the sum of its terms' sizes (Higham, 2002, "Accuracy and
stability of numerical algorithms", §3.1, to first order).

**Agreement.** Let X come from one precision and Y from float64, both be measured in float64, and r = ∇f(X) + λK*p,
g = λ(φ(KX) + φ*(p) − ⟨KX, p⟩). As f is convex and p a subgradient of φ at KX but for g,

    F(X) − F(Y) ≤ g + ⟨r, X − Y⟩ ≤ g + ‖r‖ ‖X − Y‖.                                                              (1)

A solver reports how small ‖r‖ is: its residual ρ (`Stage.residual`) is a step's length over ‖X‖; in exact arithmetic
it has ‖r‖ ≤ max(1, βL − 1) ρ‖X‖/β (a proximal-gradient step changes ∇f along it by βH, 0 ≤ H ≤ L). The test is that the
reported ρ keeps this promise in finite precision, where r differs by

    ‖e‖ ≤ k·u ‖Bᵀ(M B|X| + c)‖ + k·u (‖X‖ + ‖R‖ + βλ‖K‖‖p‖)/β,     k = a + d,                                       (2)

the first from ∇f, the second from putting X and R together. a is how many numbers were added up for an entry of M or c
(known), d = 2·(9 + 4s + taps of the lens) + 32 the longest chain from a picture to its gradient and a step from there:
a product and a sum for each of the 9 numbers of M, each of the 4s that sliding sums add up on the way to U and back,
and each tap; then a step with its dual step and its extrapolation, which are fewer than 32 operations in a row (3 for
K*p, 3 for the picture, 1 for K, 9 for a dual step, 6 for the relaxed point, a few for R and the ridge's curvature).
FISTA carries ∇f along from iteration to iteration, with a factor below 1 and coefficients up to 4 in all, so that k
grows by 4 in each; a line search expands about the first picture, and everything else begins there: |X| is taken as at
least as large as that. M and c in bfloat16 change by 2⁻⁸ of themselves, which adds 2⁻⁸‖Bᵀ(M B|X| + c)‖. With Y in the
place of X in (1): −E(Y) ≤ F(X) − F(Y) ≤ E(X), E = g + (ρ's bound + ‖e‖)·‖X − Y‖ + d·u·λ(Ψ(X) + Ψ(Y)), the last for a
dual variable that is outside its ball by rounding. g is measured: how exact a proximal step is, is the prior's choice.

For a ridge regulariser (`ISTA`, `FISTA` and jaxopt's, L-BFGS, NonlinearCG) r = ∇f(X) + λ∇Ψ(X) and g = 0; what its
truncated proximal step leaves, ‖R − βλ∇Ψ(X) − X‖/β, is measured and added to the promise. ∇Ψ = Σ W_cᵀψ_c'(W_c X) is
known to k·u ‖Σ |W_c|ᵀ s_c |W_c| |X|‖, s_c the steepest slope of ψ_c', which stands in the place of ‖K‖‖p‖, and k grows
by the 2·taps + filters + 3 operations between X and it.

**Descent.** A step of ISTA with β ≤ 1/L, its proximal step within g of the optimum, does not raise F by more than g
(Beck and Teboulle, 2009; the majoriser at X is F(X), at the exact step it is lower, and the step made is within g of
that). F is added up from n pixels and known to (n + d)·u (½⟨B|X|, M B|X|⟩ + ⟨c, B|X|⟩ + ½e + 2λφ); the gradient's error
adds ‖e‖‖X' − X‖. A ridge regulariser's proximal step begins at X and never ends above it: g = 0. Its Ψ is known to
(n + d)·u (2Ψ + Σ |ψ_c'(W_c X)| |W_c| |X|).

L-BFGS and NonlinearCG accept a picture where the value that they calculate, βF, has not risen by more than 5 units of
2u|βF| (`_SLACK` of scsr_opt/solvers/quasi_newton.py); β and the sum of F's two parts, rounded on either side, add two
more.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.methods import PRIORS
from benchmarks.stress.cases import Case
from benchmarks.stress.data import addends
from scsr_opt.priors import Analysis, Bounded, Prior, RidgeRegulariser
from scsr_opt.priors.ridge_regulariser import correlate, correlate_adjoint, profile_and_derivative
from scsr_opt.solvers import Problem, lipschitz_bound
from scsr_opt.solvers.stopping import misfit

# Of 2u|F|: how much F may rise in a step of L-BFGS or NonlinearCG.
SLACK = 7
UNIT = {"float64": 2.0**-53, "float32": 2.0**-24, "bfloat16": 2.0**-24}
STORAGE = {"float64": 0.0, "float32": 0.0, "bfloat16": 2.0**-8}


class Measured(NamedTuple):
    """Measures of a picture, in float64: `objective` F, `misfit` g, `slope` ‖r‖, `length` ‖X‖, `gradient`
    ‖Bᵀ(M B|X| + c)‖, `step` ‖X‖ + ‖R‖ + βλ‖K‖‖p‖ (or what stands for it), `prior` λΨ, `lipschitz` L, `apart`
    ‖R − βλK*p − X‖, `value` ½⟨B|X|, M B|X|⟩ + ⟨|c|, B|X|⟩ + ½e."""

    objective: Array
    misfit: Array
    slope: Array
    length: Array
    gradient: Array
    step: Array
    prior: Array
    lipschitz: Array
    apart: Array
    value: Array


def analysis_of(prior: Prior) -> Analysis | None:
    """The prior whose dual variable certifies a picture; None where there is none."""
    inner = prior.prior if isinstance(prior, Bounded) else prior
    return inner if isinstance(inner, Analysis) else None


@eqx.filter_jit
def measure(
    problem: Problem,
    image: Float[Array, "H W"],
    origin: Float[Array, "H W"],
    gradient_step: Float[Array, "H W"],
    step_size: Float[Array, "*pixels"],
    dual: Any,
) -> Measured:
    """All quantities that the bounds are made of, in the precision of the problem. `origin`: the first picture;
    `step_size`: of all pixels, or of each."""
    λ, data = problem.strength, problem.data
    value, gradient = data.value_and_gradient(image)
    size = jnp.maximum(jnp.abs(image), jnp.abs(origin))
    norm = jnp.linalg.norm
    if isinstance(problem.prior, RidgeRegulariser):
        (penalty, slope), excess = problem.prior.value_and_gradient(image), jnp.zeros(())
        back, of_prior = λ * slope, norm(ridge_sizes(problem.prior, size)[1])
    else:
        prior = analysis_of(problem.prior)
        assert prior is not None
        penalty, excess = misfit(prior, prior.analysis(image), dual)
        back = λ * prior.adjoint(dual)
        of_prior = prior.norm_squared**0.5 * jnp.sqrt(sum(jnp.sum(p**2) for p in jax.tree.leaves(dual)))
    sizes = data.blurred_adjoint(data.stencil(data.blurred(size)) + jnp.abs(data.target))
    own = data.blurred(jnp.abs(image))
    return Measured(
        objective=value + λ * penalty,
        misfit=jnp.maximum(λ * excess, 0),
        slope=norm(gradient + back),
        length=norm(image),
        gradient=norm(sizes),
        step=norm(size) + norm(gradient_step) + jnp.max(step_size) * λ * of_prior,
        prior=λ * penalty,
        lipschitz=lipschitz_bound(data),
        apart=norm(gradient_step - step_size * back - image),
        value=jnp.sum(own * (0.5 * data.stencil(own) + jnp.abs(data.target))) + 0.5 * data.energy,
    )


def ridge_sizes(prior: RidgeRegulariser, image: Float[Array, "H W"]) -> tuple[Array, Float[Array, "H W"]]:
    """The sizes of the terms of Ψ and ∇Ψ: Σ |ψ_c'(W_c X)| |W_c| |X| and Σ |W_c|ᵀ s_c |W_c| |X|."""
    filters = jnp.abs(prior.filters)
    seen = correlate(filters, jnp.abs(image))
    _, derivative = profile_and_derivative(prior.knots, prior.slopes, correlate(prior.filters, image))
    steepest = jnp.abs(prior.slopes).max(1).astype(image.dtype)[:, None, None]
    return jnp.sum(jnp.abs(derivative) * seen), correlate_adjoint(filters, steepest * seen)


def chain(case: Case) -> int:
    """The longest chain of operations d."""
    taps = 0 if case.lens is None else 2 * (2 * int(4 * case.lens + 0.5) + 1)
    prior, bank = PRIORS[case.prior], 0
    if isinstance(prior, RidgeRegulariser):
        bank = 2 * prior.filters[0].size + len(prior.filters) + 3
    return 2 * (9 + 4 * case.scale + taps) + bank + 32


class Certificate(NamedTuple):
    """The bound E of a picture: `excess` g and `per_distance`, the rest of E over ‖X − Y‖; `objective` F in float64;
    `loss` d·uλΨ and what F is known to in float64; `size`: of the sums that f is the difference of."""

    excess: float
    per_distance: float
    objective: float
    loss: float
    size: float


def certificate(
    case: Case, seen: Measured, *, residual: float, step_size: float, iterations: int, inexact: bool
) -> Certificate:
    """The bound E of (1) and (2), up to ‖X − Y‖.

    **Arguments:** `iterations`: those that ∇f was carried along for, 0 if it is not. `inexact`: whether p is not the
    solver's own, so that what R − βλK*p misses X by is a part of r.
    """
    unit = UNIT[case.precision]
    rounding = (addends(case) + chain(case) + 4 * iterations) * unit
    growth = max(1.0, step_size * float(seen.lipschitz) - 1)
    promised = growth * residual * float(seen.length) / step_size + inexact * float(seen.apart) / step_size
    lost = (rounding + STORAGE[case.precision]) * float(seen.gradient) + rounding * float(seen.step) / step_size
    pixels = case.scale**2 * case.sensor[0] * case.sensor[1]
    known = (pixels + chain(case)) * UNIT["float64"] * float(seen.value)
    loss = chain(case) * unit * float(seen.prior) + known
    return Certificate(float(seen.misfit), promised + lost, float(seen.objective), loss, float(seen.value))


def agreement(one: Certificate, other: Certificate, distance: float) -> tuple[float, float]:
    """F(X) − F(Y), and that as a share of its bound: above 1 the two do not agree."""
    difference = one.objective - other.objective
    of = one if difference >= 0 else other
    allowed = of.excess + of.per_distance * distance + one.loss + other.loss
    return difference, abs(difference) / max(allowed, float(np.finfo(float).tiny))
