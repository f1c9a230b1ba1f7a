from .admm import ADMM, JaxoptADMM
from .data_proximal import DataProximal
from .default import default_solver
from .implicit import implicit_minimiser
from .jaxopt_gradient import JaxoptFISTA, JaxoptISTA
from .linear_solve import ConjugateGradients, JaxoptConjugateGradients, LinearSolve
from .loop import Outcome, run
from .primal_dual import ChambollePock, CondatVu
from .problem import Problem, lipschitz_bound, with_bound
from .proximal_gradient import FISTA, ISTA
from .quasi_newton import LBFGS, NonlinearCG
from .record import Stage, Status, TileIterations
from .solver import Record, Solver
from .step_size import Backtracking, Balance, Fixed, NormBound, Separable, SpectralNorm, StepSize
from .stopping import DualityGap, FixedPoint, Stopping
from .tiles import is_tileable, run_tiles

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
