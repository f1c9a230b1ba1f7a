"""How much `scsr bench` does, and on which recordings: stills that come with scikit-image before a simulated camera."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float
from skimage import data
from skimage.metrics import structural_similarity

from benchmarks.choosing_cases import LIGHTS, VELOCITY
from scsr_opt.camera.pictures import as_intensity
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.sampling_rules import Measuring, Windows
from scsr_opt.camera.scenes import Affine, MovingObject, Scene, Translation
from scsr_opt.camera.simulator import Simulation, simulate
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.motion.validation import given
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.sampling import accumulate
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.pipeline.measurement import first_picture, measured, stream_around
from scsr_opt.pipeline.strength import validated_strength
from scsr_opt.solvers import FISTA

FRAMES = 101
# What is validated for such stills at ×2, or nearly so (docs/choosing.md).
_STRENGTH = 1.2e-3
# Windows need 4 to 64 times the strength that intervals need (docs/data-term.md).
_FOR_WINDOWS = 8
GAPS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)


class Size(NamedTuple):
    """How much is done.

    **Fields:**
    - `scales`: of solvers and whole reconstructions.
    - `solvers`, `priors`, `methods`: names of those that take part, None for all. `careful`: whether strengths are
      validated and memory is looked at for each solver; both take a compilation more.
    - `sensor`: side of the sensor, pixels, for solvers and whole reconstructions; `rounds` of timing.
    - `exact`: iterations for a minimum. `seconds`: in which a solver has to reach a gap.
    - `recordings`, pairs of a still and a motion, and `lights`: of the whole reconstructions; `repeats` of timing each.
    - `frames`: numbers of them on a sensor of `still` pixels a side; `sides` of sensors with `FRAMES` frames.
    - `picture`: (H, W) of the kernels and of the statement about one iteration.
    - `accumulated`: (frames, h, w, scale) of the statement about M and c.
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


def still_of(name: str, size: int) -> Float[np.ndarray, "H W"]:
    """A square part of a picture above its middle, mirrored where the picture is smaller than that."""
    picture = as_intensity(getattr(data, name)())
    if picture.ndim == 3:
        picture = picture.mean(-1)
    short = [max(0, size - n) for n in picture.shape]
    picture = np.pad(picture, [(0, n) for n in short], mode="symmetric")
    top, left = (picture.shape[0] - size) // 4, (picture.shape[1] - size) // 2
    return picture[top : top + size, left : left + size]


def recorded(
    name: str,
    *,
    scale: int,
    sensor: int,
    frames: int = FRAMES,
    motion: str = "pan",
    speed: float = 1.0,
    light: str = "day",
    seed: int = 0,
) -> Simulation:
    """The recording of a still.

    **Arguments:** `sensor`: its side, pixels; `motion`: "pan", a translation by 0.14 sensor pixels per frame; "turn", a
    rotation by 0.0012 radians per frame; "object", an ellipse that passes a still background; `speed`: a factor on it;
    `light`: "day" or "dim".
    """
    size, key = sensor * scale, frames // 2
    drift = (VELOCITY[0] * scale * speed, VELOCITY[1] * scale * speed)
    picture = still_of(name, size)
    scenes: dict[str, Any] = {
        "pan": lambda: Translation(picture, drift, key=key),
        "turn": lambda: Affine(picture, rotation=0.0012 * speed, key=key),
        "object": lambda: MovingObject(picture, still_of("coffee", size // 2), drift, key=key),
    }
    scene: Scene = scenes[motion]()
    return simulate(scene, scale=scale, frames=frames, sensor=LIGHTS[light], seed=seed)


def recording_of(made: Simulation) -> Recording:
    """The spikes and the rate of white: what a method may know of it."""
    return Recording.from_array(made.spikes, white_rate=made.white_rate)


class Posed(NamedTuple):
    """A recording as the problem of a solver: `term` f of the true motion, `start` X^(0) and `strength` λ as
    `reconstruct` would take them with its prior at this scale, and the `truth`."""

    scale: int
    term: DataTerm
    start: Float[Array, "H W"]
    strength: float
    truth: Float[np.ndarray, "H W"]


def posed(made: Simulation, measuring: Measuring, *, careful: bool) -> Posed:
    """The quadratic that the first round of `reconstruct` minimises; λ validated if `careful`, the usual one if not."""
    recording, (height, width) = recording_of(made), made.gain.shape
    key, stream = stream_around(recording, key=None, frames=recording.frames, white_rate=None)
    motion = given(VELOCITY, height, width)
    taken = measured(stream, motion, scale=made.scale, measuring=measuring)
    placed = taken.placed
    start = first_picture(stream, placed.shape)
    if careful:
        strength = validated_strength(
            stream,
            motion,
            taken,
            start,
            scale=made.scale,
            prior=default_prior(made.scale),
            solver=FISTA(),
            measuring=measuring,
        ).strength
    else:
        share = _FOR_WINDOWS if isinstance(measuring, Windows) else 1
        strength = share * _STRENGTH * 2 / made.scale
    return Posed(made.scale, accumulate(placed), start, float(strength), made.truth(key))


def quality(truth: Float[np.ndarray, "H W"], image: Any, scale: int) -> tuple[float, float]:
    """PSNR in dB and mean SSIM, without 8 sensor pixels of border (a quarter of the picture, where that is less)."""
    border = min(8 * scale, min(truth.shape) // 4)
    inner = (slice(border, -border),) * 2
    shown = np.clip(np.asarray(image, np.float64), 0, 1)
    likeness: Any = structural_similarity(truth[inner].astype(np.float64), shown[inner], data_range=1.0)
    return psnr(truth, shown, border), float(likeness)
