"""The data term of Eq. 4 in sampled form: an iteration costs the same for 40 frames and for 4,000.

Where motion is locally a translation, warping and blurring commute: what pixel p sees at time t is the blurred picture
U = B X (aperture after optics), read at one position, s·q, q the key-frame position of what it sees. A sample j is a
row r_j of four bilinear weights on U, or the mean of K such rows along its exposure, and

    f(X) = ½ Σ_j ω_j (r_j·B X − Y_j)² = ½⟨U, M U⟩ − ⟨c, U⟩ + ½ e,
    M = Σ ω_j r_j r_jᵀ,   c = Σ ω_j Y_j r_j,   e = Σ ω_j Y_j².

M and c are accumulated once. M is a symmetric stencil of 3×3 weights that varies over the picture; five planes hold it.

**Exposures.** Rows at several positions of an exposure would couple points as far apart as the motion during it. M is
therefore accumulated from Σ_k r_jk r_jkᵀ / K, which is never below the true M_e = Σ ω_j r_j r_jᵀ with r_j = Σ_k r_jk /
K (convexity), while c is exact. `with_exposure` then corrects c so that the gradient at a given picture is the exact
one: each solve minimises a quadratic that lies on or above the true objective and touches it there (majorise–minimise),
so that alternating the two lowers the true objective every time and ends at its minimiser.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from scsr_opt.camera.samples import Samples
from scsr_opt.motion.trajectory import Trajectory
from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.operator import LinearOperator

Positions = tuple[tuple[int, int], ...]
"""(m, K), …: the first m samples have K positions along their exposure, the next m another number, …."""

# The neighbours that a pixel is coupled with, besides itself; the opposite four follow by symmetry.
_NEIGHBOURS = ((0, 1), (1, -1), (1, 0), (1, 1))


class Stencil(eqx.Module):
    """A symmetric operator M on pictures that couples each pixel with its eight neighbours.

    **Fields:** `planes` (5, H, W): the diagonal, and the coupling of p with p + (0, 1), (1, −1), (1, 0), (1, 1).
    """

    planes: Float[Array, "5 H W"]

    def __call__(self, u: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """M u."""
        height, width = u.shape
        around = jnp.pad(u, 1)
        result = self.planes[0] * u
        for plane, (down, right) in zip(self.planes[1:], _NEIGHBOURS, strict=True):
            ahead = jax.lax.slice(around, (1 + down, 1 + right), (1 + down + height, 1 + right + width))
            behind = jnp.pad(plane, 1)
            behind = jax.lax.slice(behind, (1 - down, 1 - right), (1 - down + height, 1 - right + width))
            before = jax.lax.slice(around, (1 - down, 1 - right), (1 - down + height, 1 - right + width))
            result = result + plane * ahead + behind * before
        return result


class DataTerm(eqx.Module):
    """f(X) = ½⟨U, M U⟩ − ⟨c, U⟩ + ½ e with U = B X: Eq. 4's data part, divided by two.

    **Fields:**
    - `stencil`: M. `target`: c, (H, W). `energy`: e.
    - `aperture`, `optics`: B = aperture ∘ optics; `optics` None means a perfect lens.
    """

    stencil: Stencil
    target: Float[Array, "H W"]
    energy: Float[Array, ""]
    aperture: Aperture
    optics: LinearOperator | None

    @property
    def shape(self) -> tuple[int, int]:
        return self.aperture.shape

    def blurred(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """U = B X."""
        return self.aperture(image if self.optics is None else self.optics(image))

    def blurred_adjoint(self, u: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """Bᵀ u."""
        back = self.aperture.adjoint(u)
        return back if self.optics is None else self.optics.adjoint(back)

    def value_and_gradient(self, image: Float[Array, "H W"]) -> tuple[Float[Array, ""], Float[Array, "H W"]]:
        """f and its gradient Bᵀ(M B X − c), from one application of M."""
        u = self.blurred(image)
        mu = self.stencil(u)
        value = jnp.sum(u * (0.5 * mu - self.target)) + 0.5 * self.energy
        return value, self.blurred_adjoint(mu - self.target)

    def value(self, image: Float[Array, "H W"]) -> Float[Array, ""]:
        return self.value_and_gradient(image)[0]

    def gradient(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        return self.value_and_gradient(image)[1]

    def normal(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """Bᵀ M B X."""
        return self.blurred_adjoint(self.stencil(self.blurred(image)))


class Taps(eqx.Module):
    """Where some samples read U: K positions of each, spread evenly along its exposure.

    **Fields:**
    - `index` (K, m): of the upper left of four taps in the flattened picture.
    - `down`, `right` (K, m): how far the position lies beyond that tap, in pixels.

    A scan over them hands out one position after another: the same, with arrays (m,).
    """

    index: Int[Array, "*K m"]
    down: Float[Array, "*K m"]
    right: Float[Array, "*K m"]

    @property
    def positions(self) -> int:
        """K."""
        return self.index.shape[0]


def _weights(at: Taps) -> tuple[Array, Array, Array, Array]:
    down, right = at.down, at.right
    return (1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right


class PlacedSamples(eqx.Module):
    """Samples with the positions on the grid of U that each was taken at, ready to be read and accumulated.

    **Fields:**
    - `taps`: where the first samples read U, the next ones, …: those with long exposures at more positions.
    - `value`, `weight` (n,): Y_j and ω_j; the weight is 0 where a sample leaves the picture or sees what the key frame
      does not show.
    - `scale` s, `shape` (H, W).
    """

    taps: tuple[Taps, ...]
    value: Float[Array, " n"]
    weight: Float[Array, " n"]
    scale: int = eqx.field(static=True)
    shape: tuple[int, int] = eqx.field(static=True)

    @property
    def positions(self) -> Positions:
        """How many samples have how many positions, in order: (m, K), …."""
        return tuple((taps.index.shape[1], taps.positions) for taps in self.taps)

    @property
    def finest(self) -> int:
        """The largest number of positions along an exposure."""
        return max(k for _, k in self.positions)

    def split(self, values: Float[Array, " n"]) -> list[Float[Array, " _"]]:
        """One number for each sample, by `taps`."""
        return jnp.split(values, list(itertools.accumulate(m for m, _ in self.positions))[:-1])

    @eqx.filter_jit
    def read(self, u: Float[Array, "H W"]) -> Float[Array, " n"]:
        """r_j · u for every sample."""
        flat, width = u.reshape(-1), self.shape[1]

        def add(total: Float[Array, " m"], at: Taps):
            corners = [flat[at.index + offset] for offset in (0, 1, width, width + 1)]
            upper = corners[0] + at.right * (corners[1] - corners[0])
            lower = corners[2] + at.right * (corners[3] - corners[2])
            return total + upper + at.down * (lower - upper), None

        read = []
        for taps, nothing in zip(self.taps, self.split(jnp.zeros_like(self.value)), strict=True):
            total, _ = jax.lax.scan(add, nothing, taps)
            read.append(total / taps.positions)
        return jnp.concatenate(read)

    @eqx.filter_jit
    def spread(self, values: Float[Array, " n"]) -> Float[Array, "H W"]:
        """Σ_j values_j r_j, the adjoint of `read`."""
        width = self.shape[1]
        total = jnp.zeros(self.shape[0] * width, values.dtype)
        for taps, own in zip(self.taps, self.split(values), strict=True):

            def add(total: Float[Array, " m"], at: Taps, share: Array = own / taps.positions):
                for offset, tap in zip((0, 1, width, width + 1), _weights(at), strict=True):
                    total = total.at[at.index + offset].add(share * tap)
                return total, None

            total, _ = jax.lax.scan(add, total, taps)
        return total.reshape(self.shape)


@eqx.filter_jit
def place(
    samples: Samples, path: Trajectory, *, scale: int, shape: tuple[int, int], positions: int | Positions = 1
) -> PlacedSamples:
    """Where each sample was taken, on the grid of U.

    **Arguments:**
    - `samples`: as device arrays, padded.
    - `path`: where in the key frame lies what a pixel sees.
    - `scale` s, `shape` (H, W) of the high-resolution picture.
    - `positions`: K, spread evenly over each exposure; 1 takes its middle. Or (m, K) for the first m samples, the
      next, …, all of them.

    A sample that leaves the picture at any time of its exposure is dropped. Of a scene that passes through a small
    picture within a few exposures the short ones of bright moments remain, and it comes out too bright (by half at one
    sensor pixel a frame on 24 of them). Counting such samples for the part of them
    inside mends that and costs 1 dB where a lens blurs across the border.
    """
    height, width = shape
    fields = [jnp.asarray(v) for v in (samples.row, samples.column, samples.start, samples.stop, samples.weight)]
    taps, weights, begin = [], [], 0
    for number, count in ((fields[0].size, positions),) if isinstance(positions, int) else positions:
        some = tuple(field[begin : begin + number] for field in fields)
        begin += number

        def at(weight: Float[Array, " m"], along: Float[Array, ""], some: tuple[Array, ...] = some):
            pixel_row, pixel_column, start, stop, full = some
            row, column, seen = path.at(pixel_row, pixel_column, start + (stop - start) * along)
            row, column = row * scale, column * scale
            # A tolerance of a thousandth of a pixel, so that rounding does not drop the border row of a scene at rest.
            inside = (row >= -1e-3) & (column >= -1e-3)
            inside &= (row <= height - scale + 1e-3) & (column <= width - scale + 1e-3)
            # What lies outside is read somewhere inside, with weight 0; so is a position that is not a number.
            row = jnp.clip(jnp.where(inside, row, 0), 0, height - scale)
            column = jnp.clip(jnp.where(inside, column, 0), 0, width - scale)
            top, left = row.astype(jnp.int32), column.astype(jnp.int32)
            index = top * width + left
            # A sample counts as far as it can be used at each of its positions.
            weight = jnp.minimum(weight, full * jnp.where(inside, seen, 0))
            return weight, Taps(index, row - top.astype(row.dtype), column - left.astype(column.dtype))

        along = (jnp.arange(count, dtype=some[2].dtype) + 0.5) / count
        weight, of_these = jax.lax.scan(at, some[-1], along)
        taps.append(of_these)
        weights.append(weight)
    return PlacedSamples(tuple(taps), jnp.asarray(samples.value), jnp.concatenate(weights), scale, shape)


@eqx.filter_jit
def accumulate(
    placed: PlacedSamples, *, robust: Float[Array, " n"] | None = None, optics: LinearOperator | None = None
) -> DataTerm:
    """M, c and e of the samples.

    **Arguments:**
    - `placed`: the samples and where they were taken.
    - `robust`: (n,) factors on the weights ω_j, 1 if not given.
    - `optics`: the lens, as an operator on the high-resolution picture.
    """
    height, width = placed.shape
    weight = placed.weight if robust is None else placed.weight * robust
    # Upper left tap 0, its right, lower and lower right neighbours 1, 2, 3: (plane, at tap, tap, tap).
    products = (
        (0, 0, 0, 0), (0, 1, 1, 1), (0, 2, 2, 2), (0, 3, 3, 3),
        (1, 0, 0, 1), (1, 2, 2, 3), (2, 1, 1, 2), (3, 0, 0, 2), (3, 1, 1, 3), (4, 0, 0, 3),
    )  # fmt: skip
    offsets = (0, 1, width, width + 1)
    # An array to each plane: in one array of five, the same sums took a third longer.
    nothing = jnp.zeros(height * width, weight.dtype)
    sums = ((nothing,) * 5, nothing)
    by_taps = zip(placed.taps, placed.split(weight), placed.split(placed.value), strict=True)
    for taps, own, value in by_taps:
        own = own / taps.positions

        def add(carry: tuple[tuple[Array, ...], Array], at: Taps, own: Array = own, value: Array = value):
            planes, target = list(carry[0]), carry[1]
            each = _weights(at)
            weighted = tuple(own * tap for tap in each)
            for offset, tap in zip(offsets, weighted, strict=True):
                target = target.at[at.index + offset].add(tap * value)
            for plane, corner, first, second in products:
                planes[plane] = planes[plane].at[at.index + offsets[corner]].add(weighted[first] * each[second])
            return (tuple(planes), target), None

        sums, _ = jax.lax.scan(add, sums, taps)
    planes, target = sums
    return DataTerm(
        stencil=Stencil(jnp.stack(planes).reshape(5, height, width)),
        target=target.reshape(height, width),
        energy=jnp.sum(weight * placed.value**2),
        aperture=Aperture(placed.shape, placed.scale),
        optics=optics,
    )


@eqx.filter_jit
def with_exposure(
    term: DataTerm, placed: PlacedSamples, image: Float[Array, "H W"], *, robust: Float[Array, " n"] | None = None
) -> DataTerm:
    """`term`, as `accumulate` made it, with c and e corrected for the motion during the exposures: it touches the exact
    data term at `image` and lies on or above it everywhere.

    With U = B·image: c' = c + (M − M_e) U and e' = e + ⟨U, (M − M_e) U⟩, M_e from the samples themselves.
    """
    weight = placed.weight if robust is None else placed.weight * robust
    u = term.blurred(image)
    excess = term.stencil(u) - placed.spread(weight * placed.read(u))
    return eqx.tree_at(lambda t: (t.target, t.energy), term, (term.target + excess, term.energy + jnp.sum(u * excess)))
