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
from dataclasses import dataclass
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


@dataclass(frozen=True)
class GainTraining:
    """Numbers of a training run.

    **Fields:**
    - `channels`, `layers`: see `GainNetwork`.
    - `patch`: side of a patch, sensor pixels; `batch`: patches of a step.
    - `kept`: patches to draw batches from; `fresh`: of them, made anew before each step.
    - `without`: share of the patches without a fixed pattern; `spread`: range of the spread of the others' gains.
    - `scales`, `frames`, `sensors`: to draw from.
    - `rate`: of learning, reached after `warm_up` steps, and falling to the share `last` of it.
    - `mean`: share of each step's weights in their running mean, which is kept in the end.
    - `unit`: factor that makes the loss about 1, as errors are of the order of 0.03.
    - `report_every`: steps; `held_out`: patches, never trained on, whose error is reported.
    """

    channels: int = 32
    layers: int = 8
    patch: int = 56
    batch: int = 12
    kept: int = 3000
    fresh: int = 3
    without: float = 0.45
    spread: tuple[float, float] = (0.015, 0.09)
    scales: tuple[int, ...] = (1, 2, 2, 3, 4)
    frames: tuple[int, ...] = (51, 101, 101, 101, 201)
    sensors: tuple[Sensor, ...] = (*[Sensor()] * 4, Sensor(0.3, 100.0), Sensor(0.1, 25.0))  # noqa: RUF009 (frozen)
    rate: float = 1e-3
    warm_up: int = 100
    last: float = 0.02
    mean: float = 0.005
    unit: float = 1e3
    report_every: int = 250
    held_out: int = 48


Patches = tuple[Float[np.ndarray, "_ P P"], Float[np.ndarray, "_ P P"], Float[np.ndarray, "_ P P"]]
"""Rates, relative noise and ln g."""


def patch(
    found: list[np.ndarray], generator: np.random.Generator, run: GainTraining, spread: float | None = None
) -> Patches:
    """One patch of one of the pictures `found` (grey, intensity); gains of this spread, or of a random one."""
    scale = int(generator.choice(run.scales))
    side = scale * run.patch
    fitting = [picture for picture in found if min(picture.shape) >= side] or found
    picture = fitting[generator.integers(len(fitting))]
    scale = min(scale, min(picture.shape) // run.patch)
    side = scale * run.patch
    row, column = (generator.integers(length - side + 1) for length in picture.shape)
    part = np.rot90(picture[row : row + side, column : column + side], int(generator.integers(4)))
    part = part[:, ::-1] if generator.integers(2) else part
    if generator.random() < 0.3:
        part = part * generator.uniform(0.3, 1.0)
    if spread is None:
        spread = 0.0 if generator.random() < run.without else generator.uniform(*run.spread)
    sensor = run.sensors[generator.integers(len(run.sensors))]
    sensor = Sensor(sensor.white_rate, sensor.photons, fixed_pattern=spread)
    made = simulate(
        Static(part),
        scale=scale,
        frames=int(generator.choice(run.frames)),
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


def make_step(optimiser: optax.GradientTransformation, run: GainTraining) -> Callable[..., Any]:
    """The compiled training step: (network, its running mean, optimiser's state, batch, rate) → the first three, and
    the loss."""

    def loss(network: GainNetwork, rate: Array, noise: Array, gain: Array) -> Array:
        return run.unit * jnp.mean((jax.vmap(network)(rate, noise) - gain) ** 2)

    @eqx.filter_jit
    def step(network, mean, state, batch, rate):
        with jax.numpy_dtype_promotion("standard"):  # optax counts steps in int32 and multiplies by them
            value, slope = eqx.filter_value_and_grad(loss)(network, *batch)
            updates, state = optimiser.update(slope, state, network)
        network = eqx.apply_updates(network, jax.tree.map(lambda u: -rate * u, updates))
        mean = jax.tree.map(lambda m, n: m + run.mean * (n - m) if eqx.is_array(m) else m, mean, network)
        return network, mean, state, value

    return step


def train(
    out: Path,
    *,
    folder: Path | None,
    steps: int,
    run: GainTraining | None = None,
    seed: int = 0,
    report: Callable[[str], Any] = print,
) -> GainNetwork:
    """Trains for `steps`, writes the network to `out` and a card beside it.

    **Arguments:** `folder` of pictures; scikit-image's own where None. `run`: `GainTraining()` where None. `report`:
    called with lines about the progress.

    **Errors:** `InputError` for a folder without large pictures.
    """
    begin = time.perf_counter()
    run = GainTraining() if run is None else run
    generator = np.random.default_rng(seed)
    found = pictures(folder)
    network = mean = GainNetwork(run.channels, run.layers, key=jax.random.key(seed))
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())
    state = optimiser.init(eqx.filter(network, eqx.is_array))
    step = make_step(optimiser, run)
    found, held_out = kept_out(found)
    tests = {s: _joined([patch(held_out, generator, run, s) for _ in range(run.held_out)]) for s in (0.0, 0.05)}
    kept = _joined([patch(found, generator, run) for _ in range(run.batch)])
    losses: list[float] = []
    for number in range(1, steps + 1):
        fresh = _joined([patch(found, generator, run) for _ in range(run.fresh)])
        if len(kept[0]) < run.kept:
            kept = _joined([kept, fresh])
        else:
            at = generator.integers(run.kept, size=run.fresh)
            for values, new in zip(kept, fresh, strict=True):
                values[at] = new
        chosen = generator.integers(len(kept[0]), size=run.batch)
        batch = tuple(jnp.asarray(values[chosen]) for values in kept)
        falling = run.last + (1 - run.last) * np.cos(np.pi / 2 * (number - 1) / steps) ** 2
        rate = run.rate * min(1, number / run.warm_up) * falling
        network, mean, state, loss = step(network, mean, state, batch, jnp.float32(rate))
        losses.append(float(loss))
        if number % run.report_every == 0:
            missed = {s: _missed(mean, test) for s, test in tests.items()}
            errors = ", ".join(f"{error:.4f} of gains spread by {s}" for s, error in missed.items())
            recent = np.mean(losses[-run.report_every :])
            report(f"{number} steps, {time.perf_counter() - begin:.0f} s: loss {recent:.4f}; missed {errors}")
            mean.save(out)
    mean.save(out)
    card = {
        "network": f"gains at rest, {run.layers} convolutions of 3×3, {run.channels} channels",
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
    parser.add_argument("--channels", type=int, default=GainTraining.channels)
    parser.add_argument("--layers", type=int, default=GainTraining.layers)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    train(
        given.out,
        folder=given.pictures,
        steps=given.steps,
        run=GainTraining(channels=given.channels, layers=given.layers),
        seed=given.seed,
    )


if __name__ == "__main__":
    main()
