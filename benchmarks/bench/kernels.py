"""Kernels beside what memory allows: the parts of an iteration, whole iterations, and what happens to samples.

A kernel has to read each of its inputs once and to write each of its outputs once; an iterated one does so in every
pass (a dual step reads the picture and two fields, and writes two). These bytes and the operations are counted by
hand here, beside what XLA counts for the compiled program, which includes what is read twice and intermediate results.
The limit is a copy in the same run, of arrays that are together as large as all that the kernel touches: a working set
in the processor's cache is copied faster than one in memory. The kernel's bytes at the copy's bandwidth are the least
time; that over the time it takes is the share of the limit. Where a kernel calculates much for each byte, the limit is
the speed of arithmetic instead, which a product of matrices shows. The limit is whichever takes longer.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.bench.size import Size
from benchmarks.timing import in_turns, keeping_memory, program
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.motion.estimators.frames import drift
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.data_term import DataTerm, Stencil
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.sampling import PlacedSamples, accumulate, place
from scsr_opt.priors import HuberTotalVariation, RidgeRegulariser
from scsr_opt.solvers import ADMM, FISTA, CondatVu, Problem, Solver, lipschitz_bound

SCALE = 4
_ROUNDS = 11
_MATRIX_SIDE = 1024
# Pictures that a recording is cut into for its motion.
_PICTURES = 25
_VELOCITY = (0.02, 0.05)
"""Sensor pixels per frame, down and right."""


class Kernel(NamedTuple):
    """**Fields:** `call(*arguments)`; `moved`: bytes that have to move at least, and `operations`, both by hand (None:
    not counted); `touched`: bytes of all arrays that it works on."""

    call: Callable[..., Any]
    arguments: tuple[Any, ...]
    moved: int
    operations: int | None
    touched: int


def problem_of(shape: tuple[int, int]) -> tuple[Problem, Float[Array, "H W"]]:
    """A problem with Huber-TV and a first picture, of numbers drawn at random: time depends on how many there are."""
    planes, target, image = jax.random.split(jax.random.key(0), 3)
    data = DataTerm(
        Stencil(jax.random.uniform(planes, (5, *shape)) / 9), jax.random.uniform(target, shape), jnp.float32(1),
        Aperture(shape, SCALE), None,
    )  # fmt: skip
    return Problem(data, HuberTotalVariation(), jnp.float32(1e-3)), jax.random.uniform(image, shape)


@eqx.filter_jit
def iteration(solver: Solver, problem: Problem, state: Any) -> Any:
    """One iteration of a solver, in one program."""
    return solver.step(problem, state)


@eqx.filter_jit
def first_state(solver: Solver, problem: Problem, image: Float[Array, "H W"]) -> Any:
    return solver.init(problem, image)


def placed_samples(frames: int, height: int, width: int, scale: int) -> PlacedSamples:
    """Spike intervals of random light that moves, at their places on the picture."""
    rng = np.random.default_rng(0)
    rate, phase = rng.uniform(0.1, 0.5, (height, width)), rng.uniform(size=(height, width))
    gathered = np.floor(phase + rate * np.arange(frames + 1)[:, None, None])
    samples = spike_intervals(np.diff(gathered, axis=0).astype(np.uint8))
    motion = Motion.of_velocity(np.broadcast_to(np.array(_VELOCITY)[:, None, None], (2, height, width)))
    path = trajectory_of(motion, key=frames // 2, start=0, stop=frames)
    on_device = jax.tree.map(jnp.asarray, samples.padded())
    return place(on_device, path, scale=scale, shape=(scale * height, scale * width))


def kernels(shape: tuple[int, int], accumulated: tuple[int, int, int, int]) -> dict[str, Kernel]:
    """The parts of an iteration, iterations, and what happens to samples. Bytes are multiples of a picture in float32,
    operations of its pixels, unless samples are counted."""
    problem, image = problem_of(shape)
    data, prior, λ = problem.data, HuberTotalVariation(), problem.strength
    fista, dual, steps = FISTA(), prior.initial_state(image), prior.iterations
    pixels, one = image.size, image.nbytes
    # Sliding sums of s rows, then of s columns, then 1/s²; nine products and eight sums; f: two products, two sums.
    slide, stencil = 2 * (SCALE - 1) + 1, 17
    slope = 2 * slide + stencil + 5
    # A dual step: K*p 3, the picture 2, over bound 1, K 2, p + length·z 4, shorter 2, unit ball 7. Last the picture.
    dual_steps, passes = 21 * steps + 5, 5 * steps + 4
    # Each filter: forward and back a product and a sum for each of its pixels; clipping 2, slope 1, value 4.
    ridge = RidgeRegulariser.load()
    seen = ridge.filters.shape[0] * (4 * ridge.filters[0].size + 7)
    # Leaf by leaf the program makes 13 operations more of a dual step, in which it calculates lengths twice.
    # FISTA: R (reads 2, writes 1), the proximal step, f and ∇f, λΨ, residual and restart (read 3: X, the one before and
    # the point ahead), extrapolation of picture and gradient (reads 6, writes 2). Operations: R 2, λΨ 14 with the sums,
    # extrapolation 12, restart 4.
    fista_passes = 3 + passes + 8 + 3 + 8
    found = {
        "stencil M u": Kernel(lambda m, u: m(u), (data.stencil, image), 7 * one, stencil * pixels, 7 * one),
        "aperture": Kernel(lambda b, x: b(x), (data.aperture, image), 2 * one, slide * pixels, 2 * one),
        "aperture, adjoint": Kernel(
            lambda b, x: b.adjoint(x), (data.aperture, image), 2 * one, slide * pixels, 2 * one
        ),
        "f and its gradient": Kernel(
            lambda f, x: f.value_and_gradient(x), (data, image), 8 * one, slope * pixels, 8 * one
        ),
        "norm bound": Kernel(
            lambda f: lipschitz_bound(f), (data,), 28 * one, 4 * (2 * slide + stencil) * pixels, 7 * one
        ),
        "Huber-TV": Kernel(lambda x: prior.value(x), (image,), one, 10 * pixels, one),
        f"its proximal step ({steps} dual steps)": Kernel(
            lambda x, p: prior.prox(x, 0.1 * λ, p), (image, dual), passes * one, dual_steps * pixels, 6 * one,
        ),
        "ridge regulariser and its gradient": Kernel(
            lambda r, x: r.value_and_gradient(x), (ridge, image), 2 * one, seen * pixels, 2 * one
        ),
        "FISTA, an iteration": Kernel(
            iteration, (fista, problem, first_state(fista, problem, image)), fista_passes * one,
            (2 + dual_steps + slope + 14 + 16) * pixels, 19 * one,
        ),
    }  # fmt: skip
    # CondatVu reads M, c and the relaxed point (X, ∇f, p twice, K*p) and writes its state of nine. Operations: the
    # picture 4, f and ∇f, the mirrored picture 2, K 2, the dual step 15, K*p 3, five relaxed pictures 15, KX and λΨ 15,
    # the residual 14.
    found["CondatVu, an iteration"] = Kernel(
        iteration, (CondatVu(), problem, first_state(CondatVu(), problem, image)), (6 + 5 + 9) * one,
        (slope + 70) * pixels, (6 + 5 + 9) * one,
    )  # fmt: skip
    # ADMM reads M, c and its state of nine and writes that; each of three systems reads M and a picture and writes one.
    found["ADMM, an iteration"] = Kernel(
        iteration, (ADMM(), problem, first_state(ADMM(), problem, image)), (6 + 9 + 9 + 3 * 7) * one, None,
        (6 + 9 + 9) * one,
    )  # fmt: skip
    placed = placed_samples(*accumulated)
    count, picture = placed.value.size, 4 * placed.shape[0] * placed.shape[1]
    # A sample: index, two fractions, value, weight, number of positions. Weights of four taps 6, times ω 4, four sums
    # into c 8, ten into M. To read: no value and weight, but a result.
    found["accumulate M and c"] = Kernel(
        lambda p: accumulate(p), (placed,), 24 * count + 6 * picture, 38 * count, 24 * count + 6 * picture
    )
    found["read U at samples"] = Kernel(
        lambda p, u: p.read(u), (placed, jnp.ones(placed.shape)), 20 * count + picture, 9 * count, 20 * count + picture
    )
    term = accumulate(placed)
    found["correct c for exposures"] = Kernel(
        lambda t, p, u: with_exposure(t, p, u), (term, placed, jnp.ones(placed.shape)), 44 * count + 11 * picture, None,
        20 * count + 9 * picture,
    )  # fmt: skip
    found["drift along a motion"] = _drift(accumulated[1], accumulated[2])
    return found


def _drift(height: int, width: int) -> Kernel:
    """The inner loop of every motion estimate: a regression over the pictures along a motion."""
    pictures = jnp.asarray(np.random.default_rng(0).random((_PICTURES, height, width)), jnp.float32)
    after = jnp.linspace(-50.0, 50.0, _PICTURES)
    motion = (jnp.full((2, height, width), 0.1), jnp.zeros((2, height, width)))
    one = 4 * height * width
    # Reads the pictures, the key picture and the motion, writes eleven sums. Of a pixel in a picture: position 8,
    # bilinear 9, inside 4, difference and weight 2, sums 18.
    return Kernel(
        lambda *a: drift(*a), (pictures, after, jnp.ones(_PICTURES), motion), (_PICTURES + 5 + 11) * one,
        41 * _PICTURES * height * width, (_PICTURES + 5 + 11) * one,
    )  # fmt: skip


def _copies(sizes: set[int]) -> dict[int, Callable[[], Any]]:
    """Calls that read and write an array once, in place, by its number of bytes: memory that is new to the
    process would have to be cleared by the system first, and that takes longer than to write it."""

    def copy(size: int) -> Callable[[], Any]:
        copied = jax.jit(lambda x: x + 1, donate_argnums=0)
        held = [jnp.zeros(max(1, size // 4))]

        def call() -> Any:
            held[0] = copied(held[0])
            return held[0]

        return call

    return {size: copy(size) for size in sizes}


def measure(size: Size, seed: int, advance: Callable[[int], None]) -> dict[str, Any]:
    """Ready for JSON: `peak_operations` (per second), `copies` (bytes, bytes per second), and a row for each kernel
    with its counts, the `seconds` of each round, `bandwidth` (bytes per second) and the `share` of the limit."""
    rows: list[dict[str, Any]] = []
    calls: dict[Any, Callable[[], Any]] = {}
    for name, kernel in kernels(size.picture, size.accumulated).items():
        compiled = program(kernel.call, *kernel.arguments)
        calls[name] = compiled.call
        rows.append(
            {
                "kernel": name, "moved": kernel.moved, "operations": kernel.operations, "touched": kernel.touched,
                "xla_moved": compiled.moved, "xla_operations": compiled.flops, "fusions": compiled.fusions,
            }
        )  # fmt: skip
        advance(1)
    matrix = jnp.ones((_MATRIX_SIDE, _MATRIX_SIDE)) / _MATRIX_SIDE
    product = jax.jit(lambda a: a @ a)
    calls |= _copies({row["touched"] for row in rows}) | {"product": lambda: product(matrix)}
    with keeping_memory():
        for call in calls.values():
            jax.block_until_ready(call())
        taken = in_turns(calls, _ROUNDS)
    peak = 2 * _MATRIX_SIDE**3 / float(np.median(taken["product"]))
    for row in rows:
        row["seconds"] = taken[row["kernel"]]
        row["bandwidth"] = 2 * row["touched"] / float(np.median(taken[row["touched"]]))
        least = max(row["moved"] / row["bandwidth"], (row["operations"] or 0) / peak)
        row["share"] = least / float(np.median(row["seconds"]))
    return {
        "shape": list(size.picture),
        "accumulated": list(size.accumulated),
        "peak_operations": peak,
        "copies": sorted([row["touched"], row["bandwidth"]] for row in rows),
        "kernels": rows,
    }
