"""The motion during exposures, in the data term: exact (`with_exact_exposure`), or as a quadratic with the narrow
stencil M that touches the exact term at one picture and lies on or above it elsewhere (`with_exposure`).

`scsr_opt.operators.sampling`, where M and c are summed, explains why the latter lowers the true objective.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from scsr_opt.operators.data_term import DataTerm, Stencil
from scsr_opt.operators.sampling import Piece, PlacedSamples, read_at


def with_exposure(
    term: DataTerm,
    placed: PlacedSamples,
    image: Float[Array, "H W"],
    *,
    robust: Float[Array, " n"] | None = None,
    since: tuple[DataTerm, Float[Array, "H W"], Bool[Array | np.ndarray, " pieces"]] | None = None,
) -> DataTerm:
    """`term`, as `accumulate` made it, with c and e corrected for the motion during the exposures: it touches the exact
    data term at `image` and lies on or above it everywhere.

    With U = B·image: c' = c + (M − M_e) U and e' = e + ⟨U, (M − M_e) U⟩. Of a sample with one position nothing is left
    of M − M_e, so that only the others are visited: with u_jk = r_jk·U and their mean u_j,
    (M − M_e) U = Σ_j ω_j Σ_k (u_jk − u_j) r_jk / K_j.

    `since`: the term corrected at another picture, that picture, and which pieces of the samples see where the two
    pictures differ (`PlacedSamples.rows`). M − M_e is linear, so that no others need be visited.
    """
    # What is compiled returns what changes: all that it returns it copies, M too.
    return eqx.tree_at(lambda term: (term.target, term.energy), term, _corrected(term, placed, image, robust, since))


class ExposedStencil(eqx.Module):
    """M_e = Σ_j ω_j r_j r_jᵀ, each r_j along its whole exposure: the operator that `Stencil` is a narrow bound of.

    M_e u = M u − (M − M_e) u costs a visit of all samples with several positions. It is symmetric, so that its
    derivative by u is itself; it can be differentiated by M, but not by the samples.

    **Fields:** `narrow`, M; `placed`, the samples.
    """

    narrow: Stencil
    placed: PlacedSamples

    @eqx.filter_jit
    def __call__(self, u: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """M_e u."""
        return self.narrow(u) - _excess_of_all(u, self.placed)


@eqx.filter_custom_vjp
def _excess_of_all(u: Float[Array, "H W"], placed: PlacedSamples) -> Float[Array, "H W"]:
    """(M − M_e) u."""
    return _excess(placed, jnp.where(placed.positions > 1, placed.weight, 0), u, None)


@_excess_of_all.def_fwd
def _(perturbed: Any, u: Float[Array, "H W"], placed: PlacedSamples) -> tuple[Float[Array, "H W"], None]:
    return _excess_of_all(u, placed), None


@_excess_of_all.def_bwd
def _(
    residuals: None, cotangent: Float[Array, "H W"], perturbed: Any, u: Float[Array, "H W"], placed: PlacedSamples
) -> Float[Array, "H W"]:
    return _excess_of_all(cotangent, placed)


def with_exact_exposure(term: DataTerm, placed: PlacedSamples) -> DataTerm:
    """`term`, as `accumulate` made it of these samples, with the motion during their exposures in its value and its
    gradient: f(X) = ½ Σ_j ω_j (r_j·B X − Y_j)². Where no exposure has more than one position, `term` is exact already.
    """
    if placed.finest == 1:
        return term
    assert isinstance(term.stencil, Stencil)
    return eqx.tree_at(lambda t: t.stencil, term, ExposedStencil(term.stencil, placed))


@eqx.filter_jit
def _corrected(
    term: DataTerm,
    placed: PlacedSamples,
    image: Float[Array, "H W"],
    robust: Float[Array, " n"] | None,
    since: tuple[DataTerm, Float[Array, "H W"], Bool[Array | np.ndarray, " pieces"]] | None,
) -> tuple[Float[Array, "rows columns"], Float[Array, ""]]:
    """c' and e' of `with_exposure`."""
    weight = placed.weight if robust is None else placed.weight * robust
    weight = jnp.where(placed.positions > 1, weight, 0)
    u = term.blurred(image)
    if since is None:
        excess = _excess(placed, weight, u, None)
    else:
        corrected, touched, seen = since
        # Of the difference of the pictures, blurring would take XLA four times as long.
        change = _excess(placed, weight, u - term.blurred(touched), jnp.asarray(seen))
        excess = corrected.target - term.target + change
    return term.target + excess, term.energy + jnp.sum(u * excess)


def _excess(
    placed: PlacedSamples, weight: Float[Array, " n"], u: Float[Array, "H W"], wanted: Bool[Array, " pieces"] | None
) -> Float[Array, "H W"]:
    """(M − M_e) u, of the pieces that are wanted."""

    def piece(total: Float[Array, " pixels"], at: Piece) -> Float[Array, " pixels"]:
        part = at.of(weight)
        each, most = 1 / at.divisor.astype(u.dtype), at.most(part)
        nothing = jnp.zeros_like(part)

        # What was read of a piece is still in the cache when it is spread: 0.6 of the time of reading all first.
        def read(number: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
            seen, mean = found
            here = read_at(u, at.taps(number))
            return seen.at[number].set(here), mean + jnp.where(number < at.positions, each * here, 0)

        seen, mean = jax.lax.fori_loop(np.int32(0), most, read, (jnp.stack([nothing] * placed.finest), nothing))

        def add(number: Array, total: Float[Array, " pixels"]) -> Float[Array, " pixels"]:
            off = jnp.where(number < at.positions, each * part * (seen[number] - mean), 0)
            return placed.add(total, at.taps(number), off)

        return jax.lax.fori_loop(np.int32(0), most, add, total)

    return placed.in_pieces(piece, jnp.zeros_like(u.reshape(-1)), wanted).reshape(u.shape)
