"""Settings of the stages of the pipeline, and `PipelineSettings`, all numbers that a reconstruction hinges on.

Each field has a default that needs no tuning; `python -m benchmarks.sensitivity` moves each by half and reports what
that changes. docs/settings.md says how to change one.
"""

from dataclasses import dataclass, field

from scsr_opt._settings import Settings
from scsr_opt.calibration.settings import BadPixelSettings, GainSettings, OpticsSettings
from scsr_opt.camera.white import WhiteSettings
from scsr_opt.motion.settings import MotionSettings
from scsr_opt.solvers.settings import TileSettings


@dataclass(frozen=True, kw_only=True)
class SamplingSettings(Settings):
    """Making samples and their places from spikes (`scsr_opt.pipeline.measurement`, `scsr_opt.pipeline.visibility`)."""

    above_zero = frozenset({"merged_weight_change", "cut_remaining_frames"})

    merged_motion_px: float = 0.25
    """High-resolution pixels by which the surface that a pixel sees may move while the pixel's intervals are merged:
    less than the blur by the aperture."""
    merged_weight_change: float = 0.25
    """Change of a pixel's visibility, relative to 1, during which its intervals are merged."""
    merged_least_frames: int = 16
    """Frames for which a pixel has to rest for its intervals to be worth merging."""
    merged_least_share: float = 0.25
    """Share of such pixels from which on intervals are merged. Single intervals are also held out to validate the
    strength."""
    run_motion_px: float = 1.875
    """Sensor pixels by which the surface that a saturated pixel sees may move while a run of its intervals of one frame
    is merged: five positions then lie 3/8 of a sensor pixel apart."""
    steady_weight_change: float = 0.125
    """Change of a pixel's visibility during such a run, or during an exposure with a single position. A run has one
    weight, so a larger change would give samples of a hidden surface too much of it."""
    positions_motion_px: tuple[float, float, float] = (0.7, 0.5, 0.1)
    """Sensor pixels of motion during an exposure from which on it gets 5, 3 and 2 positions. Sums over fewer positions
    miss at most 0.0013 of the light (docs/data-term.md); where they miss 0.003, the validated strength changes."""
    two_positions_least_share: float = 1e-4
    """Share of the total weight up to which samples that need two positions get one, if none needs more. Otherwise a
    few long intervals of dark pixels would cause corrections of all exposures."""
    light_smoothing_px: float = 1.5
    """Standard deviation, sensor pixels, of the Gaussian that smooths the mean light for weights by a noise model."""
    visible_least_share: float = 0.5
    """Share of a pixel's largest visibility from which on it counts as seen; intervals that fall below it are cut."""
    cut_least_frames: int = 8
    """Frames from which on an interval is cut if its surface is seen during a part of the exposure only."""
    cut_remaining_frames: int = 4
    """Frames that have to remain of such an interval: half a spike's light within a frame or two is too inaccurate to
    be of use."""
    initial_image_frames: int = 21
    """Frames around the key frame whose firing rate gives the initial image."""


@dataclass(frozen=True, kw_only=True)
class StrengthSettings(Settings):
    """Search for the strength λ of the prior (`scsr_opt.pipeline.strength`, `scsr_opt.pipeline.folds`)."""

    above_zero = frozenset({"noise_pixels", "most_parts"})

    noise_factor: float = 0.06
    """λ = noise_factor · √(noise / frames) · 2/s · `Prior.relative_strength`. The root is the standard deviation that
    noise gives the gradient of f at a pixel; the factor was found on stills with known truth, in two lights and at two
    scales."""
    noise_pixels: int = 5_000
    """Sensor pixels, about, from whose intervals the noise is estimated: its mean square is then known to half a
    percent."""
    held_out_every: int = 5
    """One sample in this number is held out."""
    held_out_motion_px: float = 1.0
    """Sensor pixels that the scene has to move at a pixel for other pixels to see the same places. All samples of a
    pixel may then be held out; otherwise only stretches of time."""
    held_out_frames: int = 8
    """Frames, at least, of a stretch of time that is held out. Each gap adds an error at both its ends."""
    least_samples: int = 100
    """Samples that have to be kept, and samples that have to be held out; fewer give no reliable error."""
    part_px: int = 256
    """Side, high-resolution pixels, of a part of the picture on which λ is validated."""
    most_parts: int = 3
    """Parts, at most. From a single part λ may come out a quarter or four times of that of the whole picture."""
    iterations: int = 60
    """Iterations, at most, of the solve for each strength that is tried."""
    tolerance: float = 5e-4
    """Tolerance of such a solve, which need not converge fully."""
    least_tried: float = 0.25
    """Smallest strength that is tried, in units of the strength by noise."""
    most_tried: float = 16.0
    """Largest strength that is tried with intervals, in the same unit."""
    most_tried_windows: float = 256.0
    """Largest strength that is tried with other samples: windows need 4 to 64 times as much (docs/data-term.md)."""
    raised_by: tuple[float, float] = (1.4, 1.7)
    """Factors from the strength that predicts best to the one of the best picture, if stretches of time are held out
    and if whole pixels are. Held-out samples measure means over sensor pixels, which need a weaker prior than detail
    between them."""
    least_by_noise: tuple[float, float] = (0.7, 0.4)
    """Least strength, in units of the strength by noise, for the same two cases: smaller ones gave a worse picture more
    often than a better one."""
    ridge_factor: float = 0.65
    """Factor a. If Huber-TV, in the place of `RidgeRegulariser` during the search, predicts best at k strengths by
    noise, the strength for the ridge regulariser is a·kᵇ (measured)."""
    ridge_exponent: float = 0.6
    """Exponent b of that rule."""
    restoration_deviations: float = 3.0
    """Standard deviations by which a restored picture has to predict held-out samples worse than the usual picture for
    the usual one to be taken: the usual level beyond chance. A margin is needed because held-out samples tell little of
    detail within sensor pixels, and nothing where the scene rests: chance alone would decide there."""


@dataclass(frozen=True, kw_only=True)
class OuterLoopSettings(Settings):
    """Corrections of exposures and reweighting during a solve (`scsr_opt.pipeline.outer_loop`)."""

    restored_tolerances: float = 3.0
    """Tolerance of a solution that a network restores, in tolerances of the solver, above `learned_prior_scale`. At ×4,
    3 instead of 1 lost 0.01 dB in the mean over twelve stills, and the car took 9.1 s instead of 11.2 s; at ×2 it would
    lose 0.04 dB and gain no time."""
    correction_tolerances: float = 30.0
    """Distance of the picture, in tolerances of the solver, from the picture at which the quadratic touches the data
    term, above which exposures are corrected again. With a step size for each pixel, pictures are as good as with a
    distance of 10 and one step size for all."""
    tile_correction_tolerances: float = 40.0
    """Distance of a tile of the picture from that at which the quadratic touches, in tolerances of the solver, above
    which the tile's exposures are corrected; the mean over the picture would hide it."""
    few_rows_share: float = 0.5
    """Share of the rows of tiles up to which only the tiles that exceed that distance are corrected. With more rows
    hardly a sample would be left out."""
    correction_extrapolation: float = 0.7
    """Share of the picture's change since the last correction by which the picture is extrapolated for the next one.
    With 1 the solve took half as long again, or did not converge."""
    reweighting_rounds: int = 10
    """Rounds of a robust loss after the first solve, at most."""
    reweighting_tolerances: float = 5.0
    """Tolerance of all these rounds except the last, in tolerances of the solver."""
    reweighting_settled_tolerances: float = 10.0
    """Change of the picture, in tolerances of the solver, below which the next round is the last one."""


@dataclass(frozen=True, kw_only=True)
class RefinementSettings(Settings):
    """Refinement of the motion against the picture (`scsr_opt.pipeline.motion_refinement`). Distances in sensor pixels
    are those at the moment farthest from the key frame."""

    samples: int = 1 << 17
    """Samples, at most, on which a motion of few numbers is refined: more would not determine them better."""
    steps: int = 12
    """Steps of Levenberg–Marquardt, at most."""
    least_step_px: float = 1e-3
    """Change, sensor pixels, at which these steps end."""
    exact_px: float = 0.01
    """Error, sensor pixels, with which a few numbers have to describe a motion for the motion to be refined by these
    numbers."""
    outlier_deviations: float = 3.0
    """Standard deviations from which on the weight of a residual falls: noise is seldom larger."""
    smoothing_px: float = 3.0
    """Standard deviation, sensor pixels, of the window whose samples determine a pixel's velocity."""
    most_step_px: float = 0.5
    """Sensor pixels by which a velocity may change in one step; also the prior standard deviation of the velocity."""
    inversion_steps: int = 4
    """Fixed-point steps that find the place in the key frame of the surface that a pixel sees."""


@dataclass(frozen=True, kw_only=True)
class SceneSummarySettings(Settings):
    """Limits of the kinds of tiles in a scene summary, for information only (`scsr_opt.pipeline.scene_summary`)."""

    above_zero = frozenset({"tile_px"})

    tile_px: int = 16
    """Side of a tile, sensor pixels."""
    dark_spikes: float = 4.0
    """Spikes per pixel below which a tile counts as dark: a single pixel then has next to no information."""
    still_share: float = 0.5
    """Share of a tile's pixels that must rest over the whole recording for the tile to be at rest."""
    used_share: float = 0.5
    """Share of a tile's light that must be usable: with less, most of the surfaces that the tile sees are not visible
    in the key frame."""
    false_alarms: float = 1e-3
    """Probability that a tile without texture counts as textured, one with enough spikes as dark, or one that has
    frames without a spike as saturated."""


@dataclass(frozen=True, kw_only=True)
class SequenceSettings(Settings):
    """What is carried on from one picture of a sequence to the next (`scsr_opt.pipeline.sequence`)."""

    carried_frames: int = 8
    """Frames over which a motion is carried on, at most. In pictures of a passing car, dark specks along its upper edge
    appear after 20 frames, where the labels of the layers have come loose, and the trees behind it may blur after 30.
    A picture with carried motion differs from one that is solved for alone by 0.02 rms from the first frame on, as far
    as two estimates of the motion differ; pictures ten frames apart have a motion of their own and do not. Masked
    pixels show nothing of that: after 5 to 100 frames they are predicted as well as by a motion that was estimated
    again."""
    contradicted_factor: float = 4.2
    """A motion is estimated again if the share of the pixels that contradict it has grown by this factor, and by
    `contradicted_share`. In that recording, whose motion stays valid, it grew from 6 % by factors of 1.3 to 4.2 after 5
    to 95 frames."""
    contradicted_share: float = 0.005
    """Growth of the share of contradicting pixels that is required in any case."""
    tolerance_factor: float = 2.0
    """Tolerance of a solve that starts from the picture before, in tolerances of the solver: from there, the same
    residual means a smaller distance to the minimum. 2 instead of 1.5 added at most 0.002 % to the objective, 3 at most
    0.006 %."""
    seen_share: float = 0.1
    """Share of the mean weight below which a pixel starts from playback. A surface that has come into view was not in
    the picture before, and the old values would change slowly, as only the prior acts there."""


@dataclass(frozen=True, kw_only=True)
class PipelineSettings(Settings):
    """Thresholds of every stage."""

    motion: MotionSettings = field(default_factory=MotionSettings)
    """Estimation of motion, if no estimator is given."""
    bad_pixels: BadPixelSettings = field(default_factory=BadPixelSettings)
    """Search for bad pixels."""
    gain: GainSettings = field(default_factory=GainSettings)
    """Search for gains of the pixels."""
    optics: OpticsSettings = field(default_factory=OpticsSettings)
    """Search for the blur of the lens."""
    sampling: SamplingSettings = field(default_factory=SamplingSettings)
    """Samples, their places, and the initial image."""
    learned_prior_scale: int = 3
    """Largest scale at which `RidgeRegulariser` is the default prior. It is worth 0.7 dB at ×2, 0.3 at ×3 and 0.15 at
    ×4, where a full sensor would take twice as long."""
    strength: StrengthSettings = field(default_factory=StrengthSettings)
    """Strength of the prior, if none is given."""
    data_proximal_steepness: float = 5.0
    """Largest λ·(Lipschitz constant of ∇Ψ)/L with which `DataProximal` is the solver of a scene at rest: it was faster
    than `FISTA` up to 5, and as fast at 6.5."""
    tiles: TileSettings = field(default_factory=TileSettings)
    """Iterations of single tiles."""
    outer_loop: OuterLoopSettings = field(default_factory=OuterLoopSettings)
    """Corrections of exposures, and reweighting."""
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    """Refinement of the motion against the picture."""
    scene_summary: SceneSummarySettings = field(default_factory=SceneSummarySettings)
    """Scene summary, for information only."""
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    """Pictures of a sequence, each of which starts from the one before."""
    white: WhiteSettings = field(default_factory=WhiteSettings)
    """White of 8-bit pictures, figures and films."""
