"""The rows of this project: every solver of `scsr_opt.solvers` that takes total variation, by its defaults.

The blur B of the problems is `Aperture` with a side of 3 on the picture with two rows of zeros around it:
the aperture at (i, j) of that larger grid has its centre at (i − 1, j − 1) of the picture.
"""

import inspect
import sys
from collections.abc import Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.peers.problems import Case
from benchmarks.peers.rows import Method, report
from scsr_opt import solvers
from scsr_opt.errors import InputError
from scsr_opt.operators import DataTerm, PlacedSamples, Taps, accumulate
from scsr_opt.priors import TotalVariation
from scsr_opt.solvers.problem import with_bound

DEFAULT = "FISTA"
"""The row of the solver that `reconstruct` takes where none is given."""

INCLUDING = f"{DEFAULT}, accumulation included"
"""The row of the same, from the samples instead of M and c."""

_AROUND = 2


class Surrounded(DataTerm):
    """A `DataTerm` of the picture with zeros around it."""

    @property
    def shape(self) -> tuple[int, int]:
        height, width = self.aperture.shape
        return height - 2 * _AROUND, width - 2 * _AROUND

    def blurred(self, image: Float[Array, "H W"]) -> Float[Array, "H4 W4"]:
        return self.aperture(jnp.pad(image, _AROUND))

    def blurred_adjoint(self, u: Float[Array, "H4 W4"]) -> Float[Array, "H W"]:
        return self.aperture.adjoint(u)[_AROUND:-_AROUND, _AROUND:-_AROUND]


def placed(case: Case) -> PlacedSamples:
    """The samples of a problem, each at its place on the larger grid."""
    height, width = (size + 2 * _AROUND for size in case.shape)
    row, column = case.row + 1, case.column + 1
    # Only the first of two taps has to leave room for the second.
    top, left = np.minimum(row.astype(int), height - 2), np.minimum(column.astype(int), width - 2)
    taps = Taps(
        index=jnp.asarray(top * width + left, jnp.int32)[None],
        down=jnp.asarray(row - top, jnp.float32)[None],
        right=jnp.asarray(column - left, jnp.float32)[None],
    )
    return PlacedSamples(
        taps,
        jnp.ones(case.value.shape, jnp.int32),
        value=jnp.asarray(case.value, jnp.float32),
        weight=jnp.ones(case.value.shape, jnp.float32),
        scale=3,
        shape=(height, width),
    )


def problem(case: Case, samples: PlacedSamples) -> solvers.Problem:
    """The problem as this project states it, M and c accumulated from the samples."""
    term = accumulate(samples)
    data = Surrounded(term.stencil, term.target, term.energy, term.aperture, term.optics)
    return solvers.Problem(data, TotalVariation(), jnp.asarray(case.strength, jnp.float32))


def methods(case: Case) -> Iterator[Method]:
    """Each solver from M and c, and the default one from the samples, too."""
    samples = placed(case)
    ready = problem(case, samples)
    # With the bound of L, as `reconstruct` finds it once for each M; the other libraries are handed L.
    ready = eqx.tree_at(lambda p: p.data, ready, with_bound(ready.data))
    start = jnp.asarray(case.start, jnp.float32)

    def solve(solver: solvers.Solver) -> Float[np.ndarray, "H W"]:
        return solvers.run(solver, ready, start).image

    def accumulate_and_solve(iterations: int) -> Float[np.ndarray, "H W"]:
        return solvers.run(solvers.FISTA(iterations=iterations, tolerance=0), problem(case, samples), start).image

    for name in solvers.__all__:
        kind = getattr(solvers, name)
        if not (inspect.isclass(kind) and issubclass(kind, solvers.Solver)) or inspect.isabstract(kind):
            continue
        solver: Any = kind
        try:
            solve(solver(iterations=1, tolerance=0))
        except InputError as refusal:
            # Solvers for smooth priors say so.
            print(f"{name} is left out: {refusal}", file=sys.stderr)
            continue
        # A tolerance of 0 never ends a run, so that the count of iterations alone does.
        yield Method(name, lambda n, solver=solver: partial(solve, solver(iterations=n, tolerance=0)))
    yield Method(INCLUDING, lambda n: partial(accumulate_and_solve, n))


if __name__ == "__main__":
    report(methods)
