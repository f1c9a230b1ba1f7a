"""A learned prior with a guarantee: a bank of filters and a profile for each, convex or weakly convex by construction.

The picture is mirrored at its border and correlated with the filters; what comes out is penalised pixel by pixel by
sums of Huber functions, whose derivatives are linear splines. Filters and splines are learned
(`learned.training.ridge`), and the bounds that the guarantees rest on are calculated from them when a prior is made,
whatever was learned.
"""

import zipfile
import zlib
from pathlib import Path
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from scsr_opt._arrays import as_array
from scsr_opt._kernels.device import on_device
from scsr_opt._kernels.programs import compiled
from scsr_opt._validation import positive
from scsr_opt.errors import InputError
from scsr_opt.priors.prior import Prior

WEIGHTS = Path(__file__).parent / "weights"
"""Where the shipped regularisers are, `ridge_<name>.npz`, each with a card that lists what it was trained on."""
# Frequencies a side on which the norm of the bank is looked for.
_FREQUENCIES = 128
# float32 keeps seven digits, and a file's filters were symmetric before they were rounded.
_ROUNDING = 1e-5
# Values that all filters together give for a band of the picture: 1 MB in float32, so that it stays in the cache.
_BAND_VALUES = 250_000
# What reading raises where a file is cut, changed or of another kind.
_DAMAGE = (KeyError, ValueError, EOFError, OSError, AttributeError, TypeError, zipfile.BadZipFile, zlib.error)


class RidgeState(NamedTuple):
    """A picture, and Ψ and ∇Ψ there: where a proximal step begins."""

    image: Float[Array, "H W"]
    value: Float[Array, ""]
    gradient: Float[Array, "H W"]


class RidgeRegulariser(Prior[RidgeState]):
    """Ψ(X) = Σ_c Σ_p ψ_c((W_c X)(p)), W_c X the picture correlated with filter c, ψ_c' an odd linear spline (Goujon,
    Neumayer, Bohra, Ducotterd, Unser, 2023, "A neural-network-based convex regularizer for inverse problems"; Goujon,
    Neumayer, Unser, 2024, "Learning weakly convex regularizers for convergent image-reconstruction algorithms").

    ψ_c' rises with slope s_1 up to the knot τ_1, with s_2 from there to τ_2, and so on; past the last knot it is
    constant, so that ψ_c grows as an absolute value does. It is a sum of clipped lines, ψ_c a sum of Huber functions.

    The filters see the picture mirrored at its border (the first row repeated, as the cosine transform has it). If the
    bank as a whole does not change when its filters are mirrored, ‖W‖² is at most the largest power response,
    max over ω of Σ_c |ŵ_c(ω)|², for every size of picture: mirroring moves energy among the four quadrants of the
    continued picture, and by symmetry each holds a quarter. Such banks alone are accepted. The maximum is taken on 128
    frequencies a side and raised by 1/cos²(π(k − 1)/128), by which a trigonometric polynomial of degree k − 1 can pass
    its samples at most (Ehlich and Zeller, 1964). With all slopes between −ρ and σ,

        −ρ‖W‖² ≤ ∇²Ψ ≤ σ‖W‖²       (`concavity` and `curvature`):

    Ψ is convex if no slope is negative, and else becomes so by adding ½·concavity·‖X‖².

    The proximal step minimises ½‖X − f‖² + λΨ(X) by Nesterov's method for strongly convex functions, from the result of
    the last call. With κ = (1 + λ·curvature)/(1 − λ·concavity), the distance to the optimum is at most 2(1 − 1/√κ)^k
    times that of the start after k steps (Nesterov, 2004, "Introductory lectures on convex optimization", Theorem
    2.2.3); as many are made as bring that to `accuracy`: two in an iteration of FISTA by day. Where λ·concavity ≥ 1
    nothing is certain, and three plain gradient steps of size 1/(1 + λ·curvature) are made. So the result is never
    above the start, which is what the objective of ISTA needs to fall in each iteration: there the start is the picture
    before, at which the majorant and the objective agree. That holds for the weakly convex prior as well; but F is then
    not convex, and what is reached is a critical point. Where λ·concavity < 1 the proximal step itself still has a
    single minimiser: denoising stays a convex problem.

    Ψ and ∇Ψ at the result are kept for the next call, which begins with them, and for the record of the solvers: k
    steps cost k evaluations of ∇Ψ and nothing else.

    **Fields:** `filters`, `knots` τ, `slopes` s (one row a filter), `accuracy`, and the two bounds.

    **Arguments:** as the fields; `filters` of odd side and zero mean; `knots` in intensity; `accuracy` between 0 and 1,
    what may be left of the distance to the optimum.

    **Errors:** `InputError` for a filter that sees constants, a bank that mirroring changes, knots that are not
    positive and increasing, arrays that do not fit each other or are not finite, an accuracy not between 0 and 1.
    """

    smooth: ClassVar[bool] = True
    # Steps of a proximal step, at most, and where no number of them is enough for certain.
    MOST_STEPS: ClassVar[int] = 100
    UNCERTAIN_STEPS: ClassVar[int] = 3
    # `accuracy` of a proximal step that starts anew (`with_inner_iterations`).
    FRESH_ACCURACY: ClassVar[float] = 1e-6

    filters: Float[Array, "C k k"]
    knots: Float[Array, "C K"]
    slopes: Float[Array, "C K"]
    accuracy: Float[Array, ""]
    curvature: float = eqx.field(static=True)
    concavity: float = eqx.field(static=True)

    def __init__(self, filters: ArrayLike, knots: ArrayLike, slopes: ArrayLike, accuracy: float | int = 0.2):
        bank, τ, s = (
            as_array(values, f"RidgeRegulariser's {name}").astype(np.float64)
            for name, values in (("filters", filters), ("knots", knots), ("slopes", slopes))
        )
        _check(bank, τ, s)
        norm_squared = bank_norm_squared(bank)
        self.filters, self.knots, self.slopes = (on_device(values.astype(np.float32)) for values in (bank, τ, s))
        self.accuracy = on_device(np.float32(positive("RidgeRegulariser", "an accuracy", accuracy, 1)))
        self.curvature = norm_squared * max(float(s.max()), 0.0)
        self.concavity = norm_squared * max(-float(s.min()), 0.0)

    @property
    def lipschitz(self) -> float | None:
        """`curvature`, if Ψ is convex."""
        return self.curvature if self.concavity == 0 else None

    def value(self, image: Float[Array, "H W"]) -> Float[Array, ""]:
        """Ψ(image)."""
        return self.value_and_gradient(image)[0]

    def gradient(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """∇Ψ(image) = Σ_c W_cᵀ ψ_c'(W_c image)."""
        return self.value_and_gradient(image)[1]

    @eqx.filter_jit
    def value_and_gradient(self, image: Float[Array, "H W"]) -> tuple[Float[Array, ""], Float[Array, "H W"]]:
        """Ψ and ∇Ψ. By bands of rows: what all filters see of a whole picture is many times as large as the picture."""
        count, side, _ = self.filters.shape
        height, width = image.shape
        # On other processors there is one memory, and many small pieces of work are slow.
        bands = -(-height * width * count // _BAND_VALUES) if jax.default_backend() == "cpu" else 1
        rows = -(-height // bands)
        bands = -(-height // rows)
        wide = _mirrored(image, side // 2)

        def band(k: int | Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
            value, gradient = found
            # The last two overlap, so that all are alike; what was counted before counts for nothing.
            first = jnp.minimum(k * rows, height - rows)
            fresh = first + jnp.arange(rows) >= k * rows
            part = jax.lax.dynamic_slice_in_dim(wide, first, rows + side - 1)
            field = jnp.where(fresh[None, :, None], _within(self.filters, part), 0)
            profile, derivative = profile_and_derivative(self.knots, self.slopes, field)
            added = _within_adjoint(self.filters, derivative)
            before = jax.lax.dynamic_slice_in_dim(gradient, first, rows + side - 1)
            gradient = jax.lax.dynamic_update_slice_in_dim(gradient, before + added, first, 0)
            return value + jnp.sum(profile), gradient

        begin = jnp.zeros((), image.dtype), jnp.zeros_like(wide)
        value, gradient = jax.lax.fori_loop(0, bands, band, begin)
        return value, _folded(gradient, side // 2)

    def with_inner_iterations(self, iterations: int) -> "RidgeRegulariser":
        """This prior with an accurate proximal step, whose number of iterations follows from its accuracy."""
        return eqx.tree_at(lambda ridge: ridge.accuracy, self, jnp.full_like(self.accuracy, self.FRESH_ACCURACY))

    def initial_state(self, image: Float[Array, "H W"]) -> RidgeState:
        """The picture: where the first proximal step begins."""
        return RidgeState(image, *self.value_and_gradient(image))

    def value_after(self, image: Float[Array, "H W"], state: RidgeState) -> Float[Array, ""]:
        """Ψ of the picture that the proximal step gave, which came with it."""
        return state.value

    @compiled
    def prox(
        self, image: Float[Array, "H W"], strength: Float[ArrayLike, ""], state: RidgeState
    ) -> tuple[Float[Array, "H W"], RidgeState]:
        """argmin over X of ½‖X − image‖² + strength·Ψ(X), as far from it as `accuracy` allows, `state` being where to
        start; and the same picture, to start from next time."""
        λ = jnp.asarray(strength, image.dtype)
        steepest, flattest = 1 + λ * self.curvature, 1 - λ * self.concavity
        rate = jnp.sqrt(jnp.maximum(flattest, 0) / steepest)
        enough = jnp.ceil(jnp.log(self.accuracy.astype(image.dtype) / 2) / jnp.log1p(-rate))
        steps = jnp.where(flattest > 0, jnp.clip(enough, 1, self.MOST_STEPS), self.UNCERTAIN_STEPS).astype(jnp.int32)
        momentum = jnp.where(flattest > 0, (1 - rate) / (1 + rate), 0)

        def moved(ahead: Array, gradient: Array) -> Array:
            return ahead - (ahead - image + λ * gradient) / steepest

        def descend(_: int | Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            picture, ahead, gradient = carry
            following = moved(ahead, gradient)
            beyond = following + momentum * (following - picture)
            return following, beyond, self.gradient(beyond)

        begin = (state.image, state.image, state.gradient)
        _, ahead, gradient = jax.lax.fori_loop(0, steps - 1, descend, begin)
        result = moved(ahead, gradient)
        return result, RidgeState(result, *self.value_and_gradient(result))

    def scaled(self, weight: float | int, finer: float | int = 1.0) -> "RidgeRegulariser":
        """weight · Ψ(finer · X) / finer: the prior with another weight, and for differences `finer` times as small.

        **Errors:** `InputError` unless both are positive and finite.
        """
        weight, finer = positive("scaled", "a weight", weight), positive("scaled", "the factor finer", finer)
        knots, slopes = np.asarray(self.knots) / finer, np.asarray(self.slopes) * (weight * finer)
        return RidgeRegulariser(self.filters, knots, slopes, float(self.accuracy))

    def save(self, path: str | Path) -> None:
        """Writes filters, knots and slopes as an `.npz` file."""
        filters, knots, slopes = (np.asarray(values) for values in (self.filters, self.knots, self.slopes))
        np.savez_compressed(path, filters=filters, knots=knots, slopes=slopes)

    @classmethod
    def load(cls, name: str | Path = "convex", accuracy: float | int = 0.2) -> "RidgeRegulariser":
        """A shipped prior, "convex" or "weakly_convex", or one from an `.npz` file that `save` wrote.

        The shipped ones are weighted so that λ means about what it does with `HuberTotalVariation`. `accuracy` is that
        of the class.

        **Errors:** `InputError` for a file that is missing, damaged or of another kind.
        """
        shipped = str(name) in ("convex", "weakly_convex")
        path = WEIGHTS / f"ridge_{name}.npz" if shipped else Path(name)
        if not path.is_file():
            raise InputError(
                f"There is no ridge regulariser {str(name)!r}; take 'convex', 'weakly_convex' or the path of an .npz "
                "file."
            )
        try:
            # Opened here, as what `np.load` opens stays open where it finds no archive.
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                parts = {part: np.asarray(file[part], np.float64) for part in ("filters", "knots", "slopes")}
        except _DAMAGE as error:
            raise InputError(
                f"{path.name} is not the file of a ridge regulariser, or it is damaged ({error}); copy or train it "
                "anew."
            ) from error
        return cls(**parts, accuracy=accuracy)


def correlate(filters: Float[Array, "C k k"], image: Float[Array, "H W"]) -> Float[Array, "C H W"]:
    """W X: the picture, mirrored at its border, correlated with each filter."""
    return _within(filters, _mirrored(image, filters.shape[-1] // 2))


def correlate_adjoint(filters: Float[Array, "C k k"], field: Float[Array, "C H W"]) -> Float[Array, "H W"]:
    """Wᵀ applied to a field."""
    return _folded(_within_adjoint(filters, field), filters.shape[-1] // 2)


def _within(filters: Float[Array, "C k k"], wide: Float[Array, "_ _"]) -> Float[Array, "C h w"]:
    """A picture correlated with each filter, where the filter lies within the picture."""
    count, side, _ = filters.shape
    seen = _windows(side, wide)
    # As one product of matrices: a convolution of one picture with many filters takes a CPU longer.
    field = filters.astype(wide.dtype).reshape(count, -1) @ seen.reshape(side * side, -1)
    return field.reshape(count, *seen.shape[1:])


def _within_adjoint(filters: Float[Array, "C k k"], field: Float[Array, "C h w"]) -> Float[Array, "_ _"]:
    count, side, _ = filters.shape
    planes = filters.astype(field.dtype).reshape(count, -1).T @ field.reshape(count, -1)
    planes = planes.reshape(side, side, *field.shape[1:])
    return sum(
        (
            jnp.pad(planes[row, column], ((row, side - 1 - row), (column, side - 1 - column)))
            for row in range(side)
            for column in range(side)
        ),
        start=jnp.zeros((), field.dtype),
    )


def _windows(side: int, wide: Float[Array, "_ _"]) -> Float[Array, "kk h w"]:
    """Pixels under a filter of this side at each place where it lies within a picture: a plane for each of them."""
    height, width = (length - side + 1 for length in wide.shape)
    return jnp.stack(
        [wide[row : row + height, column : column + width] for row in range(side) for column in range(side)]
    )


def profile_and_derivative(
    knots: Float[Array, "C K"], slopes: Float[Array, "C K"], field: Float[Array, "C h w"]
) -> tuple[Float[Array, "C h w"], Float[Array, "C h w"]]:
    """ψ_c(field) and ψ_c'(field) for each channel c.

    With t a value of the field and c what clipping to a knot leaves of it, ψ_c' is the sum of c over the knots, each
    times the change of slope there, and ψ_c is t ψ_c' less half such a sum of c².
    """
    falls = slopes - jnp.pad(slopes[:, 1:], ((0, 0), (0, 1)))
    knots, falls = (values.astype(field.dtype)[:, :, None, None] for values in (knots, falls))
    derivative = squares = jnp.zeros_like(field)
    for j in range(knots.shape[1]):
        clipped = jnp.clip(field, -knots[:, j], knots[:, j])
        scaled = falls[:, j] * clipped
        derivative += scaled
        squares += scaled * clipped
    return field * derivative - squares / 2, derivative


def _mirrored(image: Float[Array, "H W"], border: int) -> Float[Array, "_ _"]:
    return jnp.pad(image, border, mode="symmetric")


def _folded(wide: Float[Array, "_ _"], border: int) -> Float[Array, "H W"]:
    """The adjoint of `_mirrored`."""
    like = jax.ShapeDtypeStruct(tuple(length - 2 * border for length in wide.shape), wide.dtype)
    (image,) = jax.linear_transpose(lambda x: _mirrored(x, border), like)(wide)
    return image


def bank_norm_squared(filters: Float[np.ndarray, "C k k"]) -> float:
    """An upper bound on ‖W‖² for pictures of every size, for a bank that mirroring does not change (see the class)."""
    degree = filters.shape[-1] - 1
    response = np.sum(np.abs(np.fft.rfft2(filters, (_FREQUENCIES, _FREQUENCIES))) ** 2, axis=0)
    return float(response.max() / np.cos(np.pi * degree / _FREQUENCIES) ** 2)


def _check(filters: np.ndarray, knots: np.ndarray, slopes: np.ndarray) -> None:
    name = "RidgeRegulariser"
    shape = filters.shape
    if len(shape) != 3 or shape[1] != shape[2] or shape[1] % 2 == 0 or shape[1] >= _FREQUENCIES // 2:
        raise InputError(
            f"{name} was given filters of shape {shape}; it needs (C, k, k), k odd, below {_FREQUENCIES // 2}."
        )
    if knots.ndim != 2 or knots.shape != slopes.shape or len(knots) != len(filters) or knots.size == 0:
        raise InputError(
            f"{name} was given {len(filters)} filters, knots of shape {knots.shape} and slopes of shape "
            f"{slopes.shape}; knots and slopes need a row for each filter, equally long."
        )
    if not all(np.isfinite(values).all() for values in (filters, knots, slopes)):
        raise InputError(f"{name} was given values that are not finite; train again, or load an undamaged file.")
    if (knots[:, 0] <= 0).any() or (np.diff(knots, axis=1) <= 0).any():
        raise InputError(f"{name} was given knots that are not positive and increasing along each row; sort them.")
    largest = np.abs(filters).max()
    if np.abs(filters.sum((1, 2))).max() > _ROUNDING * shape[1] ** 2 * largest:
        raise InputError(f"{name} was given a filter whose sum is not zero; take its mean away from each filter.")
    flat = filters.reshape(len(filters), -1)
    products = (flat.T @ flat).reshape(shape[1:] * 2)
    for turned in (products[::-1, :, ::-1], products[:, ::-1, :, ::-1]):
        if np.abs(turned - products).max() > _ROUNDING * np.abs(products).max():
            raise InputError(
                f"{name} was given a bank that changes when it is mirrored, for which its bounds do not hold; add the "
                "mirrored filters."
            )
