"""Recordings of pictures that come with scikit-image, made by a simulated camera, and problems made of them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from skimage import data
from skimage.metrics import structural_similarity

from scsr_opt import reconstruct
from scsr_opt.camera.pictures import as_intensity
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.sampling_rules import SamplingRule, Windows
from scsr_opt.camera.scenes import Affine, MovingObject, Scene, Static, Translation, TurningDisc
from scsr_opt.camera.simulator import Sensor, Simulation, simulate
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.motion import Motion
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.sampling import accumulate
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.pipeline.initial_image import initial_image
from scsr_opt.pipeline.measurement import measure
from scsr_opt.pipeline.strength import StrengthSearch
from scsr_opt.priors import Prior
from scsr_opt.solvers import FISTA

FRAMES = 101
VELOCITY = (0.07, -0.12)
"""Sensor pixels per frame, down and right."""
LIGHTS = {"day": Sensor(white_rate=0.6, photons=1000.0), "dim": Sensor(white_rate=0.1, photons=25.0)}
SCENES: dict[str, Callable[[Any, Any], Scene]] = {
    "static": lambda still, texture: Static(still),
    "translate": lambda still, texture: Translation(still, velocity=(0.3, 0.5)),
    "affine": lambda still, texture: Affine(still, rotation=0.002, zoom=0.001, drift=(0.2, 0.1)),
    "object": lambda still, texture: MovingObject(still, texture, (0.6, 0.8)),
    "fan": lambda still, texture: TurningDisc(still, texture, 0.004),
}
"""A scene of each kind, of a still and of the texture of what passes before it; high-resolution pixels per frame."""
# λ that is validated for such stills at ×2, or nearly so (docs/choosing.md).
USUAL_STRENGTH = 1.2e-3
# Windows need 4 to 64 times the strength that intervals need (docs/data-term.md).
STRENGTH_FACTOR_OF_WINDOWS = 8


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
    """A recording as the problem of a solver: the data `term` f of the true motion, the first picture `start`, the
    `strength` λ that `reconstruct` would take with its prior at this scale, and the `truth`."""

    scale: int
    term: DataTerm
    start: Float[Array, "H W"]
    strength: float
    truth: Float[np.ndarray, "H W"]


def posed(
    made: Simulation, sampling: SamplingRule, *, validate: bool, prior: Prior | None = None, exposed: bool = False
) -> Posed:
    """The quadratic problem that the first round of `reconstruct` solves.

    **Arguments:** `sampling`: how samples are made. `validate`: whether λ is validated for `prior` (by default,
    that of `reconstruct` at this scale), or the usual one. `exposed`: whether the term is corrected for motion during
    exposures, at the picture that `reconstruct` finds.
    """
    recording = recording_of(made)
    clip = Clip.around(recording, frames=recording.frames)
    motion, prior = Motion.constant(VELOCITY, clip.shape), default_prior(made.scale) if prior is None else prior
    samples = measure(clip, motion, scale=made.scale, sampling=sampling)
    start = initial_image(clip, samples.placed.shape)
    if validate:
        search = StrengthSearch(scale=made.scale, prior=prior, solver=FISTA(), sampling=sampling)
        strength = search.find(clip, motion, samples, start).strength
    else:
        share = STRENGTH_FACTOR_OF_WINDOWS if isinstance(sampling, Windows) else 1
        strength = share * USUAL_STRENGTH * 2 / made.scale
    term = accumulate(samples.placed)
    if exposed:
        image = reconstruct(recording, scale=made.scale, motion=motion, prior=prior, strength=float(strength)).image
        term = with_exposure(term, samples.placed, jnp.asarray(image))
    return Posed(made.scale, term, start, float(strength), made.truth(clip.key_frame))


def quality(truth: Float[np.ndarray, "H W"], image: Any, scale: int) -> tuple[float, float]:
    """PSNR in dB and mean SSIM, without 8 sensor pixels of border (a quarter of the picture, where that is less)."""
    border = min(8 * scale, min(truth.shape) // 4)
    inner = (slice(border, -border),) * 2
    shown = np.clip(np.asarray(image, np.float64), 0, 1)
    likeness: Any = structural_similarity(truth[inner].astype(np.float64), shown[inner], data_range=1.0)
    return psnr(truth, shown, border), float(likeness)
