"""`MotionSettings`: the numbers that motion estimation hinges on.

Lengths are sensor pixels, times are frames. "Along a motion" means after each short picture of the recording
(`MotionFrames`) has been moved to the key frame by that motion.
"""

from dataclasses import dataclass, field

from scsr_opt._settings import Settings


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
class ChoiceSettings(Settings):
    """Thresholds of the choice between rest, one motion for the scene, layers, and one motion for each pixel
    (`Automatic`)."""

    above_zero = frozenset({"light_pixels"})

    tolerated_share_global: float = 0.01
    """Share of the pixels that may contradict one motion for the whole scene."""
    resting_share: float = 0.05
    """Share of the sensor that has to be certainly at rest, single pixels aside, to rule out one motion for the scene:
    up to 0.03 of slow pans by mistake, 0.16 and more of scenes with an object before a background."""
    resting_opening_iterations: int = 2
    """Iterations of the morphological opening that takes single pixels out of those at rest."""
    observable_share: float = 0.5
    """Share of the pixels that has to be observable for a lack of contradiction to count as agreement. Of a dim clip
    with hardly any observable pixel, a fit was wrong by two pixels per frame and not contradicted."""
    out_of_view_share: float = 0.5
    """Share of the picture's side that a scene has to leave by for counts of spikes to decide about its motion."""
    background_ratio: float = 0.5
    """Pixels that contradict one motion for the scene, relative to those that contradict rest, below which it is the
    motion of the background rather than rest."""
    end_share: float = 0.8
    """Distance of the key frame from the middle of the pictures, relative to half their span, above which it lies at an
    end, and motion is estimated from the middle of the recording as well."""
    end_contradiction_ratio: float = 0.75
    """Contradicting pixels of the motion found from the middle, relative to the one from the key frame, below which it
    replaces that one."""
    contradiction_ratio: float = 0.8
    """Contradicting pixels, or prediction residual, relative to the background's, below which a richer motion has
    clearly helped."""
    prediction_ratio: float = 0.97
    """Prediction residual relative to that of the simpler motion below which a richer motion may be taken at all: a
    motion with more parameters always fits a little better."""
    widespread_share: float = 0.1
    """Share of the sensor that contradicts the background's motion from which on any smaller residual is enough: in a
    clip of leaves in the wind 38 % contradicted rest and 0.1 % the dense estimate, whose residual was smaller by 2 %
    only."""
    layer_interior_share: float = 0.5
    """Share of the sensor that has to lie away from edges between layers. Labels that are more scattered than that are
    not surfaces; the dense estimate was up to 3 dB better there."""
    layers_residual_ratio: float = 1.01
    """Prediction residual of layers, relative to the dense estimate's, up to which layers are preferred: they model
    edges and occlusion."""
    layers_sufficient_ratio: float = 0.95
    """Prediction residual of layers, relative to the dense estimate's, below which the dense estimate is not tried as
    one more layer."""
    margin_px: int = 24
    """Margin around contradicting pixels within which separate motion is searched for: the widest window of the dense
    estimate reaches 18 pixels."""
    box_share: float = 0.6
    """Share of the sensor up to which the box around moving parts is used instead of the whole sensor. A box compiles
    ten programs of its own, which a fifth of the work does not repay."""
    sparse_from_pixels: int = 10_000
    """Pixels from which on motions are compared on a sparse grid. It gave the mean residual to 0.3 % at 400×250 pixels,
    but only to 2 % at 60×60, where that decided between two layers and three (0.2 dB)."""
    lit_ratio: float = 0.1
    """Intensity relative to the mean from which on a pixel is used to measure the light of a moment; also the least
    light of a moment relative to the brightest one."""
    light_pixels: int = 4000
    """Pixels, about, that are used to measure the light of a moment: their median is exact enough."""
    flicker_share: float = 0.02
    """Change of the light, relative to its median, from which on rest is tested on pictures without it."""
    flicker_residual_share: float = 0.05
    """Pixels that contradict rest without the changes of light, relative to those with them, up to which the scene
    rests: up to 0.02 with lamps that flicker by 10 to 30 %, half and more with pans and turns."""


@dataclass(frozen=True, kw_only=True)
class ParametricSettings(Settings):
    """One motion of few numbers for the scene or a region (`parametric`)."""

    above_zero = frozenset({"presmoothing_px"})

    presmoothing_px: tuple[float, float, float, float] = (2.5, 1.5, 1.2, 1.0)
    """Gaussian presmoothing at each level of `near_times_frames`, from blurred to sharp."""
    most_steps: tuple[int, int, int, int] = (10, 6, 5, 12)
    """Gauss–Newton steps at each level, at most."""
    step_tolerance: float = 0.02
    """Displacement at the farthest moment, in units of the presmoothing, below which steps end."""
    last_tolerance_ratio: float = 0.1
    """Tolerance of the last level relative to that of the others."""
    varying_px: float = 0.1
    """Variation of a start over pixels and moments above which the fit is affine and not a translation."""
    agreeing_share: float = 0.5
    """Share of the scene's points whose residual sets the scale of outliers."""
    agreeing_share_region: float = 0.2
    """Share of the points, for a region that was found because it contradicts another motion: much of such a region may
    belong to other surfaces."""
    outlier_scale: float = 3.0
    """Squared residual, in units of the agreeing points' largest, at which a point's weight begins to fall (Cauchy)."""
    sparse_step_divisor: int = 3
    """Factor by which the number of steps with all points is reduced after a fit to a quarter of them."""
    least_points: int = 1024
    """Points of the key frame at which pictures are compared: this number, 4 times it, and so on. There are few such
    numbers, so that one compiled program serves many pictures and regions."""
    most_points: int = 16384
    """Points at most. Presmoothed pictures change little from pixel to pixel: a sixth of 400×250 pixels is enough."""
    blocks_per_side: int = 16
    """Blocks along each side of the picture, whose separate gradients give the uncertainty of a parameter."""
    firing_window_px: float = 2.0
    """Gaussian window over which rates of firing are averaged."""
    least_firing_rate: float = 0.001
    """Spikes per frame that are not distinguished from none."""
    spanned_intervals: float = 6.0
    """Intervals between spikes that the pictures have to span for a point to have half of its weight: with fewer,
    several pictures show the same interval."""
    score_per_number: float = 7.5
    """Score statistic, per parameter, from which on more parameters are fitted: p < 10⁻⁴ of a χ² value for 4
    parameters."""
    longest_step_ratio: float = 4.0
    """Largest extrapolation of a Gauss–Newton update whose series converges slowly."""
    growing_step_ratio: float = 2.0
    """Extrapolation of an update that is larger than the one before."""


@dataclass(frozen=True, kw_only=True)
class LayerSettings(Settings):
    """Thresholds of the number of layers, their motions, labels and order (`layered`)."""

    most_layers: int = 3
    """Layers besides the background that are searched for."""
    least_pixels: int = 40
    """Pixels of a layer, at least."""
    fitted_pixels: int = 4000
    """Pixels of a region, about, to whose velocities an affine start is fitted; a fit to the pictures refines it."""
    voting_pixels: int = 500
    """Pixels of a region, about, among whose velocities the most frequent ones (modes) are searched for: time grows
    with their square."""
    velocity_modes: int = 3
    """Velocities that a region is tried with, besides fits."""
    mode_width: float = 0.02
    """Width of a mode, sensor pixels per frame: 1 px over half of 101 frames."""
    affine_steps: int = 20
    """Steps of the reweighted least squares that fit an affine start."""
    affine_agreeing_share: float = 0.3
    """Share of a region's velocities whose distance sets the scale of outliers in that fit."""
    equivalent_ratio: float = 1.1
    """Contradicting pixels of a candidate, relative to the best one's, up to which the earlier candidate is taken: fits
    come before constant velocities."""
    fit_contradicting_share: float = 0.35
    """Share of a region that may contradict its first fit without other candidates being tried: about as much of a
    region is hidden or uncovered background, which contradicts any motion."""
    explained_share: float = 0.3
    """Share of a region that a motion has to explain to become a layer."""
    dense_share: float = 0.01
    """Share of the sensor that no layer explains from which on the dense estimate is one more layer."""
    closing_px: int = 3
    """Half the gap up to which parts that contradict the background are one region."""
    edge_px: int = 3
    """Distance from the edge of a layer within which pixels also see the next layer. When fitted with its edge, an
    object became 2 % too slow."""
    presmoothing_px: float = 0.6
    """Presmoothing of the pictures from which labels are found: small, so that edges stay in place."""
    support_px: float = 1.2
    """Gaussian window over which mismatches are averaged before labels are found."""
    key_picture_frames: float = 6.0
    """Standard deviation of the Gaussian in time whose mean is the key frame's picture for finding labels."""
    least_weight: float = 1e-4
    """Weight in that mean below which a picture is left out."""
    late_frames: float = 20.0
    """Distance from the key frame up to which a picture's mismatch counts less, because near it all motions agree."""
    better_side_weight: float = 0.7
    """Weight of the better of the times before and after the key frame in a mismatch: a surface that is hidden later
    may have been in view before, or the other way round."""
    order_penalty: float = 0.15
    """Mismatch by which a motion has to be better than each motion found before it, so that the simplest is taken where
    all fit."""
    top_speed_quantile: float = 0.95
    """Quantile of the speeds of moving pixels that is taken as the largest speed, so that single errors do not
    count."""
    top_speed_ratio: float = 1.5
    """Speed of a layer's motion, relative to that largest speed, above which the motion is rejected: an affine motion
    grows outside the region that it was fitted to."""
    neighbour_gain: float = 1.4
    """Reduction of the mismatch of a pixel that has the label of its whole neighbourhood."""
    most_label_turns: int = 12
    """Iterations of the labelling, at most."""
    border_share: float = 0.25
    """Share of an isolated part's border that a layer has to have to take over that part."""
    undecided_mismatch: float = 0.15
    """Mismatch up to which the layer that takes a part over may be worse there."""
    vote_cap: float = 0.02
    """Largest difference of squared intensities with which a pixel votes on which layer is in front: many pixels
    decide, not a few bright ones."""


@dataclass(frozen=True, kw_only=True)
class DenseSettings(Settings):
    """One motion for each pixel (`dense`, `accelerated`)."""

    presmoothing_px: tuple[float, float, float, float] = (2.0, 1.5, 1.0, 0.8)
    """Gaussian presmoothing at each level of `near_times_frames`; the last one serves accelerations, too."""
    window_px: tuple[float, float, float, float] = (6.0, 4.0, 3.0, 2.5)
    """Gaussian window of the least squares for velocities at each level: wide at the levels with little
    displacement."""
    steps: tuple[int, int, int, int] = (8, 6, 6, 6)
    """Gauss–Newton steps at each level."""
    acceleration_window_px: float = 6.0
    """Gaussian window of the least squares for accelerations, wider because these are less certain than velocities."""
    accelerated_window_px: float = 4.0
    """Gaussian window of the velocities that are found alternately with accelerations."""
    acceleration_turns: int = 3
    """Alternations of accelerations and velocities."""
    acceleration_chance: float = 0.05
    """Squared acceleration times its information that noise causes where nothing accelerates (mean of pans by day), per
    picture that one interval of a pixel lasts: these pictures share their noise."""
    least_picture_share: float = 0.001
    """Least share of an interval that a picture is taken to last, where pixels hardly fire."""
    median_side_px: int = 5
    """Side of the square whose median replaces each velocity after a level, which removes single wrong velocities."""
    prior_weight: float = 0.01
    """Information of the prior that the velocity is near its start; it matters only where there is no texture."""
    prior_px: float = 2.0
    """Displacement over the recording within which the start is taken to be right."""
    step_margin_px: float = 0.5
    """Displacement beyond the presmoothing, at the farthest moment, up to which one step may go, as the linearisation
    does not hold further."""
    followed_share: float = 0.5
    """Side of the picture, relative to the displacement over the recording, up to which a pixel can be followed."""


@dataclass(frozen=True, kw_only=True)
class PhaseSettings(Settings):
    """One translation by phase correlation (`PhaseCorrelation`)."""

    span_shares: tuple[float, float, float, float] = (0.0, 0.1, 0.3, 0.7)
    """Differences in time of the pairs at each level, as shares of the recording; 0 for neighbouring pictures."""
    most_pairs: int = 12
    """Pairs of a level, at most."""
    band_px: tuple[float, float] = (1.0, 5.0)
    """Gaussians whose difference is correlated: neither the noise of single pixels nor slow changes of light."""
    least_contrast: float = 1e-4
    """Standard deviation of that difference, intensity, below which a picture has nothing to correlate."""


@dataclass(frozen=True, kw_only=True)
class FlowSettings(Settings):
    """Optical flow coarse to fine in time (`ILK`, `TVL1`)."""

    rounds: tuple[int, int, int, int] = (2, 1, 1, 2)
    """Flows at each level of `near_times_frames`."""
    longest_remainder_px: tuple[float, float, float, float] = (10.0, 2.5, 2.5, 2.5)
    """Displacement that a flow may find at each level: once near times agree, a longer one is a failure."""
    presmoothing_px: float = 0.7
    """Gaussian presmoothing of the pictures."""
    precision_px: float = 0.25
    """Standard deviation, and difference of forward and backward flow, at which the confidence is ½."""
    disagreement_window_px: float = 1.0
    """Gaussian window over which the difference of forward and backward flow is averaged."""
    median_side_px: int = 5
    """Side of the square whose median replaces each velocity."""
    fill_window_px: float = 5.0
    """Gaussian window from which velocities without support are filled in."""


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
class ReachSettings(Settings):
    """How far in time a dense motion is estimated from and used (`within_reach`)."""

    above_zero = frozenset({"step", "window_px", "blend_px", "turns"})

    step: float = 2**0.5
    """Ratio of successive reaches that are tried: the light that is gathered falls by that ratio, its noise by half of
    that or less."""
    least_near: float = 2.0
    """Shortest reach, relative to that of the pictures next to the key frame with which all are compared: at least half
    of its pictures are not among these."""
    turns: int = 2
    """Alternations of accelerations and velocities in each fit, which begins at the fit for the reach before."""
    window_px: float = 12.0
    """Gaussian window over which squared errors are averaged: some 1800 pixels, of which presmoothing leaves 150
    independent ones. A squared error is then known to an eighth; with narrower windows noise decided."""
    least_share: float = 0.05
    """Share of the pixels for which a shorter reach has to be better; with fewer, no shorter one is tried."""
    blend_px: float = 3.0
    """Gaussian window over which fields of several reaches are blended, that of comparisons."""


@dataclass(frozen=True, kw_only=True)
class LightSettings(Settings):
    """When the light of a scene changes, and how that is found (`scsr_opt.motion.light`)."""

    above_zero = frozenset({"tile_px", "most_tiles", "frames_per_picture", "steps_of_a_velocity", "dark_rate"})

    tile_px: int = 16
    """Side of a tile whose light is estimated as a function of time (its course)."""
    most_tiles: int = 64
    """Tiles, at most, from which it is decided whether the light changes."""
    least_frames: int = 24
    """Frames of a clip from which on changes of the light are searched for."""
    least_side_px: int = 8
    """Side of the sensor from which on they are searched for."""
    frames_per_picture: int = 4
    """Frames of a short picture; light that changes twice within fewer than that is not followed."""
    least_pictures: int = 6
    """Short pictures, at least, for that search."""
    measured_share: float = 0.85
    """Share of the pixels that must have fired before the first picture begins, and fire again after the last one."""
    presmoothing_px: float = 1.0
    """Gaussian presmoothing of the pictures: noise in their slopes would make motions seem too slow."""
    steps_of_a_velocity: int = 25
    """Steps from picture to picture for which a tile has one velocity."""
    dark_rate: float = 0.01
    """Spikes per frame that are added to a pixel's mean when its noise is estimated from the mean."""
    saturated_rate: float = 0.85
    """Spikes per frame from which on a pixel cannot measure an increase of light."""
    least_change: float = 0.01
    """Standard deviation of a tile's light, relative to its mean, from which on it counts as changing."""
    agreement: float = 2.0
    """Least ratio of a tile's change to the difference from the tiles beside it."""
    least_share: float = 0.3
    """Share of the tiles whose light changes like that beside them, from which on the light changes: at most 0.2 in
    scenes without flicker (except for one), 0.25 and more with 10 % of flicker."""
    least_common_change: float = 0.007
    """Standard deviation of the mean course, relative to the mean light, from which on it counts as changing."""
    deviations: float = 4.0
    """Standard deviations, by the spread of the tiles, that the mean course has to change by."""
    least_common_share: float = 0.2
    """Share of the tiles that have to agree for the mean course to count. Without this limit and the next one, flicker
    was found in eight of 135 scenes of 6 to 16 tiles in steady light, with them in one."""
    least_tiles: int = 3
    """Tiles that have to agree: all of 6 and 12 did at 10 % of flicker, two of 6 in three of 45 steady scenes."""
    suspicious_ratio: float = 0.4
    """Share of the limits of tiles, change and deviations from which on more frames than those of the clip are used, if
    there are more."""
    tracked_share: float = 0.5
    """Share of a tile's pixels whose motion must not have left the sensor for a picture to measure the tile's light."""
    tracked_agreement: float = 1.2
    """`agreement` for brightness that is followed along the motion: 1.1 to 4 in a shadow, below 1.1 in all of 30 scenes
    in steady light except for a tile with an object."""
    most_variance_ratio: float = 1.02
    """Largest ratio of the variance along the motion found with the light to that along the motion found without it:
    0.05 to 0.99 in thirty scenes with 10 % of flicker, 1.05 to 1.16 in four of 110 pans in steady light in which
    flicker had been found."""
    margin_frames: int = 32
    """Frames before and after a clip that are used with it: at its ends many pixels lie outside any interval."""
    stretch_frames: int = 801
    """Frames around the key frame from which the frequency and the mean of the light are estimated: two cycles of a
    lamp at 100 Hz, read out 40,000 times a second."""
    least_cycles: float = 0.7
    """Cycles, at least, for a frequency to be estimated."""
    explained_share: float = 0.9
    """Share of the variance that a wave of that frequency has to explain."""
    most_lamps: int = 3
    """Lamps with a course of their own, at most."""
    lamp_share: float = 0.15
    """Share of the tiles that have to differ from the common light in the same way as those beside them, for one more
    lamp."""
    lamp_rounds: int = 2
    """Rounds in which these shares are found along a motion, which is then estimated again."""
    most_step: float = 0.5
    """Relative change of the light from one short picture to the next, at most, along the motion. That of a lamp of 100
    Hz that swings by half is 0.036 at most."""
    edge_px: float = 1.5
    """Standard deviation of the window in which a pixel's share of each lamp is found along the motion."""
    part_px: float = 1.5
    """Standard deviation of the window in which the light of a pixel is decided between those of two lamps."""
    most_evidence: float = 3.0
    """Difference of log-likelihood of two lamps for a pixel above which it is certain which of them lights it."""
    part_rounds: int = 2
    """Rounds in which it is decided."""
    uncertain_px: int = 2
    """Sensor pixels on either side of such an edge for which it is decided by a picture that is solved for without
    them."""
    apart_tolerance: float = 0.15
    """Distance from either of two shares, in units of their difference, within which a pixel counts as lit by one
    lamp."""
    apart_share: float = 0.6
    """Share of such pixels from which on every pixel is assigned to one of the two lamps."""
    edge_median_px: int = 5
    """Side of the square whose median share a pixel then gets: edges between lamps remain, single pixels are
    removed."""


@dataclass(frozen=True, kw_only=True)
class TrajectorySettings(Settings):
    """How a motion is inverted and what is visible along it (`trajectory_of`)."""

    inverse_steps: int = 8
    """Fixed-point iterations of the inverse, at most."""
    inverse_tolerance_px: float = 1e-4
    """Change below which these iterations end, and deviation up to which a motion is inverted as an affine one."""
    partial_share: float = 0.5
    """Share of a layer at a point between pixel centres from which on the point belongs to it."""
    whole_share: float = 0.9
    """Share of a layer from which on the point belongs to it alone; below, a pixel sees two surfaces at once."""


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
