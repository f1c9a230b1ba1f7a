"""A spike camera looking at a scene: integrate and fire (paper, Eq. 1–2).

Light is gathered frame by frame: the picture at time t is taken to stand still during readout t (25 µs), which is short
against any motion of less than a pixel per frame. A pixel sees the mean over its s × s HR pixels (its aperture) of the
picture behind the optics. Frames are made one at a time and forgotten, so memory does not grow with HR size times
frames.
"""

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import gaussian_filter

from scsr_opt._validation import number, whole
from scsr_opt.camera.recording import WHITE_RATE, checked_white_rate
from scsr_opt.camera.scenes import Scene
from scsr_opt.errors import InputError
from scsr_opt.progress import Progress, check_progress


@dataclass(frozen=True)
class Sensor:
    """Properties of a camera. Without arguments an ideal one: nothing but the quantisation into spikes.

    **Fields:**
    - `white_rate`: spikes per frame of a pixel at intensity 1; the threshold is θ = 1 / `white_rate`, in frames of
      white light.
    - `photons`: photons per frame of a pixel at intensity 1. Their number is Poisson distributed (shot noise): the
      intensity measured in one frame has variance intensity / `photons`. Infinite: no shot noise.
    - `dark_rate`: mean thermal (dark) charge per frame, as the intensity that would give as much. It too comes in
      single electrons, Poisson distributed, and has variance `dark_rate` / `photons` per frame; where `photons` is
      infinite, `dark_rate` / `DARK_ELECTRONS`, so that thermal noise can be studied alone. Every pixel has the same
      mean.
    - `fixed_pattern`: standard deviation of the pixels' gain about 1 (normal, cut at 0). The gain multiplies light, not
      dark charge. Real recordings: about 0.06.
    - `dead`, `hot`: shares of the pixels that never fire, and that fire in every frame; to the nearest whole pixel.
    - `psf_sigma`: standard deviation of the optics' Gaussian blur, HR pixels.

    **Raises:** `InputError` if one is out of range.
    """

    # Thermal electrons that make as much charge as white does in one frame, where `photons` is infinite.
    DARK_ELECTRONS: ClassVar[float] = 1000.0
    # Limits below which the numbers of photons and electrons that are drawn fit into 64 bits.
    PHOTONS: ClassVar[tuple[float, float]] = (1e-6, 1e12)
    MOST_DARK_RATE: ClassVar[float] = 1e6

    white_rate: float | int = WHITE_RATE
    photons: float | int = math.inf
    dark_rate: float | int = 0.0
    fixed_pattern: float | int = 0.0
    dead: float | int = 0.0
    hot: float | int = 0.0
    psf_sigma: float | int = 0.0

    def __post_init__(self):
        checked_white_rate(self.white_rate)
        fewest, most = self.PHOTONS
        if self.photons != math.inf:
            limits = f"from {fewest:g} to {most:g}, in photons per frame of white, or infinite"
            number(self.photons, "photons", lambda v: fewest <= v <= most, limits)
        darkest = self.MOST_DARK_RATE
        number(self.dark_rate, "dark_rate", lambda v: 0 <= v <= darkest, f"from 0 to {darkest:g}, as an intensity")
        number(self.fixed_pattern, "fixed_pattern", lambda v: 0 <= v < 1, "from 0 to below 1, a relative spread")
        number(self.psf_sigma, "psf_sigma", lambda v: v >= 0, "of at least 0, in HR pixels")
        for name in ("dead", "hot"):
            number(getattr(self, name), name, lambda v: 0 <= v <= 1, "from 0 to 1, a share of the pixels")
        if self.dead + self.hot > 1:
            raise InputError(
                f"dead = {self.dead:g} and hot = {self.hot:g} are more than all pixels together: lower one of them."
            )

    @property
    def threshold(self) -> float:
        """θ, in frames of light of intensity 1."""
        return 1 / self.white_rate


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated recording, with the truth behind it.

    **Fields:**
    - `spikes`: (T, h, w) uint8, 0 and 1.
    - `scene`, `scale`, `sensor`: what was simulated.
    - `gain`: (h, w), the pixels' fixed pattern.
    - `dead`, `hot`: (h, w), True for pixels that never fire, and that fire in every frame.
    """

    spikes: UInt8[np.ndarray, "T h w"] = field(repr=False)
    scene: Scene
    scale: int
    sensor: Sensor
    gain: Float[np.ndarray, "h w"] = field(repr=False)
    dead: Bool[np.ndarray, "h w"] = field(repr=False)
    hot: Bool[np.ndarray, "h w"] = field(repr=False)

    @property
    def white_rate(self) -> float:
        """Spikes per frame of a pixel at intensity 1."""
        return float(self.sensor.white_rate)

    @property
    def bad_pixels(self) -> Bool[np.ndarray, "h w"]:
        """True where a pixel is dead or hot."""
        return self.dead | self.hot

    def truth(self, t: float | int) -> Float[np.ndarray, "H W"]:
        """The HR picture (s·h, s·w) at time `t`, spike frames: sharp, before the optics (X in the paper's Eq. 2)."""
        height, width = (n * self.scale for n in self.gain.shape)
        return np.array(self.scene.frame(t)[:height, :width])

    def velocity(self, t: float | int) -> Float[np.ndarray, "2 h w"]:
        """The true velocity, SENSOR pixels per frame, of what each sensor pixel sees at time `t`; [0] rows, [1]
        columns.

        A pixel that sees two surfaces has the velocity of the larger one (of the front one where they are equal): their
        mean would be the motion of neither.

        **Raises:** `InputError` if the scene's true motion is not known (video).
        """
        h, w = self.gain.shape
        s = self.scale
        fine = self.scene.velocity(t)[:, : h * s, : w * s].reshape(2, h, s, w, s)
        surface = self.scene.surface(t)[: h * s, : w * s].reshape(h, s, w, s)
        most = np.zeros((h, w))
        answer = np.zeros((2, h, w))
        for label in np.unique(surface):
            mine = surface == label
            count = mine.sum((1, 3))
            wins = (count > 0) & (count >= most)
            answer[:, wins] = (fine * mine).sum((2, 4))[:, wins] / (count[wins] * s)
            most = np.maximum(most, count)
        return answer


def simulate(
    scene: Scene,
    *,
    scale: int,
    frames: int = 101,
    sensor: Sensor = Sensor(),  # noqa: B008 (frozen)
    seed: int = 0,
    progress: Progress | None = None,
) -> Simulation:
    """Record `scene` with a spike camera.

    Each pixel adds up what reaches it and fires when the sum passes θ; the residual is kept (subtractive reset, as
    measured on real cameras), so that between two spikes exactly θ has come in: ∫ I dt = θ (Eq. 1). The first charge is
    uniform in [0, θ), as if the camera had been running. One readout holds one spike at most: light above θ per frame
    crosses the threshold several times within one, but is read out as a single spike (Eq. 1's S(n_k) = 1, whatever else
    falls into n_k). Such a pixel is saturated: it fires in every frame, and intensities above θ look alike.
    With the default `white_rate` of 0.6 that begins at intensity 1.67, with one above 1 it begins below white.

    **Arguments:**
    - `scene`: what is seen. Rows and columns that do not fill a whole sensor pixel (at the bottom and on the right) are
      not.
    - `scale`: s, HR pixels per sensor pixel along each axis.
    - `frames`: T, from time 0 to T − 1.
    - `sensor`: the camera.
    - `seed`: the same seed gives the same recording; phase, gain, bad pixels and noise are drawn independently of each
      other, so that switching one on leaves the others as they were.
    - `progress`: receives every frame done (see `scsr_opt.report`).

    **Returns:** `Simulation`.

    **Raises:** `InputError` if `scale` or `frames` is not a whole number of at least 1, the scene is smaller than one
    sensor pixel or not known for all frames, the sensor's optics blur over more than the scene, or `seed` is negative.
    """
    check_progress(progress)
    scale, frames = whole(scale, "scale", 1), whole(frames, "frames", 1)
    h, w = scene.size[0] // scale, scene.size[1] // scale
    if h == 0 or w == 0:
        raise InputError(
            f"The scene has {scene.size[0]} rows and {scene.size[1]} columns, which is less than one sensor pixel at "
            f"scale {scale}: use a larger picture or a smaller scale."
        )
    if sensor.psf_sigma > max(scene.size):
        raise InputError(
            f"psf_sigma is {sensor.psf_sigma:g} HR pixels, but it must be from 0 to the longer side of the scene, "
            f"{max(scene.size)}."
        )
    if not (scene.span[0] <= 0 and frames - 1 <= scene.span[1] + 1e-9):
        raise InputError(
            f"{frames} frames were asked for, but the scene is known from spike frame {scene.span[0]:g} to "
            f"{scene.span[1]:g} only: ask for {math.floor(scene.span[1]) + 1} frames or fewer, or slow it down."
        )
    phase_rng, gain_rng, bad_rng, noise_rng = (
        np.random.default_rng(child) for child in np.random.SeedSequence(whole(seed, "seed", 0)).spawn(4)
    )
    charge = phase_rng.random((h, w))  # in units of θ
    gain = np.maximum(1 + sensor.fixed_pattern * gain_rng.standard_normal((h, w)), 0)
    dead, hot = _bad_pixels(sensor, (h, w), bad_rng)
    spikes = np.empty((frames, h, w), np.uint8)
    if progress is not None:
        progress.start(frames, "Simulating")
    try:
        seen = light = None
        for t in range(frames):
            picture = scene.frame(float(t))
            if light is None or picture is not seen:  # a scene that stands still hands out the same array every time
                seen, light = picture, gain * _sensor_image(picture, (h, w), scale, sensor.psf_sigma)
            charge += sensor.white_rate * _gathered(light, sensor, noise_rng)
            crossings = np.floor(charge)
            charge -= crossings
            spikes[t] = crossings > 0
            if progress is not None:
                progress.advance(1)
    finally:
        if progress is not None:
            progress.finish()
    spikes[:, dead] = 0
    spikes[:, hot] = 1
    return Simulation(spikes, scene, scale, sensor, gain, dead, hot)


def _sensor_image(
    picture: Float[np.ndarray, "H W"], shape: tuple[int, int], scale: int, psf_sigma: float | int
) -> Float[np.ndarray, "h w"]:
    if psf_sigma > 0:
        picture = gaussian_filter(picture, psf_sigma, mode="reflect")
    h, w = shape
    return picture[: h * scale, : w * scale].reshape(h, scale, w, scale).mean((1, 3))


def _gathered(light: Float[np.ndarray, "h w"], sensor: Sensor, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Charge that one frame adds, in frames of white light."""
    if math.isfinite(sensor.photons):
        return rng.poisson(sensor.photons * (light + sensor.dark_rate)) / sensor.photons  # sums of Poissons are Poisson
    if sensor.dark_rate > 0:
        return light + rng.poisson(sensor.DARK_ELECTRONS * sensor.dark_rate, light.shape) / sensor.DARK_ELECTRONS
    return light


def _bad_pixels(
    sensor: Sensor, shape: tuple[int, int], rng: np.random.Generator
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    pixels = shape[0] * shape[1]
    order = rng.permutation(pixels)
    dead = round(sensor.dead * pixels)
    hot = min(round(sensor.hot * pixels), pixels - dead)
    masks = np.zeros((2, pixels), bool)
    masks[0, order[:dead]] = True
    masks[1, order[dead : dead + hot]] = True
    return masks[0].reshape(shape), masks[1].reshape(shape)
