"""How often a plan is wrong about a tile, on simulated recordings.

    python -m benchmarks.false_alarms [--parts 3]

Random parts of scikit-image's pictures, 64×64 sensor pixels at ×2 (16 tiles), 101 frames, by day and in dim light. At
rest: in how many recordings anything is said to move, and in how many tiles (a false alarm costs time alone). As slow
pans: in how many tiles nothing is said to move (a miss costs sharpness); by how far the picture moves within the
recording. Plain recordings at rest, by spikes per frame, some as regular as they can be: tiles that are said to have
texture, and to move; and at the very limit to dark and to saturated, tiles that are said to be that, where noise alone
decides. Of texture, dark and saturated 0.1 % are asked for at most.
"""

import argparse
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from benchmarks.gains_at_rest import LIGHTS, stills
from scsr_opt.camera import Sensor, simulate
from scsr_opt.camera.saturation import SATURATED
from scsr_opt.camera.scenes import Scene, Static, Translation
from scsr_opt.pipeline.preparation import prepare
from scsr_opt.pipeline.scene_summary import DARK, Kind, Plan

SIZE, SCALE, FRAMES = 64, 2, 101
# Sensor pixels within the recording.
PANS = (0.25, 0.5, 1.0, 2.0)
# Plain recordings of each kind: 1,600 tiles, of which two may be wrong; and their spikes per frame.
PLAIN, RATES = 100, (0.1, 0.25, 0.3, 0.495, 0.5)
STILL = (Kind.STATIC, Kind.UNIFORM)


def planned(scene: Scene, sensor: Sensor, seed: int) -> Plan:
    """The plan of a recording of a scene."""
    spikes = simulate(scene, scale=SCALE, frames=FRAMES, sensor=sensor, seed=seed).spikes
    # Neither strength nor gains have a say in it.
    plan = prepare(spikes, scale=SCALE, white_rate=sensor.white_rate, strength=1e-3, gain=None).plan
    assert plan is not None
    return plan


def told(plans: list[Plan], *kinds: Kind) -> str:
    """How many recordings have a tile of these kinds, and how many tiles there are."""
    found = np.array([np.isin(plan.kind, kinds) for plan in plans])
    recordings, tiles = np.count_nonzero(found.any((1, 2))), np.count_nonzero(found)
    return f"{recordings} of {len(found)} | {tiles:,} of {found.size:,} | {100 * tiles / found.size:.3f} %"


def textured(number: int) -> Iterator[tuple[int, Float[np.ndarray, "H W"]]]:
    """So many random parts of each picture, with a margin to pan over, each with a seed."""
    generator = np.random.default_rng(0)
    side = SCALE * SIZE + 8
    for picture in stills():
        for _ in range(number):
            row, column = (generator.integers(length - side + 1) for length in picture.shape)
            yield int(generator.integers(2**31)), picture[row : row + side, column : column + side]


def flat(intensity: float, sensor: Sensor) -> list[Plan]:
    """The plans of plain recordings."""
    scene = Static(np.full((SCALE * SIZE, SCALE * SIZE), intensity, np.float32))
    return [planned(scene, sensor, seed) for seed in range(PLAIN)]


def lines(parts: int) -> Iterator[str]:
    """The table, line by line."""
    yield "| what there is, and what it is taken for | recordings | tiles | |"
    yield "|---|--:|--:|--:|"
    for light, (white_rate, photons) in zip(("day", "dim"), LIGHTS, strict=True):
        sensor = Sensor(white_rate, photons)
        at_rest = [planned(Static(part[:-8, :-8]), sensor, seed) for seed, part in textured(parts)]
        yield f"| at rest, {light}: moving | {told(at_rest, Kind.MOVING, Kind.FAST)} |"
        for pan in PANS:
            velocity = (0.6 * SCALE * pan / FRAMES, 0.8 * SCALE * pan / FRAMES)
            panned = [planned(Translation(part, velocity), sensor, seed) for seed, part in textured(parts)]
            yield f"| a pan by {pan:g} sensor pixels, {light}: at rest | {told(panned, *STILL)} |"
    white_rate, photons = LIGHTS[0]
    sensor = Sensor(white_rate, photons)
    for rate in RATES:
        plans = flat(rate / white_rate, sensor)
        yield f"| plain, {rate:g} spikes per frame: textured | {told(plans, Kind.STATIC)} |"
        yield f"| plain, {rate:g} spikes per frame: moving | {told(plans, Kind.MOVING, Kind.FAST)} |"
    for grain in (photons, LIGHTS[1][1]):
        plans = flat(DARK / FRAMES / white_rate, Sensor(white_rate, grain))
        yield f"| {DARK:g} spikes a pixel, {grain:g} photons: dark | {told(plans, Kind.DARK)} |"
    plans = flat(1.0, Sensor(SATURATED, photons))
    yield f"| spikes in {100 * SATURATED:g} % of the frames: saturated | {told(plans, Kind.SATURATED)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", type=int, default=3, help="of each picture")
    for line in lines(parser.parse_args().parts):
        print(line, flush=True)


if __name__ == "__main__":
    main()
