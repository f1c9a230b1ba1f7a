"""The problem that all solvers solve: Eq. 4, divided by two."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt.operators.checks import norm_bound
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.downsample import Downsample
from scsr_opt.priors.prior import Prior


class Problem(eqx.Module):
    """minimise over X of F(X) = f(X) + λ Ψ(X), f(X) = ½ Σ_i ω_i (D_s H_i T_{k→i} X − Y_i)² (paper, Eq. 4, halved).

    Halved, so that the proximal step of Eq. 5 is the usual argmin ½‖X − R‖² + βλΨ(X). The weights are scaled so that a
    sensor pixel that is observed all the time has Σω = 1; λ then hardly depends on how many frames went in.

    **Fields:** `data` f, `prior` Ψ, `strength` λ; `start`: X^(0), where `run` begins if it is given no other picture.
    """

    data: DataTerm
    prior: Prior
    strength: Float[Array, ""]
    start: Float[Array, "H W"] | None = None

    def change_of_gradient(self, before: "Problem") -> Float[Array, "H W"]:
        """∇f less that of `before`, where only c and e differ, (H, W); it is the same at every picture."""
        return self.data.blurred_adjoint(before.data.target - self.data.target)


def lipschitz_bound(data: DataTerm) -> Float[Array, ""]:
    """A certain upper bound on ‖BᵀMB‖, the Lipschitz constant of f's gradient; 1 / it is a step size that always works.

    B and M have no negative entries, so four steps of Collatz's bound do (`scsr_opt.operators.norm_bound`). What is
    known already (`with_bound`) is returned.
    """
    if data.bound is not None:
        return data.bound
    if isinstance(data.aperture, Downsample) and data.optics is None:
        # D D* is the identity over s², and the largest sum of a row of M bounds ‖M‖.
        bound = jnp.max(data.stencil(jnp.ones_like(data.target))) / data.aperture.scale**2
    else:
        bound = norm_bound(data.normal, data.shape, iterations=4, symmetric=True, dtype=data.target.dtype)
    # Where no sample counts, f is constant, and every number is a bound. Of a tiny one the step would be 1e38 long.
    return jnp.where(bound < jnp.finfo(data.target.dtype).tiny, 1, bound)


@eqx.filter_jit
def with_bound(data: DataTerm) -> DataTerm:
    """`data` with its `bound` on L. The bound holds for any target c, but not for another M."""
    return eqx.tree_at(lambda term: term.bound, data, lipschitz_bound(data), is_leaf=lambda leaf: leaf is None)
