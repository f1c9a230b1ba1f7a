"""Methods for Eq. 4, halved: minimise f(X) + λ Ψ(X) over pictures X.

`run(FISTA(), problem, image)` is the loop that they share. `FISTA` is the one to use, and where nothing moves
`DataProximal` (`default_solver`); `ISTA` is Eq. 5 as it stands.
`ADMM`, `CondatVu` and `ChambollePock` split the prior off by a dual variable; `NonlinearCG` and `LBFGS` (optimistix)
are for smooth priors. `JaxoptISTA` and `JaxoptFISTA` do the same by an independent implementation, and `JaxoptADMM`
solves the linear systems of `ADMM` by one.
`implicit_minimiser` is the minimiser as a function that can be differentiated.

Names are imported when they are first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
