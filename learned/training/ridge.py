"""Trains the filters and splines of a `RidgeRegulariser` on the task that it is used for.

A training problem is a patch of a picture, what sensors of apertures 1×1 (denoising), 2×2 or 4×4 would measure of it
(or those that are named only), and noise; each aperture on its grid, as in a still scene, or everywhere with random
weights, as in a moving one:

    X*(θ) = argmin over X of ½ Σ_p m_p ((B X)(p) − Y_p)² + λ Ψ_θ(X),      minimise the error of X*(θ) over θ.

The derivative comes from the optimality condition (implicit differentiation): with g the derivative of the error at X*
and H v = g, H the Hessian of the problem, it is −∂/∂θ ⟨v, λ∇Ψ_θ(X*)⟩. Both solves are kept for each patch and go on
where they were when the patch comes up again, so a step needs only a few iterations of each. λ is learned too, one
for each task, and then forgotten: in use it is validated. Mirrored copies of filters keep the bank symmetric.

    python -m learned.training.ridge convex --out ridge.npz --pictures FOLDER --minutes 10
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from PIL import Image

from scsr_opt.errors import InputError
from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.priors.ridge_regulariser import (
    RidgeRegulariser,
    correlate,
    correlate_adjoint,
    profile_and_derivative,
)

# scikit-image's own pictures that need no download. Not its astronaut, which is in evaluation sets.
_OWN = ("camera", "coffee", "chelsea", "rocket", "brick", "grass", "gravel", "coins", "moon", "immunohistochemistry")


class Task(NamedTuple):
    """A kind of training problem: the side of the `aperture`; whether there is one measurement a sensor pixel, on its
    `grid`, or some everywhere; and λ/σ to begin with, near the best for the first filters."""

    aperture: int
    grid: bool
    strength: float


TASKS = (Task(1, True, 6.0), Task(2, True, 3.0), Task(2, False, 12.0), Task(4, True, 1.0), Task(4, False, 6.0))


@dataclass(frozen=True)
class RidgeTraining:
    """Numbers of a training run.

    **Fields:**
    - `weakly`: slopes may be negative, down to `weakest` of the largest positive one.
    - `side`: of the filters, odd; `singles`, `pairs`: filters of each kind (`Parameters`).
    - `patch`: side of a patch, pixels; `batch`: patches of a batch; `batches`: how many are kept.
    - `noise`: range of the noise's standard deviation, intensity.
    - `first_iterations`: of the solve of a new batch; `iterations`, `sensitivity_iterations`: of both solves in a step.
    - `rate`: of learning, at first.
    - `knee`: the least first knot over the filter's norm. A free one falls towards 0 in long training, which makes the
      problem stiff and no picture better. That of `HuberTotalVariation` is at 0.014.
    - `convex_knots`, `weakly_convex_knots`: to begin with. Further ones of a convex prior fall onto the first; a weakly
      convex one bends down after it.
    - `alive`: filters whose penalty rises less steeply than this share of the steepest one's are removed at the end.
    - `over_tv`: Ψ of a picture over that of Huber-TV, at which the same λ is best for both.
    """

    weakly: bool = False
    weakest: float = 0.1
    side: int = 5
    singles: int = 2
    pairs: int = 3
    patch: int = 48
    batch: int = 8
    batches: int = 60
    noise: tuple[float, float] = (0.004, 0.03)
    first_iterations: int = 40
    iterations: int = 6
    sensitivity_iterations: int = 3
    rate: float = 0.02
    knee: float = 0.012
    convex_knots: tuple[float, ...] = (0.02,)
    weakly_convex_knots: tuple[float, ...] = (0.02, 0.06, 0.3)
    alive: float = 0.02
    over_tv: float = 1.4


class Parameters(NamedTuple):
    """θ: `single`, filters that mirroring leaves as they are but for their sign (four kinds); `paired`, filters of
    either parity under half a turn, each with its mirrored copy; unbounded numbers for knots and slopes of both, and
    the logarithm of λ for each task."""

    single: Float[Array, "4 n k k"]
    paired: Float[Array, "2 m k k"]
    knots: Float[Array, "c K"]
    slopes: Float[Array, "c K"]
    strengths: Float[Array, " tasks"]


class Problems(NamedTuple):
    """A batch of patches of one task: `truth`, measurements `target` with `weight` m and noise `sigma`, the aperture as
    a `kernel`, and how far the two solves have come."""

    truth: Float[np.ndarray, "n P P"]
    target: Float[np.ndarray, "n P P"]
    weight: Float[np.ndarray, "n P P"]
    sigma: Float[np.ndarray, " n"]
    kernel: Float[Array, "4 4"]
    task: Any
    picture: Any
    sensitivity: Any


def initial(generator: np.random.Generator, run: RidgeTraining, tasks: tuple[Task, ...] = TASKS) -> Parameters:
    """Small random filters of every kind, smoother ones larger, and splines near |t|."""
    side, singles, pairs = run.side, run.singles, run.pairs
    reach = side // 2
    distance = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1])
    window = np.exp(-((distance / 2.5) ** 2))
    count = 4 * singles + 2 * pairs

    def filters(*shape: int) -> Array:
        return jnp.asarray(generator.normal(size=(*shape, side, side)) * window * 0.15, jnp.float32)

    start = run.weakly_convex_knots if run.weakly else run.convex_knots
    share = np.geomspace(0.9, 0.03, len(start))
    if run.weakly:
        share = (share + run.weakest) / (1 + run.weakest)
    rise = np.log(np.expm1(np.diff(start, prepend=run.knee)))
    return Parameters(
        single=filters(4, singles),
        paired=filters(2, pairs),
        knots=jnp.tile(jnp.asarray(rise, jnp.float32), (count, 1)),
        slopes=jnp.tile(jnp.asarray(np.log(share / (1 - share)), jnp.float32), (count, 1)),
        strengths=jnp.log(jnp.asarray([task.strength for task in tasks], jnp.float32)),
    )


def parts(θ: Parameters, run: RidgeTraining) -> tuple[Array, Array, Array]:
    """Filters, knots and slopes of the prior, copies included; the first of spectral norm about 1."""
    mirrored, overturned = θ.single[..., ::-1], θ.single[..., ::-1, :]
    both = mirrored[..., ::-1, :]
    signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
    kinds = [
        θ.single[n] + right * mirrored[n] + down * overturned[n] + right * down * both[n]
        for n, (right, down) in enumerate(signs)
    ]
    single = jnp.concatenate(kinds) / 4
    turned = θ.paired[..., ::-1, ::-1]
    paired = jnp.concatenate([θ.paired[0] + turned[0], θ.paired[1] - turned[1]]) / 2
    filters = jnp.concatenate([single, paired])
    filters = filters - jnp.mean(filters, (1, 2), keepdims=True)
    filters = jnp.concatenate([filters, filters[len(single) :, :, ::-1]])
    response = jnp.sum(jnp.abs(jnp.fft.rfft2(filters, (32, 32))) ** 2, 0)
    filters = filters / jnp.sqrt(jnp.max(response))

    def with_copies(values: Array) -> Array:
        return jnp.concatenate([values, values[len(single) :]])

    least = run.weakest if run.weakly else 0.0
    slopes = -least + (1 + least) * jax.nn.sigmoid(θ.slopes)
    norms = jnp.sqrt(jnp.sum(filters[: len(θ.knots)] ** 2, (1, 2)))
    knots = norms[:, None] * (run.knee + jnp.cumsum(jax.nn.softplus(θ.knots), 1))
    return filters, with_copies(knots), with_copies(_rising(knots, slopes) if run.weakly else slopes)


def _rising(knots: Array, slopes: Array) -> Array:
    """Slopes that fall no further than to where ψ' is 0: below that ψ would have no minimum."""
    lengths, height, risen = jnp.diff(knots, axis=1, prepend=0), jnp.zeros_like(knots[:, 0]), []
    for j in range(knots.shape[1]):
        before, height = height, jnp.maximum(height + slopes[:, j] * lengths[:, j], 0)
        risen.append((height - before) / lengths[:, j])
    return jnp.stack(risen, 1)


def pictures(folder: Path | None, least: int = 96) -> list[Float[np.ndarray, "H W"]]:
    """Grey pictures between 0 and 1, of `least` pixels a side or more: of a folder, or scikit-image's own.

    **Errors:** `InputError` where no picture is large enough.
    """
    if folder is None:
        import skimage.color
        import skimage.data

        found = [np.asarray(getattr(skimage.data, name)()) for name in _OWN]
        found = [np.dot(p[..., :3], [0.299, 0.587, 0.114]) if p.ndim == 3 else p for p in found]
    else:
        files = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".png", ".jpg", ".jpeg", ".tif", ".bmp"))
        found = [np.asarray(Image.open(p).convert("L")) for p in files]
    found = [(p / 255).astype(np.float32) for p in found if min(p.shape) >= least]
    if not found:
        raise InputError(f"{folder} holds no picture of {least} pixels a side or more; name another folder.")
    return found


def _patch(found: list[np.ndarray], generator: np.random.Generator, length: int) -> np.ndarray:
    """A patch with something in it, of a picture or of the picture halved, turned and mirrored at random."""
    while True:
        picture = found[generator.integers(len(found))]
        half = int(generator.integers(2))
        side = length << half
        row, column = (generator.integers(extent - side + 1) for extent in picture.shape)
        patch = picture[row : row + side, column : column + side]
        if half:
            patch = patch.reshape(length, 2, length, 2).mean((1, 3))
        # Flat patches teach little: most are left out.
        if patch.std() > 0.03 or generator.random() < 0.1:
            break
    patch = np.rot90(patch, generator.integers(4))
    return np.ascontiguousarray(patch[:, ::-1] if generator.integers(2) else patch)


def problems(
    found: list[np.ndarray], generator: np.random.Generator, tasks: tuple[Task, ...], task: int, run: RidgeTraining
) -> Problems:
    """A batch of one task, with a first picture for each."""
    aperture, grid, _ = tasks[task]
    truth = np.stack([_patch(found, generator, run.patch) for _ in range(run.batch)])
    kernel = jnp.zeros((4, 4), jnp.float32).at[:aperture, :aperture].set(1 / aperture**2)
    seen = np.asarray(jax.vmap(lambda x: _blurred(kernel, x))(truth))
    weight = np.zeros_like(truth)
    if grid:
        weight[:, ::aperture, ::aperture] = 1
    else:
        weight[:] = generator.exponential(1 / aperture**2, truth.shape)
    inside = run.patch + 1 - aperture
    weight[:, inside:], weight[:, :, inside:] = 0, 0
    low, high = np.log(run.noise)
    sigma = np.exp(generator.uniform(low, high, run.batch)).astype(np.float32)
    noise = generator.normal(size=truth.shape) * sigma[:, None, None] / np.sqrt(np.maximum(weight, 1e-3))
    target = np.where(weight > 0, seen + noise, 0).astype(np.float32)
    spread = np.asarray(jax.vmap(lambda m, y: _blurred_adjoint(kernel, m * y))(weight, target))
    reach = np.asarray(jax.vmap(lambda m: _blurred_adjoint(kernel, m))(weight))
    mean = (weight * target).sum((1, 2), keepdims=True) / weight.sum((1, 2), keepdims=True)
    picture = np.where(reach > 1e-6, spread / np.maximum(reach, 1e-6), mean).astype(np.float32)
    return Problems(truth, target, weight, sigma, kernel, np.int32(task), picture, np.zeros_like(picture))


def _blurred(kernel: Array, image: Array) -> Array:
    """B X: at p the mean over the aperture that begins at p, zeros beyond the patch."""
    height, width = image.shape
    padded = jnp.pad(image, ((0, 3), (0, 3)))
    shifts = [kernel[i, j] * padded[i : i + height, j : j + width] for i in range(4) for j in range(4)]
    return sum(shifts, start=jnp.zeros_like(image))


def _blurred_adjoint(kernel: Array, image: Array) -> Array:
    height, width = image.shape
    padded = jnp.pad(image, ((3, 0), (3, 0)))
    shifts = [kernel[i, j] * padded[3 - i : 3 - i + height, 3 - j : 3 - j + width] for i in range(4) for j in range(4)]
    return sum(shifts, start=jnp.zeros_like(image))


def seen_by(filters: Float[Array, "C k k"], images: Float[Array, "n P P"]) -> Float[Array, "C nPP"]:
    """W of all images, one after the other, mirrored at their borders: a row a channel."""
    return jax.vmap(lambda image: correlate(filters, image), out_axes=1)(images).reshape(len(filters), -1)


def bend(knots: Array, slopes: Array, field: Array) -> Array:
    """ψ_c''(field): the slope of the piece that a value is on, 0 beyond the last knot."""
    falls = slopes - jnp.pad(slopes[:, 1:], ((0, 0), (0, 1)))
    size = jnp.abs(field)
    pieces = [jnp.where(size < knots[:, j, None, None], falls[:, j, None, None], 0) for j in range(knots.shape[1])]
    return sum(pieces, start=jnp.zeros_like(field))


class _Forward(NamedTuple):
    """Results of one patch's two solves, and its λ and mean square error."""

    picture: Array
    sensitivity: Array
    strength: Array
    error: Array


def _solve(
    prior: tuple[Array, Array, Array],
    λ: Array,
    kernel: Array,
    steps: tuple[int, int],
    truth,
    target,
    weight,
    picture,
    sensitivity,
) -> _Forward:
    """`steps`: iterations of the solve and of that of its sensitivity."""
    filters, knots, slopes = prior

    def normal(x: Array) -> Array:
        return _blurred_adjoint(kernel, weight * _blurred(kernel, x))

    def gradient(x: Array) -> Array:
        _, field = profile_and_derivative(knots, slopes, correlate(filters, x))
        return normal(x) - spread + λ * correlate_adjoint(filters, field)

    spread = _blurred_adjoint(kernel, weight * target)
    # B and m have no negative entries: the largest row sum bounds the norm. The filters' is 1, up to their grid.
    steepest = jnp.max(normal(jnp.ones_like(picture))) + 1.05 * λ * jnp.max(slopes)

    def descend(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        x, ahead = carry
        moved = ahead - gradient(ahead) / steepest
        return moved, moved + k / (k + 3) * (moved - x)

    picture, _ = jax.lax.fori_loop(0, steps[0], lambda k, c: descend(k.astype(jnp.float32), c), (picture, picture))
    error = picture - truth
    square = jnp.mean(error**2)
    # Between the mean square, which hard patches rule, and its logarithm, which flat ones do.
    towards = error / jnp.sqrt(square + 1e-4)

    def hessian(v: Array) -> Array:
        return normal(v) + λ * correlate_adjoint(filters, bends * correlate(filters, v)) + 1e-3 * v

    bends = bend(knots, slopes, correlate(filters, picture))

    sensitivity, _ = jax.scipy.sparse.linalg.cg(hessian, towards, sensitivity, maxiter=steps[1], tol=0.0)
    return _Forward(picture, sensitivity, λ, square)


def make_step(optimiser: optax.GradientTransformation, run: RidgeTraining) -> Any:
    """The compiled training step: (θ, optimiser's state, batch, rate) → θ, state, solves and mean PSNR; and
    one before it that only solves, for a batch that is new."""

    def solved(θ: Parameters, batch: Problems, steps: int) -> _Forward:
        prior = parts(θ, run)
        strengths = jnp.exp(θ.strengths[batch.task]) * batch.sigma
        return jax.vmap(lambda λ, *rest: _solve(prior, λ, batch.kernel, (steps, run.sensitivity_iterations), *rest))(
            strengths, batch.truth, batch.target, batch.weight, batch.picture, batch.sensitivity
        )

    def slant(θ: Parameters, batch: Problems, forward: _Forward) -> Array:
        """−Σ ⟨v, λ∇Ψ_θ(X*)⟩ / n, whose derivative by θ is that of the error."""
        filters, knots, slopes = parts(θ, run)
        strengths = jnp.exp(θ.strengths[batch.task]) * batch.sigma
        # A row a channel: products of matrices and sums along rows, whose derivatives are fast, which those of a
        # convolution are not.
        count = forward.picture.size
        seen, moved = seen_by(filters, forward.picture), seen_by(filters, forward.sensitivity)
        moved *= jnp.repeat(strengths, count // len(strengths))[None]
        falls = slopes - jnp.pad(slopes[:, 1:], ((0, 0), (0, 1)))
        total = jnp.zeros((), jnp.float32)
        for j in range(knots.shape[1]):
            knot = knots[:, j : j + 1]
            total += jnp.sum(falls[:, j] * jnp.sum(jnp.clip(seen, -knot, knot) * moved, 1))
        return -total / count

    @jax.jit
    def settle(θ: Parameters, batch: Problems) -> _Forward:
        return solved(θ, batch, run.first_iterations)

    @jax.jit
    def step(θ: Parameters, state: Any, batch: Problems, rate: Array) -> tuple[Parameters, Any, _Forward, Array]:
        forward = solved(θ, batch, run.iterations)
        slope = jax.grad(slant)(θ, batch, forward)
        with jax.numpy_dtype_promotion("standard"):  # optax counts steps in int32 and multiplies by them
            updates, state = optimiser.update(slope, state, θ)
        θ = jax.tree.map(lambda value, update: value - rate * update, θ, updates)
        return θ, state, forward, jnp.mean(-10 * jnp.log10(forward.error + 1e-8))

    return settle, step


def train(
    out: Path,
    *,
    folder: Path | None,
    minutes: float | int,
    run: RidgeTraining | None = None,
    apertures: tuple[int, ...] = (1, 2),
    seed: int = 0,
    report: Any = print,
) -> RidgeRegulariser:
    """Trains for `minutes`, writes the prior to `out` and a card beside it.

    **Arguments:** `folder` of pictures; scikit-image's own where None. `run`: `RidgeTraining()` where None. `apertures`
    of the training problems. `report`: called with lines about the progress.

    **Errors:** `InputError` for no known aperture, an even side, a folder without large pictures, or if it runs away:
    weakly convex ones do after some thousand steps.
    """
    run = RidgeTraining() if run is None else run
    tasks = tuple(task for task in TASKS if task.aperture in apertures)
    if not tasks or run.side < 3 or run.side % 2 == 0:
        raise InputError(
            f"apertures are {apertures}, side {run.side}; some of 1, 2 and 4 are needed, and an odd side from 3."
        )
    begin = time.perf_counter()
    generator = np.random.default_rng(seed)
    found = pictures(folder, 2 * run.patch)
    θ = initial(generator, run, tasks)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())
    state = optimiser.init(θ)
    settle, step = make_step(optimiser, run)
    batches: list[Problems] = []
    scores: list[float] = []
    number = 0
    while True:
        passed = (time.perf_counter() - begin) / (60 * minutes)
        if passed >= 1:
            break
        place = number % run.batches
        if place == len(batches):
            fresh = problems(found, generator, tasks, place % len(tasks), run)
            kept = settle(θ, fresh)
            batches.append(fresh._replace(picture=kept.picture, sensitivity=kept.sensitivity))
        # The rate falls with the time that has passed, as the number of steps is not known beforehand.
        rate = jnp.asarray(run.rate * (0.03 + 0.97 * np.cos(np.pi / 2 * passed) ** 2), jnp.float32)
        θ, state, kept, score = step(θ, state, batches[place], rate)
        batches[place] = batches[place]._replace(picture=kept.picture, sensitivity=kept.sensitivity)
        if not np.isfinite(float(score)):
            raise InputError(f"Training ran away after {number} steps; {out.name} is of no use: train for less long.")
        scores.append(float(score))
        number += 1
        if number % run.batches == 0:
            recent = np.asarray(scores[-run.batches :])
            each = " ".join(f"{recent[n :: len(tasks)].mean():.2f}" for n in range(len(tasks)))
            strengths = np.exp(np.asarray(θ.strengths)).round(2)
            report(f"{number} steps, {60 * minutes * passed:.0f} s: {recent.mean():.2f} dB ({each}), λ/σ {strengths}")
            RidgeRegulariser(*parts(θ, run)).save(out)
    prior = finished(RidgeRegulariser(*parts(θ, run)), batches, run)
    prior.save(out)
    of = ", ".join(str(aperture) for aperture in sorted(set(apertures)))
    card = {
        "prior": "weakly convex ridge regulariser" if run.weakly else "convex ridge regulariser",
        "pictures": len(found),
        "patches": f"{run.batches * run.batch} of {run.patch}×{run.patch}, apertures {of}, noise {run.noise[0]} to "
        f"{run.noise[1]}",
        "filters": len(prior.filters),
        "steps": number,
        "minutes": minutes,
        "seed": seed,
        "mean_training_psnr": round(float(np.mean(scores[-run.batches :])), 2),
        "curvature": prior.curvature,
        "concavity": prior.concavity,
    }
    out.with_suffix(".json").write_text(json.dumps(card, indent=1, ensure_ascii=False) + "\n")
    return RidgeRegulariser.load(out)


def finished(prior: RidgeRegulariser, batches: list[Problems], run: RidgeTraining) -> RidgeRegulariser:
    """The prior without filters that have died out, weighted so that λ means what it does with total variation."""
    filters, knots, slopes = (np.asarray(values) for values in (prior.filters, prior.knots, prior.slopes))
    falls = slopes - np.pad(slopes[:, 1:], ((0, 0), (0, 1)))
    steepest = np.abs(np.cumsum(falls * knots, 1)).max(1) * np.linalg.norm(filters, axis=(1, 2))
    alive = steepest > run.alive * steepest.max()
    prior = RidgeRegulariser(filters[alive], knots[alive], slopes[alive])
    pictures = jnp.asarray(np.concatenate([batch.truth for batch in batches]))
    usual, own = (float(jnp.sum(jax.lax.map(of.value, pictures))) for of in (HuberTotalVariation(), prior))
    return prior.scaled(run.over_tv * usual / own)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("kind", choices=("convex", "weakly_convex"))
    parser.add_argument("--out", type=Path, required=True, help="the .npz file to write")
    parser.add_argument("--pictures", type=Path, help="a folder of pictures; scikit-image's own if not given")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--apertures", type=int, nargs="+", choices=(1, 2, 4), default=(1, 2))
    parser.add_argument("--side", type=int, default=RidgeTraining.side, help="of the filters, odd")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    train(
        given.out,
        folder=given.pictures,
        minutes=given.minutes,
        run=RidgeTraining(weakly=given.kind == "weakly_convex", side=given.side),
        apertures=tuple(given.apertures),
        seed=given.seed,
    )


if __name__ == "__main__":
    main()
