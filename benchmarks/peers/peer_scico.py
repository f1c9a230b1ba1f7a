"""scico: ADMM, proximal ADMM, PDHG, and the accelerated proximal gradient with its approximate proximal step.

Its solvers are Python loops around compiled parts. A solver is made once, its parts compiled, and put back to its start
for every run.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scico import functional, linop, loss
from scico.optimize import PDHG, AcceleratedPGM, ProximalADMM
from scico.optimize.admm import ADMM, LinearSubproblemSolver

from benchmarks.peers.in_jax import check, forward
from benchmarks.peers.problems import Case
from benchmarks.peers.rows import Method, report


def restarted(solver: Any) -> Callable[[int], Callable[[], Float[np.ndarray, "H W"]]]:
    """Runs of a scico solver, each from the state that it has now."""
    state = dict(vars(solver))

    def prepare(iterations: int) -> Callable[[], Float[np.ndarray, "H W"]]:
        vars(solver).update(state)
        solver.maxiter = iterations
        return lambda: np.asarray(solver.solve())

    return prepare


def methods(case: Case) -> Iterator[Method]:
    value, start = jnp.asarray(case.value, jnp.float32), jnp.asarray(case.start, jnp.float32)
    A = linop.LinearOperator(input_shape=case.shape, output_shape=value.shape, eval_fn=forward(case), jit=True)
    check(case, A(jnp.asarray(case.truth, jnp.float32)), case.truth)
    C = linop.FiniteDifference(case.shape, append=0, jit=True)
    strength = float(case.strength)
    f, g = loss.SquaredL2Loss(y=value, A=A), strength * functional.L21Norm()

    for factor in (1, 5, 20):
        ρ = factor * strength
        cg = LinearSubproblemSolver(cg_kwargs={"tol": 1e-4, "maxiter": 25})
        solver = ADMM(f=f, g_list=[g], C_list=[C], rho_list=[ρ], x0=start, maxiter=1, subproblem_solver=cg)
        yield Method(f"ADMM, CG(10⁻⁴, 25), ρ = {factor} λ", restarted(solver))

    # The stack [A; C], so that every part has a proximal step and no system is solved.
    stack = linop.VerticalStack([A, C], jit=True)
    both = functional.SeparableFunctional([loss.SquaredL2Loss(y=value), g])
    nothing = functional.ZeroFunctional()
    μ, ν = ProximalADMM.estimate_parameters(stack)
    for factor in (5, 20):
        ρ = factor * strength
        solver = ProximalADMM(f=nothing, g=both, A=stack, B=None, rho=ρ, mu=μ, nu=ν, x0=start, maxiter=1)
        yield Method(f"ProximalADMM, ρ = {factor} λ", restarted(solver))
    τ, σ = PDHG.estimate_parameters(stack, factor=1.01)
    for ratio in (0.2, 1, 5):
        solver = PDHG(f=nothing, g=both, C=stack, tau=τ * ratio**0.5, sigma=σ / ratio**0.5, x0=start, maxiter=1)
        yield Method(f"PDHG, τ/σ = {ratio}", restarted(solver))

    tv = strength * functional.IsotropicTVNorm(circular=False, input_shape=case.shape)
    solver = AcceleratedPGM(f=f, g=tv, L0=1.001 * case.lipschitz, x0=start, maxiter=1)
    yield Method("AcceleratedPGM, IsotropicTVNorm", restarted(solver), most=100)


if __name__ == "__main__":
    report(methods)
