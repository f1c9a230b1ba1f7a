"""Trains the `GainNetwork` on still scenes, simulated with and without a fixed pattern.

A patch of a picture is recorded by a sensor of random gains (`scsr_opt.camera.simulator`), seen through an aperture of
1 to 4 of its pixels a side, by day, in less light and in dim light. The network sees what `rates_at_rest` makes of the
spikes, and the mean square of its error in ln g is made small.

    python -m learned.training.gain --out gain.npz --pictures FOLDER --steps 10000
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from learned.training.ridge import pictures
from scsr_opt.calibration.gain_network import GainNetwork, rates_at_rest
from scsr_opt.camera.scenes import Static
from scsr_opt.camera.simulator import Sensor, simulate

_PATCH, _BATCH = 56, 12
# Patches that are kept to draw batches from, and how many of them are made anew before each step.
_KEPT, _FRESH = 3000, 3
# So many have no fixed pattern; the others' gains spread by something between.
_WITHOUT, _SPREAD = 0.45, (0.015, 0.09)
_SCALES = (1, 2, 2, 3, 4)
_FRAMES = (51, 101, 101, 101, 201)
_SENSORS = (*[Sensor()] * 4, Sensor(white_rate=0.3, photons=100.0), Sensor(white_rate=0.1, photons=25.0))
_RATE, _WARM_UP, _LAST = 1e-3, 100, 0.02
# Share of the weights of each step in the running mean that is kept in the end.
_MEAN = 0.005
_REPORT = 250
# Errors are of the order of 0.03: so that the loss is about 1.
_UNIT = 1e3
# What the report is about: a share of the patches, which is never trained on.
_HELD_OUT = 48

Patches = tuple[Float[np.ndarray, "_ P P"], Float[np.ndarray, "_ P P"], Float[np.ndarray, "_ P P"]]
"""Rates, relative noise and ln g."""


def patch(found: list[np.ndarray], generator: np.random.Generator, spread: float | None = None) -> Patches:
    """One patch of one of the pictures `found` (grey, intensity); gains of this spread, or of a random one."""
    scale = int(generator.choice(_SCALES))
    side = scale * _PATCH
    fitting = [picture for picture in found if min(picture.shape) >= side] or found
    picture = fitting[generator.integers(len(fitting))]
    scale = min(scale, min(picture.shape) // _PATCH)
    side = scale * _PATCH
    row, column = (generator.integers(length - side + 1) for length in picture.shape)
    part = np.rot90(picture[row : row + side, column : column + side], int(generator.integers(4)))
    part = part[:, ::-1] if generator.integers(2) else part
    if generator.random() < 0.3:
        part = part * generator.uniform(0.3, 1.0)
    if spread is None:
        spread = 0.0 if generator.random() < _WITHOUT else generator.uniform(*_SPREAD)
    sensor = _SENSORS[generator.integers(len(_SENSORS))]
    sensor = Sensor(sensor.white_rate, sensor.photons, fixed_pattern=spread)
    made = simulate(
        Static(part),
        scale=scale,
        frames=int(generator.choice(_FRAMES)),
        sensor=sensor,
        seed=int(generator.integers(2**31)),
    )
    rate, noise = rates_at_rest(made.spikes, white_rate=sensor.white_rate)
    return rate[None], noise[None].astype(np.float32), np.log(np.maximum(made.gain, 0.1))[None].astype(np.float32)


def kept_out(found: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The pictures to train on, and the last sixteenth of all, one at least, which is kept to test with."""
    last = max(1, len(found) // 16)
    return found[:-last] or found, found[-last:]


def _joined(patches: list[Patches]) -> Patches:
    rate, noise, gain = (np.concatenate(of) for of in zip(*patches, strict=True))
    return rate, noise, gain


def make_step(optimiser: optax.GradientTransformation) -> Callable[..., Any]:
    """The compiled training step: (network, its running mean, optimiser's state, batch, rate) → the first three, and
    the loss."""

    def loss(network: GainNetwork, rate: Array, noise: Array, gain: Array) -> Array:
        return _UNIT * jnp.mean((jax.vmap(network)(rate, noise) - gain) ** 2)

    @eqx.filter_jit
    def step(network, mean, state, batch, rate):
        with jax.numpy_dtype_promotion("standard"):  # optax counts steps in int32 and multiplies by them
            value, slope = eqx.filter_value_and_grad(loss)(network, *batch)
            updates, state = optimiser.update(slope, state, network)
        network = eqx.apply_updates(network, jax.tree.map(lambda u: -rate * u, updates))
        mean = jax.tree.map(lambda m, n: m + _MEAN * (n - m) if eqx.is_array(m) else m, mean, network)
        return network, mean, state, value

    return step


def train(
    out: Path,
    *,
    folder: Path | None,
    steps: int,
    channels: int = 32,
    layers: int = 8,
    seed: int = 0,
    report: Callable[[str], Any] = print,
) -> GainNetwork:
    """Trains for so many steps, writes the network to `out` and a card beside it.

    **Arguments:** `folder` of pictures; scikit-image's own where None. `channels`, `layers`: see `GainNetwork`.
    `report`: told of the progress, in words.

    **Errors:** `InputError` for a folder without large pictures.
    """
    begin = time.perf_counter()
    generator = np.random.default_rng(seed)
    found = pictures(folder)
    network = mean = GainNetwork(channels, layers, key=jax.random.key(seed))
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())
    state = optimiser.init(eqx.filter(network, eqx.is_array))
    step = make_step(optimiser)
    found, held_out = kept_out(found)
    tests = {s: _joined([patch(held_out, generator, s) for _ in range(_HELD_OUT)]) for s in (0.0, 0.05)}
    kept = _joined([patch(found, generator) for _ in range(_BATCH)])
    losses: list[float] = []
    for number in range(1, steps + 1):
        fresh = _joined([patch(found, generator) for _ in range(_FRESH)])
        if len(kept[0]) < _KEPT:
            kept = _joined([kept, fresh])
        else:
            at = generator.integers(_KEPT, size=_FRESH)
            for values, new in zip(kept, fresh, strict=True):
                values[at] = new
        chosen = generator.integers(len(kept[0]), size=_BATCH)
        batch = tuple(jnp.asarray(values[chosen]) for values in kept)
        falling = _LAST + (1 - _LAST) * np.cos(np.pi / 2 * (number - 1) / steps) ** 2
        rate = _RATE * min(1, number / _WARM_UP) * falling
        network, mean, state, loss = step(network, mean, state, batch, jnp.float32(rate))
        losses.append(float(loss))
        if number % _REPORT == 0:
            missed = {s: _missed(mean, test) for s, test in tests.items()}
            told = ", ".join(f"{error:.4f} of gains spread by {s}" for s, error in missed.items())
            recent = np.mean(losses[-_REPORT:])
            report(f"{number} steps, {time.perf_counter() - begin:.0f} s: loss {recent:.4f}; missed {told}")
            mean.save(out)
    mean.save(out)
    card = {
        "network": f"gains at rest, {layers} convolutions of 3×3, {channels} channels",
        "parameters": sum(x.size for x in jax.tree.leaves(eqx.filter(mean, eqx.is_array))),
        "pictures": len(found),
        "steps": steps,
        "seed": seed,
        "missed": {str(s): round(_missed(mean, test), 4) for s, test in tests.items()},
    }
    out.with_suffix(".json").write_text(json.dumps(card, indent=1, ensure_ascii=False) + "\n")
    return mean


def _missed(network: GainNetwork, test: Patches) -> float:
    """Root mean square error of ln g."""
    rate, noise, gain = (jnp.asarray(values) for values in test)
    return float(jnp.sqrt(jnp.mean((_together(network, rate, noise) - gain) ** 2)))


@eqx.filter_jit
def _together(network: GainNetwork, rate: Float[Array, "n h w"], noise: Float[Array, "n h w"]) -> Float[Array, "n h w"]:
    return jax.vmap(network)(rate, noise)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True, help="the .npz file to write")
    parser.add_argument("--pictures", type=Path, help="a folder of pictures; scikit-image's own if not given")
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--channels", type=int, default=32)
    parser.add_argument("--layers", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    train(
        given.out,
        folder=given.pictures,
        steps=given.steps,
        channels=given.channels,
        layers=given.layers,
        seed=given.seed,
    )


if __name__ == "__main__":
    main()
