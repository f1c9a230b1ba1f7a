"""Thresholds by which bad pixels, gains of pixels and the blur of the lens are found."""

from dataclasses import dataclass

from scsr_opt._settings import Settings


@dataclass(frozen=True, kw_only=True)
class BadPixelSettings(Settings):
    """Search for bad pixels (`scsr_opt.calibration.bad_pixels`). Found on pictures of BSDS500 at rest and moving, on
    text, checkerboards and stars, and on a real roadside with and without a car."""

    above_zero = frozenset({"around_px", "quarters", "rounds"})

    evidence_frames: int = 400
    """Frames, at most, around the key frame whose spikes are counted: more than a clip, for what is dim."""
    least_frames: int = 16
    """Frames from which on bad pixels are searched for."""
    around_px: int = 7
    """Sensor pixels around a pixel within which deviations are compared."""
    least_deviation: float = 0.3
    """Deviation of ln(spikes) from the median of the neighbours, at least: a quarter less light, or a third more. Gains
    spread by 0.06, and what is less is left to them."""
    least_beyond_share: float = 0.6
    """Share of that by which a pixel lies beyond all but one of its neighbours: the corner of a square does not."""
    least_beyond_spikes: float = 2.0
    """Spikes by which it lies beyond them, at least."""
    most_spread: float = 0.25
    """Share of a point's light that its neighbours have as well, from which on it has come through the lens."""
    least_spikes: float = 4.0
    """Spikes, at least, that it has more or less than the neighbours."""
    outlying_factor: float = 4.0
    """Deviation, at least, in the third largest around: 4 to 26 of those that are seen in the roadside, 3.6 at most
    of single pixels of its leaves; 5 pixels of 100 pictures at rest, 1,080,000 pixels, are above."""
    dead_neighbour_spikes: float = 8.0
    """Spikes of the second darkest neighbour, at least, for a pixel without any to be dead, however the scene is."""
    dead_surround_spikes: float = 3.0
    """Spikes of the third darkest pixel around, at least: in print, others are as dark."""
    hot_surround_share: float = 0.75
    """Share of the frames in which the second brightest neighbour and the third brightest pixel around fire at most,
    for a pixel that is saturated to be hot, however the scene is."""
    light_ratio: float = 3.0
    """Ratio to the neighbours from which on an isolated bright pixel is taken for a light of the scene. Then none of
    the others is taken for bad."""
    lights_share: float = 0.1
    """Lights, at most, in hot pixels: a scene of many lights may have some that saturate a pixel."""

    least_motion_px: float = 3.0
    """Sensor pixels that the scene has to move at a pixel for others to tell what it should have measured."""
    motion_quantiles: tuple[float, float] = (0.3, 0.7)
    """Quantiles of the velocities around a pixel between which it moves as they do."""
    most_motion_difference_px: float = 6.0
    """Sensor pixels, in half the time, by which these may differ; at the border of an object nothing is judged."""
    surface_smoothing_px: float = 3.0
    """Gaussian over which surfaces are smoothed: dust that was taken for one of its own has no border then."""
    border_px: int = 4
    """Sensor pixels beside the border of a surface that are not judged: the rim of a disc that turns stays where it is.
    In nine such recordings it gave 2 to 26 false pixels, 3.2 pixels beside it at most."""
    quarters: int = 4
    """Stretches of time in each of which a deviation has to be there."""
    rounds: int = 2
    """Rounds, each without what the one before found: at first a grain of dust dims the picture that judges it."""
    dark_light: float = 0.01
    """Intensity that is added to measured and predicted light: darkness deviates by nothing."""
    least_known_share: float = 0.9
    """Share of the weight that the prediction of a look has to have."""
    least_looks_share: float = 0.33
    """Share of the pictures in which a pixel sees what the others have seen."""
    least_resting_deviation: float = 0.15
    """Logarithm of measured over predicted light, at least: less is a matter of gains."""
    resting_quantiles: tuple[float, float] = (0.5, 0.9)
    """Shares of the pixels around that deviate by less than a quantile of them."""
    resting_factors: tuple[float, float] = (7.5, 3.0)
    """Deviation, at least, in these quantiles: where motion, or the gains, are not exact, all deviate."""
    resting_spikes: float = 2.5
    """Spikes by which measured and predicted light have to differ: where a recording begins and ends between two
    spikes, one is uncertain."""
    steady_share: float = 0.5
    """Share of the deviation that each quarter has to show."""
    along_px: tuple[int, int] = (8, 12)
    """Sensor pixels along the motion, from and to, between which no deviation may go on: further than a grain of
    dust is wide."""
    along_share: float = 0.4
    """Share of the deviation that the mean of those may have, at most."""
    near_px: tuple[int, int] = (2, 5)
    """Nearer ones, between which it may only where it also goes on across the motion."""
    along_ratio: float = 2.0
    """Deviation along the motion over that across it, from which on it is that of an edge."""
    grown_share: float = 0.5
    """Share of a limit that pixels beside one that was found have to reach: the border of a grain dims less."""
    grown_px: int = 2
    """Sensor pixels by which it may grow so."""
    dark_deviations: float = 10.0
    """Robust standard deviations by which a hot pixel fires more than the median in the dark (`calibrate`)."""
    least_hot_rate: float = 0.02
    """Spikes per frame by which it does at least: less is a dark level that can be subtracted."""
    most_resting_share: float = 0.03
    """Share of the pixels that may be found, at most; with more it is the motion that is wrong."""


@dataclass(frozen=True, kw_only=True)
class GainSettings(Settings):
    """Search for gains of the pixels, and for a fixed pattern (`scsr_opt.calibration.gain`,
    `scsr_opt.calibration.gain_network`)."""

    least_motion_px: float = 1.0
    """Sensor pixels that the scene has to move at a pixel before the picture tells that pixel's gain: less, and the
    pixel sees one point only."""
    believed_range: tuple[float, float] = (0.5, 2.0)
    """Smallest and largest gain that is believed: what lies beyond is a bad pixel."""
    pattern_spread: float = 0.02
    """Spread (standard deviation) of blind gains from which on a recording has a fixed pattern. Without one at most
    0.016 was found where the motion was right; a pattern of 2 % costs at most 0.1 dB, less than two more solves are
    worth."""
    rounds: int = 2
    """Rounds of picture and gain: the first finds most of a pattern, the second the rest."""
    probed_pixels: int = 400
    """Pixels, at most, whose gains are looked at first: they tell the spread to 3.5 % (1 / √2n)."""

    rest_pattern_spread: float = 0.01
    """Spread of the gains found in a still scene from which on a square of pixels shows a fixed pattern."""
    rest_plainest_share: float = 0.1
    """Share of the squares that may spread less while there is a pattern all the same."""
    square_px: int = 8
    """Side of a square, sensor pixels: large enough for a spread of 64 gains, small enough to lie within a surface."""
    least_squares: int = 25
    """Squares, at least: one part of a picture may be texture as white as gains are."""
    least_squares_share: float = 0.1
    """Share of all squares that has to be bright and quiet enough to show gains."""
    least_light: float = 0.05
    """Mean intensity of a square that can show gains: what hardly fires shows none."""
    most_noise: float = 0.04
    """Mean relative noise of a square that can show gains: with more, what is found would be noise."""
    most_log_gain: float = 0.5
    """Largest |ln g| at rest: 1.65 and 0.61 are bad pixels rather than gains."""
    noise_smoothing_px: float = 2.0
    """Standard deviation, sensor pixels, of the Gaussian mean over which the noise of a still scene is even."""
    bad_pixel_smoothing_px: float = 1.0
    """Standard deviation, sensor pixels, of the Gaussian mean that stands in for a bad pixel."""
    brightest_share: float = 0.01
    """Share of the pixels that may be brighter than white: with more, the white rate is taken for wrong, as the
    network was trained on pictures up to white."""
    windows: tuple[int, int] = (2, 3)
    """Windows down and across that are looked at first on a large sensor, at a fraction of the work of all of it."""
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
    """Sensor pixels, at least: a tenth of fewer predicts nothing."""
    least_motion_px: float = 1.0
    """Sensor pixels that the scene has to move: with less, no other pixel has seen what a held-out one saw."""
