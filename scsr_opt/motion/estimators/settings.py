"""Settings of the single estimators of motion, and of the choice between them.

Lengths are sensor pixels, times are frames. "Along a motion" means after each short picture of the recording
(`MotionFrames`) has been moved to the key frame by that motion. What the estimators share, and `MotionSettings`, which
holds all of these, are in `scsr_opt.motion.settings`.
"""

from dataclasses import dataclass

from scsr_opt._settings import Settings


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
