"""What do spike intervals gain over counts in windows, their ends over nothing, weights over durations?

    python -m benchmarks.data_term [--pictures camera coins] [--scale 2]

Stills that come with scikit-image pan at a known speed before a simulated camera, in daylight and in dim light. The
same frames make samples of each kind; motion, positions along the exposures, prior (total variation) and solver are the
same for all, and each kind has the strength that suits it best. Prints the PSNR, dB.
"""

import argparse
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter
from skimage import data

from scsr_opt.camera.noise import Noise
from scsr_opt.camera.pictures import as_intensity
from scsr_opt.camera.samples import Samples, spike_intervals, windows
from scsr_opt.camera.scenes import Translation
from scsr_opt.camera.simulator import Sensor, Simulation, simulate
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.sampling import accumulate, place
from scsr_opt.priors.total_variation import TotalVariation
from scsr_opt.solvers.loop import run
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA

FRAMES, SIZE, VELOCITY = 101, 160, (0.07, -0.12)
LIGHTS = {"day": Sensor(white_rate=0.6, photons=1000.0), "dim": Sensor(white_rate=0.1, photons=25.0)}
STRENGTHS = 0.128 / 2.0 ** np.arange(11)


def kinds(made: Simulation) -> Iterator[tuple[str, Samples]]:
    rate, spikes = made.white_rate, made.spikes
    yield "intervals", spike_intervals(spikes, white_rate=rate)
    yield "without ends", spike_intervals(spikes, white_rate=rate, ends=0)
    level = gaussian_filter(spikes.mean(0) / rate, 1.5)
    found = spike_intervals(spikes, white_rate=rate)
    weight = Noise(photons=made.sensor.photons).weights(found, level)
    yield "noise weights", eqx.tree_at(lambda s: s.weight, found, weight)
    for length in (4, 9, 21):
        yield f"windows of {length}", windows(spikes, length=length, white_rate=rate)


def best(made: Simulation, samples: Samples) -> tuple[float, float]:
    """The PSNR at the strength that gives the highest, and that strength."""
    height, width = made.spikes.shape[1:]
    shape = (made.scale * height, made.scale * width)
    velocity = np.broadcast_to(np.array(VELOCITY, np.float32)[:, None, None], (2, height, width))
    path = trajectory_of(Motion.of_velocity(velocity), key=FRAMES // 2, start=0, stop=FRAMES)
    samples = eqx.tree_at(lambda s: s.weight, samples, samples.weight / np.float32(FRAMES))
    on_device = jax.tree.map(jnp.asarray, samples.padded())
    placed = place(on_device, path, scale=made.scale, finest=5, shape=shape)
    uncorrected = accumulate(placed)
    image = jnp.full(shape, jnp.sum(placed.weight * placed.value) / jnp.sum(placed.weight))
    scores = []
    for strength in STRENGTHS:  # from strong to weak, each from the picture before
        for _ in range(2):
            term = with_exposure(uncorrected, placed, image)
            problem = Problem(term, TotalVariation(), jnp.asarray(strength, jnp.float32))
            image = jnp.asarray(run(FISTA(), problem, image, tolerance=5e-4).image)
        scores.append((psnr(made.truth(FRAMES // 2), np.asarray(image), 8 * made.scale), float(strength)))
    return max(scores)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", nargs="+", default=["camera", "coins"])
    parser.add_argument("--scale", type=int, default=2)
    arguments = parser.parse_args()
    for light, sensor in LIGHTS.items():
        for name in arguments.pictures:
            picture = as_intensity(getattr(data, name)())
            top, left = ((n - SIZE) // 2 for n in picture.shape)
            picture = picture[top : top + SIZE, left : left + SIZE]
            velocity = (VELOCITY[0] * arguments.scale, VELOCITY[1] * arguments.scale)
            scene = Translation(picture, velocity=velocity, key=FRAMES // 2)
            made = simulate(scene, scale=arguments.scale, frames=FRAMES, sensor=sensor)
            for kind, samples in kinds(made):
                score, strength = best(made, samples)
                print(f"{light:4s} {name:10s} {kind:14s} {score:6.2f} dB at strength {strength:.6f}", flush=True)


if __name__ == "__main__":
    main()
