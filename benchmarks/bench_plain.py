"""Iterations as they would be written without thinking of memory, to hold those of the solvers against.

Each operator is compiled on its own, and nothing is fused across them. These are the same steps and give the same
numbers (`tests/benchmarks/test_bench.py`), with Huber-TV and a perfect lens.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from scsr_opt.priors import Dual, HuberTotalVariation
from scsr_opt.priors.analysis import dual_cycles
from scsr_opt.priors.total_variation import gradient, gradient_adjoint, to_unit_ball
from scsr_opt.solvers import CondatVu, Problem
from scsr_opt.solvers.primal_dual import PrimalDualState
from scsr_opt.solvers.proximal_gradient import ProximalGradientState
from scsr_opt.solvers.splitting import Dual as Split

_minus = jax.jit(lambda x, y: x - y)
_ahead_by = jax.jit(lambda a, x, y: x + a * y)
_beyond = jax.jit(lambda x, a, y, b, z: x + a * (x - y) + b * (x - z))
_inner = jax.jit(lambda x, y: jnp.sum(x * y))
_norm = jax.jit(jnp.linalg.norm)
_gradient = jax.jit(gradient)
_gradient_adjoint = jax.jit(gradient_adjoint)
_shorter = jax.jit(lambda dual, a: Dual(dual.down / a, dual.right / a))
_ball = jax.jit(to_unit_ball)
_apply = eqx.filter_jit(lambda operator, x: operator(x))
_back = eqx.filter_jit(lambda operator, x: operator.adjoint(x))
_penalties = eqx.filter_jit(lambda prior, field: prior.penalties(field))
_conjugates = eqx.filter_jit(lambda prior, dual: prior.conjugates(dual))
_sum = jax.jit(jnp.sum)
_times = jax.jit(lambda x, y: x * y)
_relaxed = jax.jit(lambda a, new, old: old + a * (new - old))


def plain_fista(problem: Problem, state: ProximalGradientState) -> tuple[ProximalGradientState, tuple[Array, ...]]:
    """One iteration of `FISTA` with `HuberTotalVariation` and one step size for all pixels, operator by operator; and
    f, λΨ and the residual."""
    data, prior, step = problem.data, problem.prior, state.step_size
    assert isinstance(prior, HuberTotalVariation) and data.optics is None
    before = _ahead_by(-step, state.ahead, state.ahead_gradient)
    image, dual = _plain_prox(prior, before, step * problem.strength, state.prior)
    value, slope = _value_and_gradient(problem, image)
    penalty = problem.strength * _sum(_penalties(prior, _gradient(image)))
    residual = _norm(_minus(image, state.ahead)) / _norm(image)
    objective = value + penalty
    uphill = _inner(_minus(state.ahead, image), _minus(image, state.image)) > 0
    uphill |= objective > state.objective
    t = jnp.where(uphill, 1, state.momentum)
    following = (1 + jnp.sqrt(1 + 4 * t**2)) / 2
    along, beyond = jnp.where(uphill, 0, (t - 1) / following), jnp.where(uphill, 0, t / following)
    after = ProximalGradientState(
        image=image, gradient=slope, gradient_step=before, momentum=following, objective=objective, prior=dual,
        ahead=_beyond(image, along, state.image, beyond, state.ahead),
        ahead_gradient=_beyond(slope, along, state.gradient, beyond, state.ahead_gradient), step_size=step,
    )  # fmt: skip
    return after, (value, penalty, residual)


def _plain_prox(prior: HuberTotalVariation, image: Array, strength: Array, state: Dual) -> tuple[Array, Dual]:
    """The dual steps of `Analysis.prox`, one operator after the other."""
    cycles, lengths = dual_cycles(prior.iterations)
    assert cycles == 1  # no momentum, then
    dual = state
    for length in lengths:
        step = length / (prior.norm_squared * strength)
        field = _gradient(_ahead_by(-strength, image, _gradient_adjoint(dual)))
        moved = Dual(*(_ahead_by(step, p, z) for p, z in zip(dual, field, strict=True)))
        dual = _ball(_shorter(moved, 1 + step * prior.knee))
    return _ahead_by(-strength, image, _gradient_adjoint(dual)), dual


def plain_condat_vu(problem: Problem, state: PrimalDualState) -> tuple[PrimalDualState, tuple[Array, ...]]:
    """One iteration of `CondatVu` in the same way; and f, λΨ and the residual."""
    solver, prior, λ = CondatVu(), problem.prior, problem.strength
    assert isinstance(prior, HuberTotalVariation)
    over, β = solver._over, 1 / state.lipschitz
    τ, σ = solver._primal(state.lipschitz), solver.balance.dual(state.lipschitz, prior.norm_squared)
    image = _ahead_by(-τ, state.ahead, _ahead_by(λ, state.ahead_gradient, state.ahead_back))
    value, slope = _value_and_gradient(problem, image)
    mirrored = _gradient(_minus(_ahead_by(1, image, image), state.ahead))
    moved = Dual(*(_ahead_by(σ / λ, p, z) for p, z in zip(state.ahead_dual.field, mirrored, strict=True)))
    dual = _ball(_shorter(moved, 1 + σ / λ * prior.knee))
    back = _gradient_adjoint(dual)
    field = _gradient(image)
    penalties = _penalties(prior, field)
    misfit = _ahead_by(1, penalties, _conjugates(prior, dual))
    for z, p in zip(field, dual, strict=True):
        misfit = _minus(misfit, _times(z, p))
    steep = _ahead_by(λ, slope, back)
    residual = jnp.sqrt(β**2 * _inner(steep, steep) + 2 * β * jnp.maximum(λ * _sum(misfit), 0)) / _norm(image)
    moved = Dual(*(_relaxed(over, new, old) for new, old in zip(dual, state.ahead_dual.field, strict=True)))
    after = PrimalDualState(
        image=image, dual=Split(dual, None, None), back=back, ahead=_relaxed(over, image, state.ahead),
        ahead_gradient=_relaxed(over, slope, state.ahead_gradient), ahead_dual=Split(moved, None, None),
        ahead_back=_relaxed(over, back, state.ahead_back), lipschitz=state.lipschitz,
    )  # fmt: skip
    return after, (value, λ * _sum(penalties), residual)


def _value_and_gradient(problem: Problem, image: Array) -> tuple[Array, Array]:
    """f and ∇f."""
    data = problem.data
    assert data.optics is None
    u = _apply(data.aperture, image)
    rest = _minus(_apply(data.stencil, u), data.target)
    value = 0.5 * (_inner(u, rest) - _inner(u, data.target) + data.energy)
    return value, _back(data.aperture, rest)
