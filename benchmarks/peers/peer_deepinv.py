"""deepinv on the CPU build of torch: FISTA and proximal gradient descent with its total variation.

For shifted frames one strided convolution, as its own `Downsampling` has to be stacked, one a frame, and is slower;
where every pixel moves on its own it has nothing, and a sparse matrix and its transpose serve.
"""

import warnings
from collections.abc import Callable, Iterator

import numpy as np
import torch

warnings.simplefilter("ignore")
# The registry's torchvision may be built for another torch, whose operators then do not load; deepinv imports it, and
# it only wants to know that these two exist.
_library = torch.library.Library("torchvision", "DEF")
_library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
_library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

import deepinv  # noqa: E402

from benchmarks.peers.problems import SCALE, Case  # noqa: E402
from benchmarks.peers.rows import Method, report  # noqa: E402


class Convolved(deepinv.physics.LinearPhysics):
    """Frames that are shifted as a whole."""

    def __init__(self, case: Case):
        super().__init__()
        self.kernels, self.size = (
            torch.tensor(case.kernels[:, None, ::-1, ::-1].copy(), dtype=torch.float32),
            case.shape,
        )

    def A(self, x, **_):
        return torch.nn.functional.conv2d(torch.nn.functional.pad(x, (2, 1, 2, 1)), self.kernels, stride=SCALE)

    def A_adjoint(self, y, **_):
        height, width = self.size
        wide = torch.nn.functional.conv_transpose2d(y, self.kernels, stride=SCALE)
        return wide[..., 2 : 2 + height, 2 : 2 + width]


class Sparse(deepinv.physics.LinearPhysics):
    """R B as a matrix."""

    def __init__(self, case: Case):
        super().__init__()
        self.matrix, self.transposed = (_csr(m) for m in (case.matrix, case.matrix.T.tocsr()))
        self.size = case.shape

    def A(self, x, **_):
        return (self.matrix @ x.reshape(-1))[None]

    def A_adjoint(self, y, **_):
        return (self.transposed @ y.reshape(-1)).reshape(1, 1, *self.size)


def _csr(matrix) -> torch.Tensor:
    parts = (torch.tensor(part) for part in (matrix.indptr, matrix.indices, matrix.data.astype(np.float32)))
    return torch.sparse_csr_tensor(*parts, size=matrix.shape)


def methods(case: Case) -> Iterator[Method]:
    torch.set_grad_enabled(False)
    truth, start = (torch.tensor(x[None, None], dtype=torch.float32) for x in (case.truth, case.start))
    value = torch.tensor(case.value, dtype=torch.float32)
    shifted = len(case.kernels) > 0
    physics = Convolved(case) if shifted else Sparse(case)
    y = value.reshape(1, len(case.kernels), *(n // SCALE for n in case.shape)) if shifted else value[None]
    np.testing.assert_allclose(physics.A(truth).ravel(), case.matrix @ case.truth.ravel(), atol=3e-5)
    np.testing.assert_allclose(physics.A_adjoint(y).ravel(), case.matrix.T @ case.value, atol=1e-3)
    fidelity, strength = deepinv.optim.data_fidelity.L2(), float(case.strength)

    def method(name: str, algorithm: Callable, step: float, prior: Callable, most: int) -> Method:
        def prepare(n: int):
            model = algorithm(
                data_fidelity=fidelity, prior=prior(), lambda_reg=strength, stepsize=step, max_iter=n,
                early_stop=False, verbose=False,
            )  # fmt: skip
            return lambda: model(y, physics, init=(start.clone(), start.clone()))[0, 0].numpy()

        return Method(name, prepare, most)

    def tv(inner: int) -> Callable:
        def make():
            # As it comes it does up to 1,000 dual steps of 0.01.
            prior = deepinv.optim.prior.TVPrior(def_crit=1e-8, n_it_max=inner)
            prior.TVModel.tau = 0.25
            return prior

        return make

    FISTA, PGD, L = deepinv.optim.FISTA, deepinv.optim.PGD, case.lipschitz
    for inner in (10, 20):
        yield method(f"FISTA, TVPrior({inner})", FISTA, 1 / L, tv(inner), 64)
        yield method(f"PGD, TVPrior({inner}), step 1.9/L", PGD, 1.9 / L, tv(inner), 64)


if __name__ == "__main__":
    report(methods)
