"""Amount of work of `benchmarks.bench`: in full, and with `--quick`."""

from typing import NamedTuple

from benchmarks.recordings import FRAMES


class Size(NamedTuple):
    """Amount of work of `benchmarks.bench`.

    **Fields:**
    - `scales`: of solvers and whole reconstructions.
    - `solvers`, `priors`, `methods`: names of those that take part, None for all. `careful`: whether strengths are
      validated and the memory of each solver is looked at; both take a compilation more.
    - `sensor`: side of the sensor, pixels, for solvers and whole reconstructions; `rounds` of timing.
    - `exact`: iterations for a minimum. `seconds`: in which a solver has to reach a gap.
    - `recordings`, pairs of a still and a motion, and `lights`: of the whole reconstructions; `repeats` of timing each.
    - `frames`: numbers of them on a sensor of `still` pixels a side; `sides` of sensors with `FRAMES` frames.
    - `picture`: (H, W) of the kernels; `accumulated`: (frames, h, w, scale) of the samples of those that take samples.
    """

    scales: tuple[int, ...]
    solvers: tuple[str, ...] | None
    priors: tuple[str, ...] | None
    methods: tuple[str, ...] | None
    careful: bool
    sensor: int
    rounds: int
    exact: int
    seconds: float
    recordings: tuple[tuple[str, str], ...]
    lights: tuple[str, ...]
    repeats: int
    frames: tuple[int, ...]
    still: int
    sides: tuple[int, ...]
    picture: tuple[int, int]
    accumulated: tuple[int, int, int, int]


FULL = Size(
    scales=(2, 4), solvers=None, priors=None, methods=None, careful=True, sensor=80, rounds=3, exact=300, seconds=0.8,
    # Each still and each motion once.
    recordings=(("camera", "pan"), ("brick", "turn"), ("moon", "object")), lights=("day", "dim"), repeats=2,
    frames=(20, 60, 200, 600, 2000), still=64, sides=(64, 125, 250, 500, 1000),
    picture=(1000, 1600), accumulated=(FRAMES, 250, 400, 4),
)  # fmt: skip
QUICK = Size(
    scales=(2,), solvers=("ISTA", "FISTA", "ADMM", "CondatVu", "LBFGS"), priors=("TV",),
    methods=("reconstruct", "reconstruct, again", "reconstruct, Global motion", "unrolled", "shift_and_add",
             "tfp_bicubic", "tfp_sr"),
    careful=False, sensor=40, rounds=5, exact=200, seconds=0.3, recordings=(("camera", "pan"),), lights=("day",),
    repeats=5, frames=(20, 101), still=40, sides=(40, 80), picture=(1000, 1600), accumulated=(FRAMES, 250, 400, 4),
)  # fmt: skip
