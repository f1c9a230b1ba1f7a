"""Does an iteration cost more when more frames went in?

    python -m benchmarks.frames [--sensor 400x250] [--scale 4] [--frames 101 1001]

One recording of a moving scene is accumulated from few and from many frames; then the two solvers take turns,
iteration by iteration, so that whatever else the machine does hits both alike. Prints milliseconds per iteration
(median and quartiles) and their ratio, and what the accumulation itself took.
"""

import argparse
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from scsr_opt.camera.recording import Recording
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.sampling import accumulate, place
from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA

VELOCITY = (0.02, 0.05)
"""Sensor pixels per frame, down and right."""


def recording(frames: int, height: int, width: int) -> Recording:
    """Spikes of random light: what they show does not matter here, how many there are does."""
    rng = np.random.default_rng(0)
    rate = rng.uniform(0.1, 0.5, (height, width))
    phase = rng.uniform(size=(height, width))
    total = np.floor(phase + rate * np.arange(frames + 1)[:, None, None])
    return Recording.from_array(np.diff(total, axis=0).astype(np.uint8))


def data_term(spikes: np.ndarray, scale: int) -> tuple[DataTerm, float, int]:
    """The data term of all frames, the seconds of its accumulation (compiled), the number of samples."""
    frames, height, width = spikes.shape
    samples = spike_intervals(spikes)
    motion = Motion.of_velocity(np.broadcast_to(np.array(VELOCITY)[:, None, None], (2, height, width)))
    path = trajectory_of(motion, key=frames // 2, start=0, stop=frames)
    on_device = jax.tree.map(jnp.asarray, samples.padded())
    seconds = []
    for _ in range(3):
        begin = time.perf_counter()
        placed = place(on_device, path, scale=scale, shape=(scale * height, scale * width))
        term = jax.block_until_ready(accumulate(placed))
        seconds.append(time.perf_counter() - begin)
    return term, min(seconds), samples.count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="400x250", help="width x height")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--frames", type=int, nargs="+", default=[101, 1001])
    parser.add_argument("--rounds", type=int, default=25)
    arguments = parser.parse_args()
    width, height = (int(n) for n in arguments.sensor.split("x"))
    whole = recording(max(arguments.frames), height, width)

    solver, step = FISTA(), eqx.filter_jit(lambda solver, problem, state: solver.step(problem, state))
    runs = {}
    for frames in arguments.frames:
        term, seconds, count = data_term(whole.window(*whole.around(None, frames)), arguments.scale)
        problem = Problem(term, HuberTotalVariation(), jnp.asarray(1e-3, jnp.float32))
        state = solver.init(problem, jnp.full(term.shape, 0.5, jnp.float32))
        state, _ = jax.block_until_ready(step(solver, problem, state))
        runs[frames] = (problem, state, [])
        print(f"{frames:5d} frames: {count:9d} samples, placed and accumulated in {seconds * 1e3:.0f} ms")
    for _ in range(arguments.rounds):
        for frames, (problem, state, times) in runs.items():
            begin = time.perf_counter()
            state, _ = jax.block_until_ready(step(solver, problem, state))
            times.append((time.perf_counter() - begin) * 1e3)
            runs[frames] = (problem, state, times)
    base = np.median(runs[arguments.frames[0]][2])
    for frames, (_, _, times) in runs.items():
        low, middle, high = np.percentile(times, (25, 50, 75))
        print(f"{frames:5d} frames: {middle:.1f} ms per iteration ({low:.1f} to {high:.1f}), ratio {middle / base:.3f}")


if __name__ == "__main__":
    main()
