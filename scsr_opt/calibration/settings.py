"""Thresholds by which gains of pixels and the blur of the lens are found."""

from dataclasses import dataclass

from scsr_opt._settings import Settings


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
