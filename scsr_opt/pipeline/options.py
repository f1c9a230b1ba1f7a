"""`Options`, all choices of a reconstruction as one value that is checked once, and `Shortcuts`, the work left out."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from typing import Any, Literal, SupportsFloat, SupportsIndex

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from scsr_opt._arrays import as_array
from scsr_opt._validation import (
    check_type,
    flag,
    picture_shape,
    pixel_dark,
    pixel_gain,
    prior_strength,
    rectangle,
    whole,
)
from scsr_opt.calibration.bad_pixels import BadPixels
from scsr_opt.camera.recording import USUAL_FRAMES, Recording, checked_mask, checked_white_rate
from scsr_opt.camera.sampling_rules import Intervals, SamplingRule
from scsr_opt.errors import InputError, shown
from scsr_opt.motion.estimators.base import Estimator
from scsr_opt.motion.trajectory import Motion
from scsr_opt.motion.validation import validate_motion
from scsr_opt.operators.blur import Blur
from scsr_opt.operators.losses import Loss
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.pipeline.restoration import Restoration, restoration_of
from scsr_opt.pipeline.settings import PipelineSettings
from scsr_opt.pipeline.strength import relative_strength
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser
from scsr_opt.solvers.solver import Solver


@dataclass(frozen=True, kw_only=True)
class Shortcuts:
    """Work that is left out where a scene does not need it. All are on by default and change a picture by less than
    its noise (docs/decisions/0019); `Shortcuts.none()` does all of the work, to compare with.

    **Fields:**
    - `simple_motion`: a richer motion is not estimated if the recording does not contradict a simpler one, and objects
      are searched for only around the pixels that contradict the motion of the background.
    - `merged_intervals`: the intervals of a pixel are merged while the surface that it sees hardly moves, and an
      exposure gets only the positions that its motion needs.
    - `sensor_grid`: if nothing moves, samples lie on the sensor's grid, and the blurred picture is not computed between
      its points.
    - `reused_sums`: the solve uses M and c that were summed to find the strength.
    - `finished_tiles`: tiles of the picture whose residual is small are not iterated any further.
    - `sampled_gains`: if some windows and some of the pixels show no fixed pattern, the gains of the others are not
      estimated.
    """

    simple_motion: bool = True
    merged_intervals: bool = True
    sensor_grid: bool = True
    reused_sums: bool = True
    finished_tiles: bool = True
    sampled_gains: bool = True

    def __post_init__(self):
        for one in fields(self):
            flag(getattr(self, one.name), f"Shortcuts.{one.name}")

    @classmethod
    def none(cls) -> "Shortcuts":
        """No work is left out."""
        return cls(**{one.name: False for one in fields(cls)})

    @property
    def any(self) -> bool:
        """True where any work may be left out."""
        return any(getattr(self, one.name) for one in fields(self))


@dataclass(frozen=True, kw_only=True, eq=False)
class Options:
    """All choices of a reconstruction (Eq. 4); every field is also a keyword of `scsr_opt.reconstruct`.

    **Fields:**
    - `frames`: how many frames around the key frame are used (all, if the recording has fewer).
    - `white_rate`: spikes per frame of a pixel at intensity 1; that of the recording if None.
    - `motion`: at the key frame: a `Motion` (`Motion.constant`, `Motion.of_velocity`, `estimate_motion`), or an
      `Estimator` (`Still`, `Global`, `Dense`, `Automatic`, …). None: `Automatic`.
    - `bad_pixels`: (h, w), true or 1 where a pixel must not be used (added to those of the recording). "auto", the
      default, finds dead and hot pixels and dust from the recording (`scsr_opt.calibration.bad_pixels`); None for those
      that the recording marks only.
    - `samples`: how the Y_i are made: `Intervals()` if None, or `Windows(length)`, counts of spikes over `length`
      frames.
    - `gain`: gain of each pixel, (h, w); None for 1; or "blind" to estimate the gains from the recording. Where the
      scene moves by a sensor pixel they follow from the solved picture, which is then solved for again, twice
      (`blind_gain`); at rest a network estimates them (`gain_at_rest`). "auto", the default, does so only if the gains
      spread by more than they do by chance (`GainSettings.pattern_spread`). With gains the motion is estimated on
      measurements that are divided by them, because a fixed pattern rests.
    - `dark`: (h, w), spikes per frame that each pixel fires without any light; None for 0. It is subtracted from every
      measurement.
    - `optics`: the lens, as a `Blur` of the high-resolution picture; "estimate" for the Gaussian one that predicts
      held-out pixels best, at the cost of seven solves (`estimate_gaussian_optics`). None: a perfect lens.
    - `quality`: "fast", the default, or "best": a network restores the solution, and Eq. 4 is solved again with the
      prior centred at the network's picture (`scsr_opt.pipeline.restoration`), in one to four times the time. If the
      result predicts held-out samples worse than the picture without the network, the latter is solved for. A
      `Restoration` takes the place of that network.
    - `prior`: Ψ; if None, the learned `RidgeRegulariser` up to a scale of 3, above it `HuberTotalVariation`.
    - `strength`: λ; if None, the one that predicts held-out intervals best (`StrengthSearch`), or, with a robust
      loss, the one that follows from the noise. `PlugAndPlay` needs one.
    - `robust`: ρ(e) in the place of e²/2: `Huber()` or `Welsch()`, by reweighting. No intervals are merged then.
    - `solver`: if None, `FISTA`, or where nothing moves `DataProximal` (`default_solver`). Its limit of iterations
      holds for the whole solve, corrections of exposures included; with `robust`, for each of up to eleven rounds.
    - `refine`: how many times the motion is fitted again to the solved picture, and the picture solved for again.
    - `shortcuts`: the work that is left out where a scene does not need it.
    - `crop`: (top, left, height, width) of the part of the sensor that is solved for, sensor pixels; all if None.
      `bad_pixels`, `gain` and `dark` may be those of the whole sensor or of the part; `motion`, `optics` and `state`
      are those of the part.
    - `light`: where lamps flicker or clouds pass, "mean" gives the scene at its mean light (over whole cycles if the
      light is periodic), "key" at the light of the key frame. "constant": changes of the light are not searched for.
    - `keep_images`: whether every stage keeps its pictures.
    - `settings`: thresholds of every stage, which rarely need to be changed (docs/settings.md).
    """

    frames: SupportsIndex = USUAL_FRAMES
    white_rate: SupportsFloat | None = None
    motion: Motion | Estimator | None = None
    bad_pixels: ArrayLike | BadPixels | Literal["auto"] | None = "auto"
    samples: SamplingRule | None = None
    gain: ArrayLike | Literal["auto", "blind"] | None = "auto"
    dark: ArrayLike | None = None
    optics: Blur | Literal["estimate"] | None = None
    quality: str | Restoration = "fast"
    prior: Prior | None = None
    strength: SupportsFloat | None = None
    robust: Loss | None = None
    solver: Solver | None = None
    refine: SupportsIndex = 0
    shortcuts: Shortcuts = field(default_factory=Shortcuts)
    crop: Sequence[SupportsIndex] | np.ndarray | None = None
    light: Literal["mean", "key", "constant"] = "mean"
    keep_images: bool = False
    settings: PipelineSettings = field(default_factory=PipelineSettings)

    @classmethod
    def of(cls, options: "Options | None", changes: dict[str, Any]) -> "Options":
        """`options`, or the defaults, with these fields changed.

        **Raises:** `InputError` for a field that there is not.
        """
        check_type(options, cls, "options", "Options(strength=0.01)")
        known = [one.name for one in fields(cls)]
        for name in changes:
            if name not in known:
                near = get_close_matches(name, known, 1)
                hint = f" (did you mean {near[0]}?)" if near else ""
                raise InputError(f"There is no option {name!r}{hint}; there are {', '.join(known)}.")
        return dataclasses.replace(options or cls(), **changes)

    def validated(self, recording: Recording, scale: int) -> "Options":
        """These options for a recording and scale: checked, arrays copied and cut to the crop, and the default prior
        and sampling rule in the place of None.

        **Raises:** `InputError` for what cannot be used.
        """
        sensor, crop = (recording.height, recording.width), None if self.crop is None else rectangle(self.crop)
        height, width = sensor
        if crop is not None:
            recording.crop(*crop)  # refuses a rectangle that reaches outside
            height, width = crop[2:]
        gain = self.gain
        if not (self.finds_gain or gain is None):
            gain = pixel_gain(cut_out(gain, sensor, crop), height, width)
        dark = None if self.dark is None else pixel_dark(cut_out(self.dark, sensor, crop), height, width)
        if self.light not in ("mean", "key", "constant"):
            raise InputError(f"light is {shown(self.light)}; it must be 'mean', 'key' or 'constant'.")
        check_type(self.samples, SamplingRule, "samples", "Intervals()")
        check_type(self.prior, Prior, "prior", "HuberTotalVariation()")
        check_type(self.solver, Solver, "solver", "FISTA()")
        check_type(self.robust, Loss, "robust", "Huber()")
        for name, kind in (("shortcuts", Shortcuts), ("settings", PipelineSettings)):
            if getattr(self, name) is None:
                raise InputError(f"{name} is None; leave it out for the defaults, or give {kind.__name__}(…).")
        check_type(self.shortcuts, Shortcuts, "shortcuts", "Shortcuts.none()")
        check_type(self.settings, PipelineSettings, "settings", "PipelineSettings()")
        check_type(self.lens, Blur, "optics", "Blur.gaussian(shape, sigma), or 'estimate'")
        if self.restores:
            self._check_restoration(scale)
        prior = self.prior
        if prior is None:
            prior = default_prior(scale, scale if self.restores else self.settings.learned_prior_scale)
        if self.solver is not None:
            self.solver.check(prior)
        motion, bad = self.motion, self.bad_pixels
        if isinstance(bad, str) and bad != "auto":
            raise InputError(f"bad_pixels is {shown(bad)}; it must be 'auto', None, or a mask of shape {sensor}.")
        if not self.finds_bad_pixels and bad is not None:
            bad = bad_pixels_in(bad, sensor, crop)
        if isinstance(motion, Motion):
            motion = validate_motion(motion, height, width)
        elif not isinstance(motion, Estimator | None):
            raise InputError(
                f"motion is {shown(self.motion)}; it must be a Motion, such as Motion.constant((0.1, 0.2), ({height}, "
                f"{width})) or Motion.of_velocity(array), or an Estimator such as Global()."
            )
        strength = None if self.strength is None else prior_strength(self.strength)
        if strength is None:
            relative_strength(prior)  # a prior without one is refused before anything is computed
        prior.check(picture_shape((height, width), scale))
        return dataclasses.replace(
            self,
            samples=Intervals() if self.samples is None else self.samples,
            motion=motion,
            bad_pixels=bad,
            gain=gain,
            dark=dark,
            crop=crop,
            prior=prior,
            strength=strength,
            frames=whole(self.frames, "frames", 1),
            white_rate=None if self.white_rate is None else checked_white_rate(self.white_rate),
            refine=whole(self.refine, "refine", 0),
            keep_images=flag(self.keep_images, "keep_images"),
        )

    @property
    def lens(self) -> Blur | None:
        """The lens, where it is known before the recording is looked at."""
        return None if self.estimates_optics else self.optics  # type: ignore[return-value]

    @property
    def estimates_optics(self) -> bool:
        """True where the lens is to be estimated."""
        return isinstance(self.optics, str) and self.optics == "estimate"

    @property
    def restores(self) -> bool:
        """True where a network restores the solution, and Eq. 4 is solved again about its picture."""
        return not (isinstance(self.quality, str) and self.quality == "fast")

    def restoration(self, scale: int) -> Restoration | None:
        """The restoration of a solution at this scale, None with `quality="fast"`. **Raises:** as `restoration_of`."""
        if not self.restores:
            return None
        return self.quality if isinstance(self.quality, Restoration) else restoration_of(scale)

    def _check_restoration(self, scale: int) -> None:
        """**Raises:** `InputError` if the solution cannot be restored."""
        if not isinstance(self.quality, Restoration) and not (isinstance(self.quality, str) and self.quality == "best"):
            raise InputError(f"quality is {shown(self.quality)}; it must be 'fast', 'best' or a Restoration.")
        if self.robust is not None:
            raise InputError(
                f"quality is 'best' and robust is {type(self.robust).__name__}, but only solutions with squares are "
                f"restored: leave robust out, or take quality='fast'."
            )
        if isinstance(self.quality, str) and not isinstance(self.prior, RidgeRegulariser | None):
            raise InputError(
                f"quality is 'best' and the prior is {type(self.prior).__name__}, but the network restores solutions "
                f"with RidgeRegulariser: leave prior out, or take quality='fast'."
            )
        self.restoration(scale)

    @property
    def finds_bad_pixels(self) -> bool:
        """True where bad pixels are to be found from the recording."""
        return isinstance(self.bad_pixels, str) and self.bad_pixels == "auto"

    @property
    def finds_gain(self) -> bool:
        """True where gains of pixels are to be found from the recording."""
        return isinstance(self.gain, str) and self.gain in ("auto", "blind")

    @property
    def most_frames(self) -> int:
        """Frames around a key frame, at most, that are read for its picture: those that are used, and those by which
        bad pixels and changes of the light are found."""
        read = [int(self.frames)]
        if self.finds_bad_pixels:
            read.append(self.settings.bad_pixels.evidence_frames)
        if self.light != "constant":
            read.append(self.settings.motion.light.stretch_frames)
        return max(read)

    @property
    def known_gain(self) -> Float[np.ndarray, "h w"] | None:
        """The gains that were given, (h, w); None for 1, and where they are to be found."""
        return None if self.finds_gain else self.gain  # type: ignore[return-value]

    @property
    def selects_strength(self) -> bool:
        """True where λ is validated on held-out samples; with a robust loss outliers among them would decide."""
        return self.strength is None and self.robust is None

    @property
    def samples_apart(self) -> bool:
        """True where no samples are merged: with a robust loss, the mean of several would hide an outlier."""
        return self.robust is not None


def bad_pixels_in(bad: Any, sensor: tuple[int, int], crop: tuple[int, int, int, int] | None) -> BadPixels:
    """Bad pixels that were given, of the sensor or of `crop`, in that part. **Raises:** `InputError` if no mask."""
    found = bad.kind if isinstance(bad, BadPixels) else None
    part = cut_out(bad if found is None else found, sensor, crop)
    shape = sensor if crop is None else crop[2:]
    if found is not None and part.shape == shape:
        return BadPixels(part.copy())
    return BadPixels.given(checked_mask(part, shape))


def cut_out(values: Any, sensor: tuple[int, int], crop: tuple[int, int, int, int] | None) -> Any:
    """`values` for the pixels of `crop`: cut out where they are given for each pixel of the sensor, (…, h, w)."""
    if values is None or crop is None:
        return values
    array = as_array(values, "An array of the pixels")
    if array.shape[-2:] != sensor:
        return values
    top, left, height, width = crop
    return array[..., top : top + height, left : left + width]
