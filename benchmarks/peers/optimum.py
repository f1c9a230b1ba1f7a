"""The minimum F* of a `Case`, in float64, and a proof of it.

Newton's method on the primal–dual equations of total variation (Chan, Golub, Mulet, 1999) finds the minimiser X for
|∇X| smoothed to √(|∇X|² + ε²), with ε going down to 10⁻⁸. Whatever X and whatever vectors p, |p| ≤ 1, with
s = BᵀRᵀ(R B X − Y) + λ∇*p,

    F(X') ≥ F(X) − λ Σ (|∇X| − ⟨∇X, p⟩) − ‖s‖₁   for every picture X' whose pixels lie within 1 of those of X,

because |∇X'| ≥ ⟨∇X', p⟩ and the rest is convex. With p = ∇X / √(|∇X|² + ε²) this is a bound from below that owes
nothing to how X was found. F* lies between it and F(X), which is worth more than the word of a second solver.
"""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float
from scipy.sparse.linalg import splu

from benchmarks.peers.problems import Case

AGREEMENT = 5e-7
"""How far F(X) and the bound may lie apart, relative to F(X). Rounding leaves a part in 10⁷ at best: a smaller ε
tightens the first term of the bound and loosens the second."""

_STEPS, _SMOOTHEST, _SHARPEST, _RANGE = 100, 1e-2, 1e-8, 1


def minimum(case: Case) -> dict[str, float]:
    """`minimum`: F(X); `bound`: no picture has less than this; `steps`: Newton steps that it took.

    **Errors:** `RuntimeError` if the two do not come within `AGREEMENT`.
    """
    normal, target = case.matrix.T @ case.matrix, case.matrix.T @ case.value
    down, right = difference(case.shape)
    λ = float(case.strength)
    x, w, ε = case.start.ravel(), np.zeros((2, case.truth.size)), _SMOOTHEST
    objective = bound = np.nan
    for step in range(_STEPS):
        field = np.stack([down @ x, right @ x])
        inverse_length = 1 / np.sqrt(np.sum(field**2, axis=0) + ε**2)
        unit = field * inverse_length
        slope = normal @ x - target + λ * (down.T @ unit[0] + right.T @ unit[1])

        objective = case.objective(x)
        slack = float(np.sum(np.hypot(*field) - np.sum(field * unit, axis=0)))
        bound = objective - λ * slack - _RANGE * float(np.sum(np.abs(slope)))
        if objective - bound <= AGREEMENT * objective:
            return {"minimum": objective, "bound": bound, "steps": step}

        diagonal = inverse_length * (1 - w * unit)
        curvature = down.T @ sp.diags_array(diagonal[0]) @ down + right.T @ sp.diags_array(diagonal[1]) @ right
        cross = down.T @ sp.diags_array(-0.5 * inverse_length * (w[0] * unit[1] + w[1] * unit[0])) @ right
        # Symmetric and positive definite, and ordered as such.
        newton = splu(
            sp.csc_array(normal + λ * (curvature + cross + cross.T)),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        δx = newton.solve(-slope)
        δfield = np.stack([down @ δx, right @ δx])
        δw = inverse_length * (δfield - w * np.sum(unit * δfield, axis=0)) + unit - w
        share = _share(w, δw)
        x, w = x + δx, w + share * δw
        # Sharper only once w has followed: too early, and Newton's steps no longer converge.
        if share > 0.5:
            ε = max(ε / 5, _SHARPEST)
    raise RuntimeError(f"after {_STEPS} Newton steps the minimum lies between {bound!r} and {objective!r} only")


def difference(shape: tuple[int, int]) -> tuple[sp.csr_array, sp.csr_array]:
    """∇ as two matrices, (H·W, H·W): the differences down and to the right."""
    down, right = (sp.diags_array(np.append(-np.ones(n - 1), 0.0)) + sp.eye_array(n, k=1) for n in shape)
    height, width = shape
    return sp.csr_array(sp.kron(down, sp.eye_array(width))), sp.csr_array(sp.kron(sp.eye_array(height), right))


def _share(w: Float[np.ndarray, "2 n"], δw: Float[np.ndarray, "2 n"]) -> float:
    """The share of δw, at most 1, that may be added so that |w| stays below 1."""
    square, product = np.sum(δw**2, axis=0), np.sum(w * δw, axis=0)
    room = np.maximum(1 - np.sum(w**2, axis=0), 0)
    # The positive root of |w + s δw| = 1, written so that a small δw loses no digits.
    reach = room / np.maximum(product + np.sqrt(product**2 + square * room), np.finfo(float).tiny)
    return float(min(1.0, 0.99 * reach.min()))
