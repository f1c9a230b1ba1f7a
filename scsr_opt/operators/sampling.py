"""The data term of Eq. 4 in sampled form: an iteration costs the same for 40 frames and for 4,000.

Where motion is locally a translation, warping and blurring commute: what pixel p sees at time t is the blurred picture
U = B X (aperture after optics), read at one position, s·q, q the key-frame position of what it sees. A sample j is a
row r_j of four bilinear weights on U, or the mean of K such rows along its exposure, and

    f(X) = ½ Σ_j ω_j (r_j·B X − Y_j)² = ½⟨U, M U⟩ − ⟨c, U⟩ + ½ e,
    M = Σ ω_j r_j r_jᵀ,   c = Σ ω_j Y_j r_j,   e = Σ ω_j Y_j².

M and c are accumulated once. M is a symmetric stencil of 3×3 weights that varies over the picture; five planes hold it.

**Exposures.** Rows at several positions of an exposure would couple points as far apart as the motion during it. M is
therefore accumulated from Σ_k r_jk r_jkᵀ / K, which is never below the true M_e = Σ ω_j r_j r_jᵀ with r_j = Σ_k r_jk /
K (convexity), while c is exact. `with_exposure` (`scsr_opt.operators.exposure`) then corrects c so that the gradient
at a given picture is the exact one: each solve minimises a quadratic that lies on or above the true objective and
touches it there (majorise–minimise), so that alternating the two lowers the true objective every time and ends at its
minimiser.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from scsr_opt._kernels.device import on_device
from scsr_opt.camera.samples import Samples
from scsr_opt.errors import InputError
from scsr_opt.motion.inversion import in_turn
from scsr_opt.motion.trajectory import Between, Trajectory
from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.data_term import DataTerm, Stencil
from scsr_opt.operators.downsample import Downsample
from scsr_opt.operators.operator import LinearOperator

# Samples that are visited at a time, if their number allows, and the fewest.
_PIECE_SAMPLES = 8192
_LEAST_PIECE_SAMPLES = 256
# From this number of samples on, pieces are twice as large: two threads share each step.
_LARGE_PIECES_FROM = 2**20

# Where the positions of an exposure lie, in exposures from its middle: two and three at the nodes of equal weight that
# integrate polynomials of the highest degree (Chebyshev, 1874, "Sur les quadratures"), five, which exposures of any
# length get, evenly spread. Of the light of natural pictures behind the aperture one misses 0.0007 of an exposure in
# which they move by 0.1 sensor pixels, two 0.0013 at 0.5, three 0.0011 at 0.7 (docs/data-term.md, "Exposures").
_NODES = {
    1: (0.0,),
    2: (-0.5 / 3**0.5, 0.5 / 3**0.5),
    3: (0.0, -(0.5**1.5), 0.5**1.5),
    5: (0.0, -0.2, 0.2, -0.4, 0.4),
}
# The same as a table, by number of positions and of the position.
_TABLE = np.zeros((max(_NODES) + 1, max(_NODES)))
for _k, _nodes in _NODES.items():
    _TABLE[_k, :_k] = _nodes


class Taps(eqx.Module):
    """Positions on the grid of U, of any number.

    **Fields:**
    - `index`: of the upper left of four taps in the flattened picture.
    - `down`, `right`: how far the position lies beyond that tap, in pixels.
    """

    index: Int[Array, "*n"]
    down: Float[Array, "*n"]
    right: Float[Array, "*n"]

    @property
    def weights(self) -> tuple[Array, Array, Array, Array]:
        """Weights of the upper left, upper right, lower left and lower right tap."""
        down, right = self.down, self.right
        return (1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right


class PlacedSamples(eqx.Module):
    """Samples with the positions on the grid of U that each was taken at, ready to be read and accumulated.

    Each sample has 1, 2, 3 or 5 positions, as its exposure needs, K at most. Samples are visited in pieces, and
    pieces none of which has a k-th position, or a weight, are passed over: the work follows the positions that there
    are, while programs depend on n and K only.

    **Fields:**
    - `taps`: (K, n), the positions, from the middle of the exposure outwards (`moments`).
    - `positions` (n,): how many of these a sample has; 0 for the padding of `Samples.padded`.
    - `value`, `weight` (n,): Y_j and ω_j; the weight is 0 where a sample leaves the picture or sees what the key frame
      does not show.
    - `scale` s, `shape` of U: (H, W), or (h, w) if `on_sensor`: where nothing moves, all samples lie on the sensor's
      grid, and nothing else of U is ever read.
    """

    taps: Taps
    positions: Int[Array, " n"]
    value: Float[Array, " n"]
    weight: Float[Array, " n"]
    scale: int = eqx.field(static=True)
    shape: tuple[int, int] = eqx.field(static=True)
    on_sensor: bool = eqx.field(static=True, default=False)

    @property
    def finest(self) -> int:
        """K, the largest number of positions along an exposure that there may be."""
        return self.taps.index.shape[0]

    def only(self, numbers: Int[np.ndarray, " m"]) -> "PlacedSamples":
        """The samples of these numbers."""
        # By NumPy: once for a picture, and of another length for each.
        taps = jax.tree.map(lambda field: on_device(np.asarray(field)[:, numbers]), self.taps)
        samples = (self.positions, self.value, self.weight)
        positions, value, weight = (on_device(np.asarray(field)[numbers]) for field in samples)
        return PlacedSamples(taps, positions, value, weight, self.scale, self.shape, self.on_sensor)

    @eqx.filter_jit
    def seen(self) -> Float[Array, "h w"]:
        """The weight of the samples that see each sensor pixel of the key frame in the middle of their exposure."""
        grid = 1 if self.on_sensor else self.scale
        height, width = (side // grid for side in self.shape)
        row, column = jnp.divmod(self.taps.index[0], self.shape[1])
        # An aperture begins at its place and reaches over `grid` of the grid's pixels: its centre counts.
        row, column = (row + grid // 2) // grid, (column + grid // 2) // grid
        nothing = jnp.zeros(height * width, self.weight.dtype)
        return nothing.at[row * width + column].add(self.weight).reshape(height, width)

    @eqx.filter_jit
    def read(self, u: Float[Array, "H W"]) -> Float[Array, " n"]:
        """r_j · u for every sample."""

        # All at once: on two cores, five positions of all samples took a third of the time of those that there are.
        def layer(total: Float[Array, " n"], at: tuple[Array, Taps]):
            number, taps = at
            return total + self.share(number, read_at(u, taps)), None

        return jax.lax.scan(layer, jnp.zeros_like(u, shape=self.value.shape), (self.numbers, self.taps))[0]

    @eqx.filter_jit
    def spread(self, values: Float[Array, " n"]) -> Float[Array, "H W"]:
        """Σ_j values_j r_j, the adjoint of `read`. It can be differentiated by the values, and by nothing else."""
        return _spread(values, self.with_fixed_values)

    @property
    def with_fixed_values(self) -> "PlacedSamples":
        """These samples, with values that nothing is differentiated by."""
        return eqx.tree_at(lambda placed: placed.value, self, jax.lax.stop_gradient(self.value))

    def add(self, total: Float[Array, " pixels"], taps: Taps, amount: Float[Array, " m"]) -> Float[Array, " pixels"]:
        """The amounts added at the taps to a flattened picture."""
        for offset, tap in zip((0, 1, self.shape[1], self.shape[1] + 1), taps.weights, strict=True):
            total = total.at[taps.index + offset].add(amount * tap)
        return total

    def visited(
        self, visit: Callable[..., Any], carry: Any, amount: Float[Array, " n"], *more: Float[Array, " n"]
    ) -> Any:
        """`carry` after `visit(carry, taps, amount_j / K_j, *more)` of all positions, piece by piece, but for pieces
        that have no amount; K_j is the number of a sample's positions. In a call all but the carry is (m,), of one
        piece."""

        def piece(carry: Any, at: Piece):
            own, rest = at.of(amount), tuple(map(at.of, more))
            each, most = own / at.divisor.astype(own.dtype), at.most(own)

            def position(number: Array, carry: Any):
                return visit(carry, at.taps(number), jnp.where(number < at.positions, each, 0), *rest)

            return jax.lax.fori_loop(np.int32(0), most, position, carry)

        return self.in_pieces(piece, carry)

    def in_pieces(
        self, visit: Callable[[Any, "Piece"], Any], carry: Any, wanted: Bool[Array, " pieces"] | None = None
    ) -> Any:
        """`carry` after `visit` of all pieces, or of those that are wanted."""
        begins, size = _pieces(self.weight.size)
        if wanted is not None:
            begins = begins[jnp.argsort(~wanted)]

        # Loops that end early, and no conditionals: those copy what they take in, which cost half as much again.
        def piece(number: Array, carry: Any) -> Any:
            return visit(carry, Piece(self, begins[number], size))

        return jax.lax.fori_loop(
            np.int32(0), np.int32(begins.size) if wanted is None else jnp.sum(wanted, dtype=jnp.int32), piece, carry
        )

    @eqx.filter_jit
    def rows(self) -> Int[Array, "2 pieces"]:
        """The first row of U that each piece of the samples is read from, and the last but one; the first is after the
        last where a piece reads nothing."""
        begins, size = _pieces(self.weight.size)
        height, width = self.shape

        def piece(begin: Array) -> Array:
            at = Piece(self, begin, size)
            weight = at.of(self.weight)

            def reach(number: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
                index, live = at.taps(number).index, (weight > 0) & (number < at.positions)
                least, most = (
                    of(index, where=live, initial=end) for of, end in zip((jnp.min, jnp.max), found, strict=True)
                )
                return least, most

            ends = jnp.asarray(height * width, jnp.int32), jnp.asarray(-1, jnp.int32)
            return jnp.stack(jax.lax.fori_loop(np.int32(0), at.most(weight), reach, ends))

        return jax.lax.map(piece, begins).T // width

    def share(self, number: Int[Array, ""] | int, amount: Float[Array, " n"]) -> Float[Array, " n"]:
        """The share of each sample's amount that belongs to the position of this number, (n,)."""
        return jnp.where(number < self.positions, amount / jnp.maximum(self.positions, 1).astype(amount.dtype), 0)

    @property
    def numbers(self) -> Int[Array, " positions"]:
        """Numbers of the positions: 0, …, K − 1."""
        return jnp.arange(self.finest, dtype=jnp.int32)


# The loops that visit samples end early, which JAX does not differentiate backwards.
@eqx.filter_custom_vjp
def _spread(values: Float[Array, " n"], placed: PlacedSamples) -> Float[Array, "H W"]:
    nothing = jnp.zeros(placed.shape[0] * placed.shape[1], values.dtype)
    return placed.visited(placed.add, nothing, values).reshape(placed.shape)


@_spread.def_fwd
def _(perturbed: Any, values: Float[Array, " n"], placed: PlacedSamples) -> tuple[Float[Array, "H W"], None]:
    return _spread(values, placed), None


@_spread.def_bwd
def _(
    kept: None, change: Float[Array, "H W"], perturbed: Any, values: Float[Array, " n"], placed: PlacedSamples
) -> Float[Array, " n"]:
    return placed.read(change)


class Piece:
    """Neighbouring samples, `size` of them from number `begin` on; `positions` as of the samples, and 1 instead of 0 as
    a `divisor`."""

    def __init__(self, placed: PlacedSamples, begin: Int[Array, ""], size: int):
        self._placed, self._begin, self._size = placed, begin, size
        self.positions = self.of(placed.positions)
        self.divisor = jnp.maximum(self.positions, 1)

    def of(self, field: Shaped[Array, " n"]) -> Shaped[Array, " m"]:
        """The piece of a field of all samples."""
        return jax.lax.dynamic_slice_in_dim(field, self._begin, self._size)

    def taps(self, number: Int[Array, ""]) -> Taps:
        """Taps of the positions of this number."""
        size = (1, self._size)
        return jax.tree.map(
            lambda field: jax.lax.dynamic_slice(field, (number, self._begin), size)[0], self._placed.taps
        )

    def most(self, amount: Float[Array, " m"]) -> Int[Array, ""]:
        """The largest number of positions of these samples; 0 where none of them has an amount."""
        return jnp.where(jnp.any(amount != 0), jnp.max(self.positions), 0)


def read_at(u: Float[Array, "H W"], taps: Taps) -> Float[Array, "*n"]:
    """u at the taps, bilinearly."""
    flat, width = u.reshape(-1), u.shape[1]
    corners = [flat[taps.index + offset] for offset in (0, 1, width, width + 1)]
    upper = corners[0] + taps.right * (corners[1] - corners[0])
    lower = corners[2] + taps.right * (corners[3] - corners[2])
    return upper + taps.down * (lower - upper)


def moments(
    start: Float[Array, " n"], stop: Float[Array, " n"], positions: Int[Array, " n"], number: Int[Array, ""] | int
) -> Float[Array, " n"]:
    """Time, frames, of the position of this `number` on each exposure that has `positions` of them."""
    nodes = jnp.asarray(_TABLE, start.dtype).T[number]
    return (start + stop) / 2 + (stop - start) * nodes[positions]


def _pieces(samples: int) -> tuple[Int[Array, " pieces"], int]:
    """Indices that pieces of n samples begin at, and their size: the largest power of two up to `_PIECE_SAMPLES` (or
    twice that) that divides n; all in one piece if that is small."""
    most = math.gcd(samples, _PIECE_SAMPLES if samples < _LARGE_PIECES_FROM else 2 * _PIECE_SAMPLES)
    size = most if most >= _LEAST_PIECE_SAMPLES else max(samples, 1)
    return jnp.arange(0, samples, size, dtype=jnp.int32), size


@eqx.filter_jit
def place(
    samples: Samples,
    path: Trajectory,
    *,
    scale: int,
    shape: tuple[int, int],
    positions: Int[Array, " n"] | None = None,
    finest: int = 1,
    on_sensor: bool = False,
) -> PlacedSamples:
    """The places on the grid of U at which each sample was taken.

    **Arguments:**
    - `samples`: as device arrays, padded.
    - `path`: where in the key frame lies what a pixel sees.
    - `scale` s, `shape` (H, W) of the high-resolution picture.
    - `positions` (n,): how many on each exposure: 1, its middle, 2, 3 or 5. `finest` if not given.
    - `finest`: the largest of these.
    - `on_sensor`: whether the grid of U is the sensor's, for a path along which nothing moves.

    A sample that leaves the picture at any time of its exposure is dropped; what is left of it inside is for the
    caller to cut out (`scsr_opt.pipeline.measurement.measure`). Counting such samples for the part of them inside, as
    they are, costs 1 dB where a lens blurs across the border.

    **Raises:** `InputError` if `finest` is another number.
    """
    if finest not in _NODES:
        raise InputError(f"finest is {finest}, but an exposure has 1, 2, 3 or 5 positions.")
    grid, shape = (1, (shape[0] // scale, shape[1] // scale)) if on_sensor else (scale, shape)
    height, width = shape
    start, stop, value, full = (jnp.asarray(v) for v in (samples.start, samples.stop, samples.value, samples.weight))
    rows, columns = jnp.asarray(samples.row), jnp.asarray(samples.column)
    wanted = jnp.full(rows.shape, finest, jnp.int32) if positions is None else positions.astype(jnp.int32)
    wanted = jnp.where(full > 0, wanted, 0)

    tables, (begins, size) = path.tables, _pieces(full.size)

    def piece(carry: Any, begin: Array) -> Any:
        def of_piece(field: Shaped[Array, " n"]) -> Shaped[Array, " m"]:
            return jax.lax.dynamic_slice_in_dim(field, begin, size)

        row, column, positions = of_piece(rows), of_piece(columns), of_piece(wanted)
        since, until, whole = of_piece(start), of_piece(stop), of_piece(full)

        def between(number: Array) -> Between:
            return path.between(row, column, moments(since, until, positions, number))

        def look(_: Array, at: Between) -> tuple[Array, ...]:
            return tuple(map(at.read, tables))

        def add(number: Array, found: tuple[Array, ...], carry: Any) -> Any:
            weight, taps = carry
            down, right, seen = found
            down, right = down * grid, right * grid
            # A tolerance of a thousandth of a pixel, so that rounding does not drop the border row of a scene at rest.
            inside = (down >= -1e-3) & (right >= -1e-3)
            inside &= (down <= height - grid + 1e-3) & (right <= width - grid + 1e-3)
            # What lies outside is read somewhere inside, with weight 0; so is a position that is not a number.
            down = jnp.clip(jnp.where(inside, down, 0), 0, height - grid)
            right = jnp.clip(jnp.where(inside, right, 0), 0, width - grid)
            top, left = down.astype(jnp.int32), right.astype(jnp.int32)
            there = Taps(top * width + left, down - top.astype(down.dtype), right - left.astype(right.dtype))
            # A sample counts as far as it can be used at each of its positions.
            usable = jnp.minimum(weight, whole * jnp.where(inside, seen, 0))
            taps = jax.tree.map(
                lambda field, new: jax.lax.dynamic_update_slice(field, new[None], (number, begin)), taps, there
            )
            return jnp.where(number < positions, usable, weight), taps

        weight, taps = carry
        most = jnp.maximum(jnp.max(positions), 1)
        least, taps = in_turn(between, look, add, (whole, taps), 0, most)
        return (jax.lax.dynamic_update_slice_in_dim(weight, least, begin, 0), taps), None

    nothing = jnp.zeros((finest, full.size), start.dtype)
    first = full, Taps(nothing.astype(jnp.int32), nothing, nothing)
    (weight, taps), _ = jax.lax.scan(piece, first, begins)
    return PlacedSamples(taps, wanted, value, weight, scale, shape, on_sensor)


@eqx.filter_jit
def accumulate(
    placed: PlacedSamples, *, robust: Float[Array, " n"] | None = None, optics: LinearOperator | None = None
) -> DataTerm:
    """M, c and e of the samples. They can be differentiated by the samples' values, and by nothing else.

    **Arguments:**
    - `placed`: the samples and where they were taken.
    - `robust`: (n,) factors on the weights ω_j, 1 if not given.
    - `optics`: the lens, as an operator on the high-resolution picture.
    """
    height, width = placed.shape
    weight = placed.weight if robust is None else placed.weight * robust
    planes, target = _sums(placed.value, placed.with_fixed_values, weight)
    return DataTerm(
        stencil=Stencil(jnp.stack(planes).reshape(5, height, width)),
        target=target.reshape(height, width),
        energy=jnp.sum(weight * placed.value**2),
        aperture=Downsample((height * placed.scale, width * placed.scale), placed.scale)
        if placed.on_sensor
        else Aperture(placed.shape, placed.scale),
        optics=optics,
    )


@eqx.filter_custom_vjp
def _sums(
    values: Float[Array, " n"], placed: PlacedSamples, weight: Float[Array, " n"]
) -> tuple[tuple[Float[Array, " pixels"], ...], Float[Array, " pixels"]]:
    """The planes of M, and c of these values."""
    height, width = placed.shape
    # Upper left tap 0, its right, lower and lower right neighbours 1, 2, 3: (plane, at tap, tap, tap).
    products = (
        (0, 0, 0, 0), (0, 1, 1, 1), (0, 2, 2, 2), (0, 3, 3, 3),
        (1, 0, 0, 1), (1, 2, 2, 3), (2, 1, 1, 2), (3, 0, 0, 2), (3, 1, 1, 3), (4, 0, 0, 3),
    )  # fmt: skip
    offsets = (0, 1, width, width + 1)

    def add(sums: tuple[tuple[Array, ...], Array], taps: Taps, own: Float[Array, " m"], value: Float[Array, " m"]):
        planes, target = list(sums[0]), sums[1]
        weighted = tuple(own * tap for tap in taps.weights)
        for offset, tap in zip(offsets, weighted, strict=True):
            target = target.at[taps.index + offset].add(tap * value)
        for plane, at, first, second in products:
            planes[plane] = planes[plane].at[taps.index + offsets[at]].add(weighted[first] * taps.weights[second])
        return tuple(planes), target

    # An array to each plane: in one array of five, the same sums took a third longer.
    nothing = jnp.zeros(height * width, values.dtype)
    return placed.visited(add, ((nothing,) * 5, nothing), weight, values)


@_sums.def_fwd
def _(perturbed: Any, values: Float[Array, " n"], placed: PlacedSamples, weight: Float[Array, " n"]) -> Any:
    return _sums(values, placed, weight), None


@_sums.def_bwd
def _(
    kept: None,
    change: Any,
    perturbed: Any,
    values: Float[Array, " n"],
    placed: PlacedSamples,
    weight: Float[Array, " n"],
) -> Float[Array, " n"]:
    # M does not depend on the values.
    target = change[1]
    return jnp.zeros_like(values) if target is None else weight * placed.read(target.reshape(placed.shape))
