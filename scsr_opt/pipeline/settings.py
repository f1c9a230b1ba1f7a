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
    """From spikes to samples and their places (`scsr_opt.pipeline.measurement`, `scsr_opt.pipeline.visibility`)."""

    above_zero = frozenset({"merged_weight_change", "cut_remaining_frames"})

    merged_motion_px: float = 0.25
    """High-resolution pixels by which what a pixel sees may move while its intervals are merged: below the blur of the
    aperture itself."""
    merged_weight_change: float = 0.25
    """Change of a pixel's weight, of 1, during which its intervals are merged."""
    merged_least_frames: int = 16
    """Frames for which a pixel has to be still to count as one whose intervals are worth merging."""
    merged_least_share: float = 0.25
    """Share of such pixels from which on intervals are merged: apart, they also validate the strength."""
    run_motion_px: float = 1.875
    """Sensor pixels by which what a saturated pixel sees may move during a merged run of intervals of one frame: five
    positions then lie 3/8 of a sensor pixel apart."""
    steady_weight_change: float = 0.125
    """Change of a pixel's weight during such a run, or an exposure with a single position: both have one weight while
    something comes into view, and a run that leaves the picture is lost as a whole."""
    positions_motion_px: tuple[float, float, float] = (0.7, 0.5, 0.1)
    """Sensor pixels of motion during an exposure from which on it gets 5, 3 and 2 positions. What is read is the
    picture through an aperture of one pixel, and of that they miss at most 0.0013; where they miss 0.003, the
    validated strength changes."""
    two_positions_least_share: float = 1e-4
    """Share of the weight up to which samples that need two positions get one, where none needs more: a few long
    intervals of dark pixels would put all samples through rounds of corrections."""
    light_smoothing_px: float = 1.5
    """Standard deviation, sensor pixels, of the mean light by which a noise model weights samples."""
    visible_least_share: float = 0.5
    """Share of a pixel's highest weight from which on it counts as seen; below, its intervals are cut."""
    cut_least_frames: int = 8
    """Frames from which on an interval is cut where it is seen for a part of its exposure."""
    cut_remaining_frames: int = 4
    """Frames that have to be left of it: half a spike's light in a frame or two is too rough to be of use."""
    initial_image_frames: int = 21
    """Frames around the key frame whose firing rate is the initial image."""


@dataclass(frozen=True, kw_only=True)
class StrengthSettings(Settings):
    """Search for the strength λ of the prior (`scsr_opt.pipeline.strength`, `scsr_opt.pipeline.folds`)."""

    above_zero = frozenset({"noise_pixels", "most_parts"})

    noise_factor: float = 0.06
    """λ = noise_factor · √(noise / frames) · 2/s · `Prior.relative_strength`. The root is how far noise moves the
    gradient of f at a pixel; the factor is that of stills with known answers, in two lights and at two scales."""
    noise_pixels: int = 5_000
    """Sensor pixels, about, whose intervals tell the noise: their mean square is known to half a percent."""
    held_out_every: int = 5
    """One sample in this number is held out."""
    held_out_motion_px: float = 1.0
    """Sensor pixels that the scene has to move at a pixel for other pixels to see what this one sees: all its samples
    may then be held out, and else only stretches of time."""
    held_out_frames: int = 8
    """Frames, at least, of a stretch of time that is held out. Each gap adds an error at both its ends."""
    least_samples: int = 100
    """Samples that have to be kept, and to be held out; fewer tell nothing."""
    part_px: int = 256
    """Side of a part of the picture that λ is validated on, high-resolution pixels."""
    most_parts: int = 3
    """Parts, at most: one alone may ask for a quarter or for four times of what the whole does."""
    iterations: int = 60
    """Iterations, at most, of a solve that a strength is tried by."""
    tolerance: float = 5e-4
    """Tolerance of such a solve; it need not be solved to the end."""
    least_tried: float = 0.25
    """Smallest strength that is tried, in strengths by noise."""
    most_tried: float = 16.0
    """Largest one, of intervals."""
    most_tried_windows: float = 256.0
    """Largest one, of other samples: windows want 4 to 64 times as much (docs/data-term.md)."""
    raised_by: tuple[float, float] = (1.4, 1.7)
    """Factor from the strength that predicts best to the one that gives the best picture, where stretches of time are
    held out and where pixels are: held-out samples tell what a sensor pixel sees, which needs less of a prior than
    what lies between."""
    least_by_noise: tuple[float, float] = (0.7, 0.4)
    """Least strength, in strengths by noise, for the same two: a smaller one lost more often than not."""
    ridge_factor: float = 0.65
    """a, where Huber-TV stands in for `RidgeRegulariser` and predicts best at k strengths by noise: the strength of the
    latter is a·kᵇ (measured). It knows pictures better, and noise moves it less."""
    ridge_exponent: float = 0.6
    """b of that."""


@dataclass(frozen=True, kw_only=True)
class OuterLoopSettings(Settings):
    """Corrections of exposures and reweighting during a solve (`scsr_opt.pipeline.outer_loop`)."""

    correction_tolerances: float = 30.0
    """Distance, in tolerances of the solver, from where the quadratic touches the data term to the picture, above which
    exposures are corrected again. With one step size for each pixel pictures are as good as at 10 with one for all."""
    tile_correction_tolerances: float = 40.0
    """Distance, in tolerances, within a tile above which its exposures are corrected: the mean over the picture hides
    it."""
    few_rows_share: float = 0.5
    """Share of the rows of tiles up to which the far tiles alone are corrected: of more rows hardly a sample is left
    out."""
    correction_extrapolation: float = 0.7
    """Share of the picture's change since the last correction by which the next one is made ahead of it, where the next
    iterations lead. At 1 the solve took half as long again, or did not end."""
    reweighting_rounds: int = 10
    """Rounds of a robust loss after the first solve, at most."""
    reweighting_tolerances: float = 5.0
    """Tolerance of all these rounds but the last, in tolerances of the solver."""
    reweighting_settled_tolerances: float = 10.0
    """Change of the picture, in tolerances of the solver, below which the next round is the last one."""


@dataclass(frozen=True, kw_only=True)
class RefinementSettings(Settings):
    """Refinement of the motion against the picture (`scsr_opt.pipeline.motion_refinement`). Distances in sensor pixels
    are those at the moment farthest from the key frame."""

    samples: int = 1 << 17
    """Samples, at most, that a motion of few numbers is refined on: 10⁵ to a number would add nothing."""
    steps: int = 12
    """Steps of Levenberg–Marquardt, at most."""
    least_step_px: float = 1e-3
    """Change, sensor pixels, at which they end."""
    exact_px: float = 0.01
    """Distance, sensor pixels, to which a few numbers have to give a motion for it to be refined by these."""
    outlier_deviations: float = 3.0
    """Standard deviations from which on a residual loses weight: no noise is that large."""
    smoothing_px: float = 3.0
    """Standard deviation, sensor pixels, of the window whose samples decide a pixel's velocity."""
    most_step_px: float = 0.5
    """Sensor pixels by which a velocity may change in one step; also its standard deviation as known beforehand."""
    inversion_steps: int = 4
    """Fixed-point steps that find the place in the key frame of what a pixel sees."""


@dataclass(frozen=True, kw_only=True)
class SceneSummarySettings(Settings):
    """Limits of the kinds of tiles in a scene summary, which decides nothing (`scsr_opt.pipeline.scene_summary`)."""

    above_zero = frozenset({"tile_px"})

    tile_px: int = 16
    """Side of a tile, sensor pixels."""
    dark_spikes: float = 4.0
    """Spikes a pixel below which a tile is dark: a pixel then tells next to nothing alone."""
    still_share: float = 0.5
    """Share of a tile's pixels that must be still over the whole recording for the tile to be at rest."""
    used_share: float = 0.5
    """Share of a tile's light that must be usable: with less, most of what it sees is out of view in the key frame."""
    false_alarms: float = 1e-3
    """Chance that a tile without texture is taken for one with texture, one with enough spikes for dark, or one that
    has frames without a spike for saturated."""


@dataclass(frozen=True, kw_only=True)
class SequenceSettings(Settings):
    """Values that the next picture of a sequence takes over from the last one (`scsr_opt.pipeline.sequence`)."""

    carried_frames: int = 100
    """Frames over which a motion is carried on, at most: as long as some of the frames that it was estimated from are
    used. On a car passing, moving pixels that were held out were predicted as well as by a motion estimated anew after
    5 to 100 frames."""
    contradicted_factor: float = 4.2
    """A motion is estimated anew where the share of the pixels that contradict it has grown by this factor, and by
    `contradicted_share`. On that car, whose motion lasts, it grew from 6 % by factors of 1.3 to 4.2 after 5 to 95
    frames."""
    contradicted_share: float = 0.005
    """Share of all pixels that has to contradict it in any case."""
    tolerance_factor: float = 2.0
    """Tolerance of a solve that starts from the picture before, in tolerances of the solver: from there a residual is
    met nearer to the minimum. 2 instead of 1.5 added at most 0.002 % to the objective, 3 at most 0.006 %."""
    seen_share: float = 0.1
    """Share of the mean weight below which a picture starts from playback: what has come into view was not in the
    picture before, and what stands there instead goes slowly, as only the prior decides."""


@dataclass(frozen=True, kw_only=True)
class PipelineSettings(Settings):
    """Thresholds of every stage."""

    motion: MotionSettings = field(default_factory=MotionSettings)
    """Estimation of motion, where no estimator is given."""
    bad_pixels: BadPixelSettings = field(default_factory=BadPixelSettings)
    """Bad pixels, where they are to be found."""
    gain: GainSettings = field(default_factory=GainSettings)
    """Gains of the pixels, where they are to be found."""
    optics: OpticsSettings = field(default_factory=OpticsSettings)
    """Blur of the lens, where it is to be found."""
    sampling: SamplingSettings = field(default_factory=SamplingSettings)
    """Samples, their places, and the initial image."""
    learned_prior_scale: int = 3
    """Largest scale at which `RidgeRegulariser` is the prior of those who name none. It is worth 0.7 dB at ×2, 0.3 at
    ×3 and 0.15 at ×4, where a full sensor would take twice as long."""
    strength: StrengthSettings = field(default_factory=StrengthSettings)
    """Strength of the prior, where none is given."""
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
    """Summary of the scene for people."""
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    """Pictures of a sequence, each from the one before."""
    white: WhiteSettings = field(default_factory=WhiteSettings)
    """White of 8-bit pictures, figures and films."""
