"""How long do the parts of an iteration take, beside what memory allows?

    python -m benchmarks.kernels [--height 1000] [--width 1600] [--scale 4]

For each kernel: milliseconds (fastest and median of 15), the bytes that it has to move at least (each input read once,
each output written once), and the bandwidth that this comes to beside that of a plain copy in the same run.
"""

import argparse
import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.sampling import DataTerm, Stencil
from scsr_opt.priors.huber_total_variation import HuberTotalVariation


def milliseconds(function: Callable, *arguments) -> list[float]:
    compiled = eqx.filter_jit(function)
    jax.block_until_ready(compiled(*arguments))
    taken = []
    for _ in range(15):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        taken.append((time.perf_counter() - begin) * 1e3)
    return taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=int, default=1000)
    parser.add_argument("--width", type=int, default=1600)
    parser.add_argument("--scale", type=int, default=4)
    arguments = parser.parse_args()
    shape = (arguments.height, arguments.width)
    keys = jax.random.split(jax.random.key(0), 3)
    picture = jax.random.uniform(keys[0], shape)
    stencil = Stencil(jax.random.uniform(keys[1], (5, *shape)))
    aperture = Aperture(shape, arguments.scale)
    data = DataTerm(stencil, jax.random.uniform(keys[2], shape), jnp.float32(1), aperture, None)
    prior = HuberTotalVariation()
    state = prior.initial_state(picture)
    strength = jnp.float32(0.01)
    one = picture.nbytes
    kernels = {
        "copy": (lambda x: x + 1, (picture,), 2 * one),
        "stencil M u": (lambda m, u: m(u), (stencil, picture), 7 * one),
        "aperture": (lambda b, x: b(x), (aperture, picture), 2 * one),
        "aperture, adjoint": (lambda b, x: b.adjoint(x), (aperture, picture), 2 * one),
        "f and its gradient": (lambda f, x: f.value_and_gradient(x), (data, picture), 8 * one),
        "Huber-TV": (lambda p, x: p.value(x), (prior, picture), one),
        # Each dual step reads the picture and two dual fields, twice (momentum), and writes two.
        f"its proximal step ({prior.iterations})": (
            lambda p, x, s: p.prox(x, strength, s), (prior, picture, state), prior.iterations * 9 * one,
        ),
    }  # fmt: skip
    print(f"{arguments.height}x{arguments.width}, float32, {jax.devices()[0].device_kind}")
    for name, (function, inputs, moved) in kernels.items():
        taken = milliseconds(function, *inputs)
        rate = moved / min(taken) / 1e6
        print(
            f"{name:24s} {min(taken):8.2f} ms  median {np.median(taken):8.2f}  {moved / 1e6:6.0f} MB  {rate:6.1f} GB/s"
        )


if __name__ == "__main__":
    main()
