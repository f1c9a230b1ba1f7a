"""`MotionSettings`: the numbers that motion estimation hinges on; here those that all estimators share.

Lengths are sensor pixels, times are frames. "Along a motion" means after each short picture of the recording
(`MotionFrames`) has been moved to the key frame by that motion. Those of single estimators are in
`scsr_opt.motion.estimators.settings`, those of the light and of trajectories in modules of their own.
"""

from dataclasses import dataclass, field

from scsr_opt._settings import Settings
from scsr_opt.motion.estimators.settings import (
    ChoiceSettings,
    DenseSettings,
    FlowSettings,
    LayerSettings,
    ParametricSettings,
    PhaseSettings,
    ReachSettings,
)
from scsr_opt.motion.light_settings import LightSettings
from scsr_opt.motion.trajectory_settings import TrajectorySettings


@dataclass(frozen=True, kw_only=True)
class FrameSettings(Settings):
    """How a recording is cut into short pictures (`motion_frames`)."""

    above_zero = frozenset({"most_pictures", "frames_per_picture"})

    most_pictures: int = 25
    """Short pictures of a recording, at most: every comparison costs time in proportion to their number."""
    frames_per_picture: int = 4
    """Frames of the recording per short picture, at least: in shorter ones most pixels would share their intervals with
    the next."""
    trimmed_from_frames: int = 16
    """Frames from which on the ends of a recording are left out of the pictures; shorter recordings are used whole."""
    measured_pixels_share: float = 0.85
    """Share of the pixels that must have fired before the first picture begins, and fire again after the last one."""
    trimmed_share: float = 0.2
    """Share of the recording, at most, that is left out at each end because pixels have not fired yet or any more."""
    repair_window_px: float = 2.0
    """Standard deviation of the Gaussian window in which good pixels around a bad one are counted."""
    repair_good_share: float = 0.2
    """Share of good pixels in that window from which on a bad pixel may contradict a motion."""


@dataclass(frozen=True, kw_only=True)
class ComparisonSettings(Settings):
    """How pictures are compared along a motion; shared by all stages."""

    above_zero = frozenset({"window_px", "presmoothing_px", "neighbourhood_px"})

    presmoothing_px: float = 1.0
    """Gaussian presmoothing of pictures before they are compared, so that aliasing between pixels does not count as
    disagreement."""
    presmoothing_cutoff_sigmas: float = 4.0
    """Standard deviations at which that Gaussian is cut off. A cut at 3 passes a little of all frequencies: two layers
    then seemed to serve an object as well as three did, at a loss of 1 dB."""
    near_times_frames: tuple[float, float, float] = (8.0, 16.0, 32.0)
    """Distances from the key frame within which pictures take part, level by level; the last level has all of them.
    Within 8 frames hardly anything moves further than the presmoothing, and each level doubles the reach."""
    window_px: float = 3.0
    """Gaussian window over which texture, noise and rates of firing are averaged: some 100 pixels."""
    neighbourhood_px: float = 1.5
    """Gaussian neighbourhood that decides together where edges have to stay in place (labels, squared residuals)."""
    residual_cap: float = 6.0
    """Largest squared residual that counts, in units of the noise variance: surfaces that are hidden for a while have
    large residuals along any motion."""
    key_picture_frames: float = 10.0
    """Distance from the key frame within which pictures are averaged to the one that a motion moves to the moments of
    all others."""
    picture_step: int = 3
    """Step from one predicted picture to the next where motions are compared."""
    sparse_step: int = 2
    """Step between rows and columns of a sparse grid of pixels."""
    least_side_px: int = 8
    """Least side of a picture, or of the overlap of two, for a window or a correlation."""


@dataclass(frozen=True, kw_only=True)
class EvidenceSettings(Settings):
    """When a pixel contradicts a motion, and which pixels can (`estimators/evidence.py`)."""

    contradiction_likelihood: float = 100.0
    """Twice the gain in log-likelihood by which another velocity has to explain a window better. A χ² value with 2
    degrees of freedom if the noise were white; on scenes at rest the largest was 80, the median 3.5."""
    contradiction_px: float = 0.5
    """Displacement over the recording by which that other velocity has to differ."""
    tolerated_share_at_rest: float = 0.001
    """Share of the pixels that may contradict that nothing moves."""
    smear_px: float = 1.4
    """Motion between two spikes of a pixel, the diagonal of a pixel, above which the pixel is not observable: surfaces
    that pass within one interval seem to rest. Without this limit a tenth of the pixels contradicted a true velocity of
    0.3 px per frame by day; with 1 px a car in dim light was not detected."""
    spikes_at_rest: float = 2.0
    """Spikes within the pictures from which on a pixel can be certainly at rest. With fewer, most pictures show the
    same interval: up to four fifths of dim or short pans seemed to rest; with two spikes, 0.05 at most."""
    counted_moments: int = 3
    """Pictures in which a point has to be in view for its counts of spikes to be compared."""
    counts_variance_ratio: float = 0.98
    """Variance of the counts along a motion, relative to that at rest, below which they agree with the motion: 0.74 to
    0.82 along the true velocity of dim pans, 0.88 to 0.97 of recorded clips."""
    counts_worse_share: float = 0.02
    """Share of the places at which the counts may vary more than at rest: up to 0.018 on pans, 0.054 of a dim clip in
    which a car does not move with the rest."""


@dataclass(frozen=True, kw_only=True)
class ReliabilitySettings(Settings):
    """The trust in a motion, moment by moment (`with_trust`)."""

    key_picture_frames: float = 2.0
    """Standard deviation of the Gaussian in time whose mean is the picture that all others are compared with."""
    chance_ratio: float = 3.0
    """Squared difference, in units of the noise of one picture, up to which pictures agree; it is 2 by chance."""
    error_weight: float = 8.0
    """Factor by which an error of the motion counts more than noise: it is the same for many samples and does not
    average out. From 4 to 10 video clips gained 0.1 to 0.2 dB, layered scenes lost 0.05 dB."""
    steady_worth: float = 0.5
    """Least trust from which on pixels at rest have their mean trust at all times, so that one merged measurement
    suffices. The differences of weights would have reduced an error by half at most."""


@dataclass(frozen=True, kw_only=True)
class MotionSettings(Settings):
    """Thresholds of motion estimation, by stage. Hashable: programs are compiled for the settings they use."""

    frames: FrameSettings = field(default_factory=FrameSettings)
    """Short pictures of the recording."""
    comparison: ComparisonSettings = field(default_factory=ComparisonSettings)
    """Comparison of pictures along a motion."""
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    """Contradiction test."""
    choice: ChoiceSettings = field(default_factory=ChoiceSettings)
    """Choice between kinds of motion."""
    parametric: ParametricSettings = field(default_factory=ParametricSettings)
    """One motion of few numbers."""
    layers: LayerSettings = field(default_factory=LayerSettings)
    """Layers."""
    dense: DenseSettings = field(default_factory=DenseSettings)
    """One motion for each pixel."""
    phase: PhaseSettings = field(default_factory=PhaseSettings)
    """Phase correlation."""
    flow: FlowSettings = field(default_factory=FlowSettings)
    """Optical flow."""
    reliability: ReliabilitySettings = field(default_factory=ReliabilitySettings)
    """Trust."""
    reach: ReachSettings = field(default_factory=ReachSettings)
    """Reach in time of a dense motion."""
    trajectory: TrajectorySettings = field(default_factory=TrajectorySettings)
    """Inverse motion and visibility."""
    light: LightSettings = field(default_factory=LightSettings)
    """Changes of the light."""


DEFAULTS = MotionSettings()
"""Settings that are used where none are given."""
