"""`Solution`, the result of a reconstruction: its picture, and all that is known of how it was found."""

import copy
import functools
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from scsr_opt.calibration.bad_pixels import BadPixels
from scsr_opt.camera.light import Light
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.white import White
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion
from scsr_opt.pipeline.scene_summary import SceneSummary
from scsr_opt.solvers.record import Stage, Status, TileIterations

if TYPE_CHECKING:
    from scsr_opt.report.shown import ShownFigure
    from scsr_opt.report.summary import Report


@dataclass(frozen=True, kw_only=True)
class Diagnostics:
    """Numbers from a reconstruction, beside its picture; None where one does not apply.

    **Fields:**
    - `iterations`, `solver` and `prior` (the names of their classes), `strength` λ, `objective` (Eq. 4, halved, at the
      picture; of the last solve).
    - `samples`: number of samples that were used. `positions`: largest number of positions along an exposure.
    - `speed_max`: largest speed, sensor pixels per frame. `saturated`: share of the pixels that fired in 90 % of the
      frames or more; at these the picture is a lower bound.
    - `gain_spread`, `gain_spread_at_rest`: standard deviation of the pixels' gains where the scene moves by a pixel,
      and elsewhere.
    - `bad_pixels`: number of pixels that were left out, by kind (`PixelKind`): given, dead, hot, isolated, resting.
    - `light_depth`: amplitude of the light, relative to its mean; None if it does not change.
      `light_frequency`: Hz; None if the light is not periodic.
      `light_unexplained`: share of the tiles that were examined, 64 at most, whose brightness changes as in the tiles
      beside them, which neither the motion nor the light explains: shadows, reflections.
    - `used_frames`: frames before and after the key frame within which samples were used: the 5 %, 50 % and 95 %
      quantiles over the pixels.
    - `optics_sigma`: standard deviation of the estimated lens, sensor pixels.
    - `motion_carried`: in a sequence, whether the motion is that of the picture before, carried on.
    - `quality`: "best" where Eq. 4 was solved a second time, around a network's picture (`Options.quality`), otherwise
      "fast". `restored`: None if "best" was not asked for; false if it was, but the picture with the network predicted
      held-out samples worse than the one without it, which was solved for instead. `restored_deviations`: by how many
      standard deviations it predicted them worse (negative: better); None where they were not compared, as the strength
      was given or carried on.
    - Of the second solve: `first_iterations`, those of `iterations` that were made before it; `centred_strength`, its λ
      (`strength` is that of the first solve); `misfit_ratio`: f(X) of the picture over that of the first solution,
      above 1 if the samples contradict the network's picture.
    - `seconds`: time of each part of the work.
    """

    iterations: int = 0
    samples: int = 0
    solver: str | None = None
    prior: str | None = None
    positions: int | None = None
    strength: float | None = None
    objective: float | None = None
    speed_max: float | None = None
    saturated: float | None = None
    gain_spread: float | None = None
    gain_spread_at_rest: float | None = None
    bad_pixels: dict[str, int] | None = None
    light_depth: float | None = None
    light_frequency: float | None = None
    light_unexplained: float | None = None
    used_frames: tuple[float, float, float] | None = None
    optics_sigma: float | None = None
    motion_carried: bool | None = None
    quality: str | None = None
    restored: bool | None = None
    restored_deviations: float | None = None
    first_iterations: int | None = None
    centred_strength: float | None = None
    misfit_ratio: float | None = None
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(kw_only=True, repr=False)
class Solution:
    """A reconstruction. Its arrays are the caller's own: `solution.image *= 255` is fine.

    **Fields:**
    - `image`: (H, W) float32, intensity, 1 = white, linear.
    - `recording`, the `scale` s, the `key` frame (of the recording), and the `white_rate` (spikes per frame of
      intensity 1) that was used.
    - `crop`: (top, left, height, width) of the part of the sensor that was solved for; None for all of it.
    - `status`: how the solve ended. `stages`: one record per iteration. `diagnostics`: named numbers.
    - `motion`: the motion that was used; None if there was none.
    - `gain`: (h, w), gain of each sensor pixel, as given or estimated (`Options.gain`); None if all are 1.
    - `bad_pixels`: pixels of the sensor, or of `crop`, that were not used, and why; None if all were used.
    - `light`: light of each moment of the clip, if it changes (`camera.light.Light`); None if it does not.
    - `used_frames`: (h, w), frames before and after the key frame within which samples of each sensor pixel were used
      (`Measurements.used_frames`); 0 for a pixel without samples; None if no picture was solved for.
    - `scene`: the scene summary, kinds of the tiles; None with `Shortcuts.none()`.
    - `tiles`: iterations of each tile; None if tiles were not iterated one by one.
    - `white`: intensity that 8-bit PNG, figures and films show as white; the same for all pictures of a sequence.
    - `state`: what a solve of a similar problem can start from (`reconstruct(…, state=…)`).
    """

    image: Float[np.ndarray, "H W"]
    recording: Recording
    scale: int
    key: int
    white_rate: float
    status: Status
    crop: tuple[int, int, int, int] | None = None
    stages: tuple[Stage, ...] = ()
    diagnostics: Diagnostics = Diagnostics()
    motion: Motion | None = None
    gain: Float[np.ndarray, "h w"] | None = None
    bad_pixels: BadPixels | None = None
    light: Light | None = None
    used_frames: Float[np.ndarray, "h w"] | None = None
    scene: SceneSummary | None = None
    tiles: TileIterations | None = None
    white: White = White()
    state: Any = None

    def __repr__(self) -> str:
        height, width = self.image.shape
        return (
            f"Solution({self.recording.name!r}, key frame {self.key}, {width}x{height} (x{self.scale}): "
            f"{self.status.message} See .image, .plot(), .diagnostics)"
        )

    @property
    def part(self) -> Recording:
        """The recording of the part of the sensor that was solved for."""
        return self.recording if self.crop is None else self.recording.crop(*self.crop)

    def handed_out(self) -> "Solution":
        """A copy whose arrays may be written to: those that the solve made may be views of JAX's, or are needed for the
        next picture. Recording, stages and state are shared, as nobody else writes to them."""
        return copy.deepcopy(self, {id(part): part for part in (self.recording, self.stages, self.state)})

    @functools.cached_property  # an ordinary property could not be multiplied in place
    def velocity(self) -> Float[np.ndarray, "2 h w"] | None:
        """Velocity of the motion, float32, sensor pixels per frame ([0] rows, [1] columns)."""
        return None if self.motion is None else self.motion.velocity

    @functools.cached_property
    def confidence(self) -> Float[np.ndarray, "h w"] | None:
        """How far that velocity can be trusted, in [0, 1]."""
        return None if self.motion is None else self.motion.confidence

    def plot(self, **options: Any) -> "ShownFigure":
        """A figure of the picture beside playback, of its motion and convergence (`scsr_opt.report.figure`)."""
        from scsr_opt.report.figures import figure

        return figure(self, **options)

    def report(self) -> "Report":
        """The numbers of the solution, for a JSON file or a reader (`scsr_opt.report.Report`)."""
        from scsr_opt.report.summary import Report

        return Report.of(self)

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        bits: int | None = None,
        gamma: float = 1.0,
        white: float | None = None,
    ) -> None:
        """Writes the picture by the ending of `path` (`scsr_opt.report.write_picture`); an `.npz` also holds velocity,
        confidence, scale and key frame.

        `white`: intensity of the largest grey level of an 8-bit PNG; that of the solution if None. Other files are
        absolute.

        **Raises:** `InputError` if the file cannot be written, or the solve failed and there is no picture.
        """
        from scsr_opt.report.pictures import PictureFormat, write_picture

        if not self.status.usable:
            raise InputError(f"{path} was not written, as the solve failed: {self.status.clause}.")
        extras = {"velocity": self.velocity, "confidence": self.confidence, "scale": self.scale, "key": self.key}
        extras["crop"] = self.crop
        known = {name: value for name, value in extras.items() if value is not None}
        if white is None:
            white = 1.0 if PictureFormat.of(path, bits=bits, gamma=gamma).absolute else self.white.level
        write_picture(path, self.image, bits=bits, gamma=gamma, white=white, extras=known)
