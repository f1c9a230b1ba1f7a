"""The solver that is taken where none is named."""

from scsr_opt.priors.prior import Prior
from scsr_opt.solvers.data_proximal import DataProximal
from scsr_opt.solvers.proximal_gradient import FISTA
from scsr_opt.solvers.solver import Solver


def default_solver(prior: Prior, *, strength: float, scale: int, block_diagonal: bool, steepest: float = 5.0) -> Solver:
    """`LBFGS` for a smooth prior without a proximal step; `DataProximal` where the data are
    `DataTerm.block_diagonal` and that is the faster one; `FISTA` elsewhere.

    `DataProximal` takes the more iterations the more the prior asks for: it is taken where λ·(Lipschitz constant of
    ∇Ψ)/L is at most `steepest`; it was the faster one up to 5, and as fast as `FISTA` at 6.5. Weights are scaled so
    that M ≤ 1 (`Problem`), and then L is at most 1/s².
    """
    lipschitz = prior.lipschitz if prior.has_prox else None
    if block_diagonal and lipschitz is not None and strength * lipschitz * scale**2 <= steepest:
        return DataProximal()
    return general_solver(prior)


def general_solver(prior: Prior) -> Solver:
    """`FISTA`, or `LBFGS` for a smooth prior without a proximal step: for all data."""
    if prior.has_prox:
        return FISTA()
    from scsr_opt.solvers.quasi_newton import LBFGS  # optimistix takes 0.2 s to import

    return LBFGS()
