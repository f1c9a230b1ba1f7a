"""pyproximal on pylops operators: proximal gradient, primal–dual and ADMM.

The operator is a `MatrixMult` of the sparse matrix R B, rather than a stack of `Convolve2D` and `Restriction`, one for
each shifted frame.
"""

from collections.abc import Callable, Iterator

import numpy as np
import pylops
import pyproximal
import scipy.sparse as sp
from pyproximal.optimization.primal import ADMML2, ProximalGradient
from pyproximal.optimization.primaldual import PrimalDual

from benchmarks.peers.problems import Case
from benchmarks.peers.rows import Method, report


def methods(case: Case) -> Iterator[Method]:
    y, start, strength = case.value.astype("f"), case.start.astype("f").ravel(), float(case.strength)
    A = pylops.MatrixMult(sp.csr_matrix(case.matrix.astype("f")), dtype="float32")
    # An explicit matrix would be made dense and factorised in every proximal step.
    A.explicit = False
    np.testing.assert_allclose(A @ case.truth.astype("f").ravel(), case.matrix @ case.truth.ravel(), atol=3e-5)
    G = pylops.Gradient(case.shape, kind="forward", edge=False, dtype="float32")
    l21 = pyproximal.L21(ndim=2, sigma=strength)

    def method(name: str, run: Callable[[int], np.ndarray], most: int) -> Method:
        return Method(name, lambda n: lambda: run(n), most)

    step = 1 / (1.001 * case.lipschitz)
    for inner in (10, 20):
        tv = pyproximal.TV(case.shape, sigma=strength, niter=inner, rtol=1e-6)
        yield method(
            f"ProximalGradient FISTA, TV({inner})",
            lambda n, tv=tv: ProximalGradient(
                pyproximal.L2(Op=A, b=y), tv, x0=start.copy(), tau=step, acceleration="fista", niter=n
            ),
            100,
        )

    # The stack [A; ∇] of norm² ≤ L + 8, so that no system is solved.
    stack, size = pylops.VStack([A, G]), (case.lipschitz + 8) ** 0.5
    both = pyproximal.VStack([pyproximal.L2(b=y), l21], nn=[y.size, 2 * start.size])
    for ratio in (0.3, 1, 3):
        yield method(
            f"PrimalDual of the stack, √(τ/μ) = {ratio}",
            lambda n, r=ratio: PrimalDual(
                pyproximal.L2(sigma=0.0), both, stack, x0=start.copy(), tau=0.99 / size * r, mu=0.99 / size / r, niter=n
            ),
            400,
        )
    # ADMML2 asks for τ = 1/ρ.
    for factor in (1, 5, 20):
        yield method(
            f"ADMML2, LSQR(10), ρ = {factor} λ",
            lambda n, f=factor: ADMML2(l21, A, y, G, x0=start.copy(), tau=1 / (f * strength), niter=n, iter_lim=10)[0],
            100,
        )


if __name__ == "__main__":
    report(methods)
