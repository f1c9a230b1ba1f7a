"""What solvers and priors are compared on for docs/choosing.md: recordings of panning stills, as data terms."""

import time
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from skimage import data

from scsr_opt import reconstruct
from scsr_opt.camera.pictures import as_intensity
from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.camera.scenes import Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.motion.trajectory import trajectory_of
from scsr_opt.motion.validation import given
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.sampling import accumulate, place
from scsr_opt.solvers import Problem, Solver, run

FRAMES, VELOCITY, POSITIONS = 101, (0.07, -0.12), 3
LIGHTS = {"day": Sensor(white_rate=0.6, photons=1000.0), "dim": Sensor(white_rate=0.1, photons=25.0)}


class Size(NamedTuple):
    """How much is done: `sensor` and `side` in pixels (solvers' sensor, priors' picture), the `pictures` of the priors
    (the first is the solvers'), `conditions` (scale, light), `exact` iterations for the minimum, and in how many
    `seconds` a solver has to reach a gap."""

    sensor: int
    side: int
    pictures: tuple[str, ...]
    conditions: tuple[tuple[int, str], ...]
    exact: int
    seconds: float


FULL = Size(100, 144, ("camera", "brick", "moon"), ((2, "day"), (2, "dim"), (4, "day")), 600, 1.5)
QUICK = Size(40, 72, ("camera",), ((2, "day"),), 200, 0.5)


class Case(NamedTuple):
    """A recording as a data term, `start` and `strength` as `reconstruct` would take them, and the truth."""

    scale: int
    term: DataTerm
    start: Float[Array, "H W"]
    strength: float
    truth: Float[np.ndarray, "H W"]


def case_of(name: str, *, scale: int, sensor: int, light: str) -> Case:
    """A part of a picture that `sensor` pixels see, above its middle, panning."""
    picture, size = as_intensity(getattr(data, name)()), sensor * scale
    top, left = (picture.shape[0] - size) // 4, (picture.shape[1] - size) // 2
    scene = Translation(
        picture[top : top + size, left : left + size], (VELOCITY[0] * scale, VELOCITY[1] * scale), key=FRAMES // 2
    )
    made = simulate(scene, scale=scale, frames=FRAMES, sensor=LIGHTS[light])
    rate, key = made.white_rate, FRAMES // 2
    samples = spike_intervals(made.spikes, white_rate=rate)
    samples = eqx.tree_at(lambda s: s.weight, samples, samples.weight / np.float32(FRAMES))
    path = trajectory_of(given(VELOCITY, sensor, sensor), key=key, start=0, stop=FRAMES)
    padded = jax.tree.map(jnp.asarray, samples.padded())
    placed = place(padded, path, scale=scale, finest=POSITIONS, shape=(size, size))
    # Corrected for the exposures once, at a picture that all share: from then on it is one data term.
    found = reconstruct(made.spikes, scale=scale, key=key, white_rate=rate, velocity=VELOCITY)
    term = with_exposure(accumulate(placed), placed, jnp.asarray(found.image))
    seen = jnp.asarray(interval_rates(made.spikes, np.array([key - 10.0, key + 10.0]), white_rate=rate)[0])
    start = jax.image.resize(seen, (size, size), "linear")
    return Case(scale, term, start, found.stats["strength"], made.truth(key))


def seconds_of(solver: Solver, problem: Problem, start: Array, iterations: int) -> float:
    begin = time.perf_counter()
    run(replace(solver, iterations=iterations), problem, start, tolerance=0.0)
    return time.perf_counter() - begin
