"""Methods for Eq. 4, halved: minimise f(X) + λ Ψ(X) over pictures X.

`run(FISTA(), problem, image)` is the loop that they share. `FISTA` is the one to use; `ISTA` is Eq. 5 as it stands;
`JaxoptISTA` and `JaxoptFISTA` do the same by an independent implementation.
"""

from scsr_opt.solvers.iterate import Outcome, Record, Solver, run
from scsr_opt.solvers.jaxopt_gradient import JaxoptFISTA, JaxoptISTA
from scsr_opt.solvers.problem import Problem, lipschitz_bound
from scsr_opt.solvers.proximal_gradient import FISTA, ISTA
from scsr_opt.solvers.solution import Result, Solution, Stage

__all__ = [
    "FISTA",
    "ISTA",
    "JaxoptFISTA",
    "JaxoptISTA",
    "Outcome",
    "Problem",
    "Record",
    "Result",
    "Solution",
    "Solver",
    "Stage",
    "lipschitz_bound",
    "run",
]
