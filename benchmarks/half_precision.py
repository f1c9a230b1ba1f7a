"""What does it gain to store the planes of M in half the bits, and when does it cost instead?

    python -m benchmarks.half_precision [--shape 1000 1600] [--taps 5 9 13 15 16 17 25]

A stencil of so many taps whose weights vary over the picture, as M is one of nine (`scsr_opt.operators.Stencil`): its
planes in float32, in bfloat16 in one array, and in bfloat16 in an array each. Prints milliseconds, and megabytes of the
program's own temporary arrays. The arithmetic is in float32 each time.
"""

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.bench_timing import in_turns

_REACH = 2  # of the largest stencil, pixels
_ROUNDS = 11
_MILLI, _MEGA = 1e3, 1e6


def offsets(taps: int) -> list[tuple[int, int]]:
    """The nearest neighbours of a pixel, itself first."""
    reach = range(-_REACH, _REACH + 1)
    return sorted(((i, j) for i in reach for j in reach), key=lambda at: at[0] ** 2 + at[1] ** 2)[:taps]


def applied(planes: Float[Array, "taps H W"] | Sequence[Array], image: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Σ_k planes_k · image moved by the k-th offset; zero outside."""
    (height, width), around = image.shape, jnp.pad(image, _REACH)
    total = jnp.zeros_like(image)
    for plane, (i, j) in zip(planes, offsets(len(planes)), strict=True):
        corner = (_REACH + i, _REACH + j)
        moved = jax.lax.slice(around, corner, (corner[0] + height, corner[1] + width))
        total = total + plane.astype(jnp.float32) * moved
    return total


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shape", type=int, nargs=2, default=[1000, 1600], metavar=("H", "W"))
    parser.add_argument("--taps", type=int, nargs="+", default=[5, 9, 13, 15, 16, 17, 25])
    chosen = parser.parse_args()
    rng = np.random.default_rng(0)
    image = jnp.asarray(rng.random(chosen.shape), jnp.float32)
    kinds = ("float32", "bfloat16, one array", "bfloat16, apart")
    print("| taps | " + " | ".join(f"{kind}, ms | MB" for kind in kinds) + " |\n|---|" + "---|" * 2 * len(kinds))
    for taps in chosen.taps:
        planes = jnp.asarray(rng.random((taps, *chosen.shape)), jnp.float32)
        half = planes.astype(jnp.bfloat16)
        calls: dict[str, Callable[[], Any]] = {}
        temporary: dict[str, float] = {}
        for kind, given in zip(kinds, (planes, half, [jnp.array(plane) for plane in half]), strict=True):
            program = jax.jit(applied).lower(given, image).compile()
            calls[kind] = lambda program=program, given=given: program(given, image)
            sizes = program.memory_analysis()
            assert sizes is not None  # told of every program that is compiled for a CPU
            temporary[kind] = sizes.temp_size_in_bytes / _MEGA
        for call in calls.values():
            jax.block_until_ready(call())
        taken = in_turns(calls, _ROUNDS)
        cells = [f"{_MILLI * np.median(taken[kind]):.1f} | {temporary[kind]:.0f}" for kind in kinds]
        print(f"| {taps} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
