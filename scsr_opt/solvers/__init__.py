"""Methods for Eq. 4, halved: minimise f(X) + λ Ψ(X) over pictures X.

`run(FISTA(), problem, image)` is the loop that they share. `FISTA` is the one to use, and where nothing moves
`DataProximal` (`default_solver`); `ISTA` is Eq. 5 as it stands.
`ADMM`, `CondatVu` and `ChambollePock` split the prior off by a dual variable; `NonlinearCG` and `LBFGS` (optimistix)
are for smooth priors. `JaxoptISTA` and `JaxoptFISTA` do the same by an independent implementation, and `JaxoptADMM`
solves the linear systems of `ADMM` by one.
`implicit_minimiser` is the minimiser as a function that can be differentiated.
"""

from scsr_opt.solvers.admm import ADMM, JaxoptADMM
from scsr_opt.solvers.data_proximal import DataProximal
from scsr_opt.solvers.default import default_solver
from scsr_opt.solvers.implicit import implicit_minimiser
from scsr_opt.solvers.jaxopt_gradient import JaxoptFISTA, JaxoptISTA
from scsr_opt.solvers.linear_solve import ConjugateGradients, JaxoptConjugateGradients, LinearSolve
from scsr_opt.solvers.loop import Outcome, run
from scsr_opt.solvers.primal_dual import ChambollePock, CondatVu
from scsr_opt.solvers.problem import Problem, lipschitz_bound, with_bound
from scsr_opt.solvers.proximal_gradient import FISTA, ISTA
from scsr_opt.solvers.quasi_newton import LBFGS, NonlinearCG
from scsr_opt.solvers.record import Stage, Status, TileIterations
from scsr_opt.solvers.solver import Record, Solver
from scsr_opt.solvers.step_size import Backtracking, Balance, Fixed, NormBound, Separable, SpectralNorm, StepSize
from scsr_opt.solvers.stopping import DualityGap, FixedPoint, Stopping
from scsr_opt.solvers.tiles import is_tileable, run_tiles

__all__ = [
    "ADMM",
    "FISTA",
    "ISTA",
    "LBFGS",
    "TileIterations",
    "Backtracking",
    "Balance",
    "ChambollePock",
    "CondatVu",
    "ConjugateGradients",
    "DataProximal",
    "DualityGap",
    "Fixed",
    "FixedPoint",
    "JaxoptADMM",
    "JaxoptConjugateGradients",
    "JaxoptFISTA",
    "JaxoptISTA",
    "LinearSolve",
    "NonlinearCG",
    "NormBound",
    "Outcome",
    "Problem",
    "Record",
    "Status",
    "Separable",
    "Solver",
    "SpectralNorm",
    "Stage",
    "StepSize",
    "Stopping",
    "default_solver",
    "is_tileable",
    "lipschitz_bound",
    "run_tiles",
    "with_bound",
    "run",
    "implicit_minimiser",
]
