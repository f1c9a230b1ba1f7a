"""Thresholds by which bad pixels, gains of pixels and the blur of the lens are found."""

from dataclasses import dataclass

from scsr_opt._settings import Settings


@dataclass(frozen=True, kw_only=True)
class BadPixelSettings(Settings):
    """Search for bad pixels (`scsr_opt.calibration.bad_pixels`). The values were found on pictures of BSDS500 at rest
    and moving, on text, checkerboards and stars, and on a real roadside with and without a car."""

    above_zero = frozenset({"around_px", "quarters", "rounds"})

    evidence_frames: int = 400
    """Frames, at most, around the key frame whose spikes are counted: more than a clip, for dim scenes."""
    least_frames: int = 16
    """Frames from which on bad pixels are searched for."""
    around_px: int = 7
    """Sensor pixels around a pixel within which deviations are compared."""
    least_deviation: float = 0.3
    """Least deviation of ln(spikes) from the median of the neighbours: a quarter less light, or a third more. Gains
    spread by 0.06, so smaller deviations are corrected as gains."""
    least_beyond_share: float = 0.6
    """Share of that deviation by which a pixel has to exceed all but one of its neighbours: the corner of a square does
    not."""
    least_beyond_spikes: float = 2.0
    """Spikes by which a pixel has to exceed them, at least."""
    most_spread: float = 0.25
    """Share of a point's light that its neighbours receive as well, from which on the point is taken to have come
    through the lens."""
    least_spikes: float = 4.0
    """Spikes, at least, by which a pixel differs from its neighbours."""
    outlying_factor: float = 4.0
    """Least ratio of a pixel's deviation to the third largest around it: 4 to 26 for bad pixels of the roadside, at
    most 3.6 for single pixels of its leaves; exceeded by 5 of 1,080,000 pixels of 100 pictures at rest."""
    dead_neighbour_spikes: float = 8.0
    """Spikes of the second darkest neighbour, at least, for a pixel without spikes to be dead in any scene."""
    dead_surround_spikes: float = 3.0
    """Spikes of the third darkest pixel around, at least: in printed text, other pixels are as dark."""
    hot_surround_share: float = 0.75
    """Share of the frames in which the second brightest neighbour and the third brightest pixel around fire at most,
    for a saturated pixel to be hot in any scene."""
    light_ratio: float = 3.0
    """Ratio to the neighbours from which on an isolated bright pixel is taken for a light of the scene; no other bright
    pixel of that scene then counts as bad."""
    lights_share: float = 0.1
    """Lights, at most, relative to hot pixels: in a scene of many lights some may saturate a pixel."""

    least_motion_px: float = 3.0
    """Sensor pixels that the scene has to move at a pixel for other pixels to predict its measurements."""
    motion_quantiles: tuple[float, float] = (0.3, 0.7)
    """Quantiles of the velocities around a pixel between which the pixel's own velocity has to lie."""
    most_motion_difference_px: float = 6.0
    """Largest difference of these quantiles, sensor pixels of motion in half the time; at the border of an object no
    pixel is judged."""
    surface_smoothing_px: float = 3.0
    """Standard deviation of the Gaussian that smooths the map of surfaces: a grain of dust that was taken for a surface
    of its own then has no border."""
    border_px: int = 4
    """Sensor pixels beside the border of a surface that are not judged, as the rim of a turning disc stays at its
    place. In nine such recordings there were 2 to 26 false pixels, at most 3.2 pixels beside it."""
    quarters: int = 4
    """Stretches of time in each of which the deviation has to be found."""
    rounds: int = 2
    """Rounds, each without the pixels found before: in the first one, dust also darkens the picture that predicts
    it."""
    dark_light: float = 0.01
    """Intensity that is added to measured and predicted light, so that dark pixels do not deviate."""
    least_known_share: float = 0.9
    """Share of the weight that the prediction of a picture has to have."""
    least_looks_share: float = 0.33
    """Share of the pictures in which a pixel sees places that other pixels have seen."""
    least_resting_deviation: float = 0.15
    """Least |ln(measured / predicted light)|: smaller deviations are corrected as gains."""
    resting_quantiles: tuple[float, float] = (0.5, 0.9)
    """Quantiles of the deviations of the pixels around, with which a pixel's deviation is compared."""
    resting_factors: tuple[float, float] = (7.5, 3.0)
    """Least ratio of the deviation to these quantiles: where the motion or the gains are inexact, all pixels
    deviate."""
    resting_spikes: float = 2.5
    """Spikes by which measured and predicted light have to differ: a recording begins and ends between two spikes,
    which makes one uncertain."""
    steady_share: float = 0.5
    """Share of the deviation that each quarter has to show."""
    along_px: tuple[int, int] = (8, 12)
    """Distances along the motion, sensor pixels, between which the deviation must not continue: further than a grain of
    dust is wide."""
    along_share: float = 0.4
    """Share of the deviation that the mean over those distances may have, at most."""
    near_px: tuple[int, int] = (2, 5)
    """Smaller distances along the motion, at which the deviation may continue only if it also continues across the
    motion."""
    along_ratio: float = 2.0
    """Ratio of the deviation along the motion to that across it from which on it is taken for an edge."""
    grown_share: float = 0.5
    """Share of the limits that pixels beside a bad one have to reach: the border of a grain of dust darkens less."""
    grown_px: int = 2
    """Sensor pixels by which a group of bad pixels may be extended in this way."""
    dark_deviations: float = 10.0
    """Robust standard deviations by which a hot pixel fires more often than the median in the dark (`calibrate`)."""
    least_hot_rate: float = 0.02
    """Spikes per frame by which it does so, at least: a smaller dark level can be subtracted."""
    most_resting_share: float = 0.03
    """Share of the pixels that may be found, at most; if there are more, the motion is wrong."""


@dataclass(frozen=True, kw_only=True)
class GainSettings(Settings):
    """Search for gains of the pixels, and for a fixed pattern (`scsr_opt.calibration.gain`,
    `scsr_opt.calibration.gain_network`)."""

    least_motion_px: float = 1.0
    """Sensor pixels that the scene has to move at a pixel before the picture determines the pixel's gain; with less
    motion a pixel sees one place only."""
    believed_range: tuple[float, float] = (0.5, 2.0)
    """Smallest and largest gain that is accepted; pixels with gains outside are bad."""
    pattern_spread: float = 0.02
    """Spread (standard deviation) of blind gains from which on a recording has a fixed pattern. Without one at most
    0.016 was found where the motion was right; a pattern of 2 % costs at most 0.1 dB, less than two more solves are
    worth."""
    rounds: int = 2
    """Rounds of picture and gain: the first finds most of a pattern, the second the rest."""
    probed_pixels: int = 400
    """Pixels, at most, whose gains are estimated first: they give the spread to 3.5 % (1 / √2n)."""

    rest_pattern_spread: float = 0.01
    """Spread of the gains found in a still scene from which on a square of pixels shows a fixed pattern."""
    rest_plainest_share: float = 0.1
    """Share of the squares that may spread less although there is a pattern."""
    square_px: int = 8
    """Side of a square, sensor pixels: large enough for a spread of 64 gains, small enough to lie within a surface."""
    least_squares: int = 25
    """Squares, at least: the texture of a single part of a picture may be as white as gains are."""
    least_squares_share: float = 0.1
    """Share of all squares that has to be bright and free of noise enough to show gains."""
    least_light: float = 0.05
    """Mean intensity, at least, of a square that can show gains."""
    most_noise: float = 0.04
    """Mean relative noise, at most, of a square that can show gains."""
    most_log_gain: float = 0.5
    """Largest |ln g| at rest: gains above 1.65 or below 0.61 are bad pixels."""
    noise_smoothing_px: float = 2.0
    """Standard deviation, sensor pixels, of the Gaussian that smooths the noise of a still scene."""
    bad_pixel_smoothing_px: float = 1.0
    """Standard deviation, sensor pixels, of the Gaussian mean that replaces a bad pixel."""
    brightest_share: float = 0.01
    """Share of the pixels that may be brighter than white. With more, the white rate is taken to be wrong, as the
    network was trained on pictures up to white."""
    windows: tuple[int, int] = (2, 3)
    """Windows down and across that are examined first on a large sensor, with a fraction of the work for all of it."""
    window_squares: int = 5
    """Squares along a side of such a window."""
    plain_share: float = 0.35
    """Share of the windows' squares without a pattern from which on the whole sensor has none. On nine pictures and
    three real recordings it was 0.36 to 1 without a pattern, 0.15 to 0.9 with 2 %, and 0 to 0.24 with 5 %."""


@dataclass(frozen=True, kw_only=True)
class OpticsSettings(Settings):
    """Search for a Gaussian lens (`estimate_gaussian_optics`)."""

    sigmas_px: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
    """Standard deviations that are tried, sensor pixels; one solve each."""
    held_out_share: float = 0.1
    """Share of the sensor pixels that are predicted from the others."""
    least_pixels: int = 100
    """Sensor pixels, at least, as a tenth of fewer does not give a reliable error."""
    least_motion_px: float = 1.0
    """Sensor pixels that the scene has to move: with less, no other pixel has seen the place of a held-out one."""
