"""Is an iteration faster where a picture is stored as its s² phases, each a picture of the sensor's size?

    python -m benchmarks.polyphase [--shape 1000 1600] [--scale 4]

M u (`scsr_opt.operators.Stencil`) on the picture as it is, and on its phases, an array (s, s, H/s, W/s) whose [i, j]
holds the pixels of rows i, i + s, … and columns j, j + s, …: each tap then reads another phase, or its own moved by a
pixel of the sensor. Both give the same numbers. Prints milliseconds, medians of rounds in turns.
"""

import argparse
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.bench_timing import in_turns, keeping_memory
from scsr_opt.operators.data_term import Stencil

_ROUNDS = 15
_NEIGHBOURS = ((0, 1), (1, -1), (1, 0), (1, 1))


def phases(image: Float[Array, "*n H W"], scale: int) -> Float[Array, "*n s s h w"]:
    """The phases of a picture, or of several."""
    *more, height, width = image.shape
    cut = image.reshape(*more, height // scale, scale, width // scale, scale)
    return jnp.moveaxis(cut, (-3, -1), (-4, -3))


def _moved(image: Float[Array, "s s h w"], down: int, right: int) -> Float[Array, "s s h w"]:
    """[i, j] holds what lies `down` rows and `right` columns further in the picture; zero outside."""
    scale = len(image)

    def phase(i: int, j: int) -> Array:
        (row, i), (column, j) = divmod(i + down, scale), divmod(j + right, scale)
        around = jnp.pad(image[i, j], 1)
        return jax.lax.slice(around, (1 + row, 1 + column), (around.shape[0] - 1 + row, around.shape[1] - 1 + column))

    return jnp.stack([jnp.stack([phase(i, j) for j in range(scale)]) for i in range(scale)])


def by_phases(planes: Float[Array, "5 s s h w"], u: Float[Array, "s s h w"]) -> Float[Array, "s s h w"]:
    """M u."""
    result = planes[0] * u
    for plane, (down, right) in zip(planes[1:], _NEIGHBOURS, strict=True):
        result = result + plane * _moved(u, down, right) + _moved(plane, -down, -right) * _moved(u, -down, -right)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shape", type=int, nargs=2, default=[1000, 1600], metavar=("H", "W"))
    parser.add_argument("--scale", type=int, default=4)
    chosen = parser.parse_args()
    rng = np.random.default_rng(0)
    planes, u = (jnp.asarray(rng.random(size), jnp.float32) for size in ((5, *chosen.shape), tuple(chosen.shape)))
    whole, parts = jax.jit(lambda planes, u: Stencil(planes)(u)), jax.jit(by_phases)
    cut = phases(planes, chosen.scale), phases(u, chosen.scale)
    np.testing.assert_allclose(parts(*cut), phases(whole(planes, u), chosen.scale), rtol=1e-5)
    calls = {"as it is": functools.partial(whole, planes, u), "by phases": functools.partial(parts, *cut)}
    with keeping_memory():
        taken = in_turns(calls, _ROUNDS)
    for name, seconds in taken.items():
        print(f"{name}: {1e3 * np.median(seconds):.1f} ms")


if __name__ == "__main__":
    main()
