"""The solver that is taken where none is named."""

from scsr_opt.priors.prior import Prior
from scsr_opt.solvers.data_proximal import DataProximal
from scsr_opt.solvers.proximal_gradient import FISTA
from scsr_opt.solvers.quasi_newton import LBFGS
from scsr_opt.solvers.solver import Solver

# The largest λ·(Lipschitz constant of ∇Ψ)/L with which `DataProximal` ends before `FISTA` does: that was slower up to 5
# and as fast at 6.5. The more the prior asks for, the more iterations it takes (docs/measurements.md).
_STEEPEST = 5.0


def default_solver(prior: Prior, *, strength: float, scale: int, apart: bool) -> Solver:
    """`DataProximal` where the data are `apart` (`DataTerm.apart`) and that is the faster one, `FISTA` elsewhere.

    `LBFGS` for a smooth prior without a proximal step.

    Weights are scaled so that M ≤ 1 (`Problem`), and then L is at most 1/s².
    """
    if not prior.has_prox:
        return LBFGS()
    lipschitz = prior.lipschitz
    if apart and lipschitz is not None and strength * lipschitz * scale**2 <= _STEEPEST:
        return DataProximal()
    return FISTA()
