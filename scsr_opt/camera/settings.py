"""`ContentSettings`: thresholds by which a file is judged by its content before it is read (docs/formats.md)."""

from dataclasses import dataclass

from scsr_opt._settings import Settings


@dataclass(frozen=True, kw_only=True)
class ContentSettings(Settings):
    """Thresholds of what content shows. A ratio is that of coincidences of spikes to those that chance would make."""

    # Regularity of spikes along time, and agreement of rows (`plausibility`).
    piece_frames: tuple[int, int, int] = (8, 16, 32)
    """Frames of a piece of a line. Two spikes of a dark pixel need a long one, and light that changes a short one."""
    least_coincidences: float = 200.0
    """Coincidences that chance must make for a ratio to count: its standard deviation is then less than 0.1."""
    regular_below_ratio: float = 0.6
    """Ratio below which lines are trains of an integrator: none along rows or columns was below 0.74
    (docs/formats.md)."""
    irregular_above_ratio: float = 0.85
    """Ratio above which lines are none: real recordings stay below 0.3."""
    apart_below_ratio: float = 0.4
    """Coincidences that chance would make along time in the dark, as a fraction of those along rows and columns: up to
    0.33 where pixels fire once in 20 to 60 frames, about 1 where they fire at random."""
    bunched_from_ratio: float = 1.3
    """Ratio from which spikes come together, as where a thin bright line passes in the dark (1.4 to 1.7), not by
    chance."""
    dark_below_rate: float = 0.06
    """Spikes per pixel and frame below which most pixels have at most one spike in 16 frames."""
    saturated_frames: int = 5
    """Frames one after another in which a pixel that fires in all of them is taken for saturated. Where it goes in and
    out of saturation, as where a fine texture passes in too bright light, it fires without regard to when it last
    did."""
    axis_block: tuple[int, int, int] = (64, 112, 112)
    """Entries along each axis that are read, from the middle, to tell the axis of time."""
    row_smoothing_px: int = 33
    """Pixels along rows whose mean is taken off before rows are compared: the slow course of light agrees anywhere."""
    least_correlation: float = 0.15
    """Correlation of neighbours from which on a picture shows the length of its rows (real ones: 0.19 to 0.95)."""
    least_correlation_deviations: float = 10.0
    """Limit of the correlation for small sensors, in standard deviations of the correlation of unrelated pixels."""
    disagreeing_correlation_share: float = 0.4
    """Fraction of the correlation of the right rows below which rows do not belong together: wrong ones are below
    0.1."""
    least_correlation_drop: float = 0.02
    """Correlation that is lost at least from one row to the next where rows lie beside each other: 0.05 to 0.1 in the
    recordings. Where every row is the same, it is not known how many lie beside each other."""

    # Contents of flat files (`flat_content`).
    tried_heights: tuple[int, int, int] = (2, 3, 4)
    """Times the height that frames may really have, where they were taken for a part of one."""
    warning_least_coincidences: float = 2000.0
    """Coincidences that chance must make for a file to be called none of spikes: a standard deviation of 0.02."""
    random_below_ratio: float = 1.15
    """Ratio above which pixels do not fire at random: they are very bright and very dark by turns, as they are where a
    fine pattern passes in too bright light."""
    one_pixel_below_ratio: float = 0.3
    """Ratio below which half frames are of the same pixels: 0 to 0.11 in real recordings, two pixels have about 1."""
    compared_px: int = 1 << 17
    """Pixels in the middle of a frame whose rows are compared: all of 250x400."""

    # Files of records (`records`).
    record_sample_bytes: int = 1 << 16
    """Bytes in the middle of a file that are folded."""
    longest_record_bytes: int = 128
    """Longest record that is looked for."""
    least_records: int = 256
    """Records that must agree: a pixel that fires in nine of ten frames is set in as many by chance once in 10^11
    times."""
    record_set_share: float = 1 / 64
    """Fraction of the bits of a record that are always set, from which on it is one."""
    other_lengths_set_share: float = 1 / 4
    """Bits always set at the median length, at most, as a fraction of those at the length of the records: a saturated
    sensor has as many at any length."""
    explained_set_share: float = 1 / 2
    """Bits always set at a common divisor with the row or the frame, as a fraction, from which on these explain them:
    they are saturated columns or pixels."""

    # Layouts of flat files (`flat`).
    gap_changes_share: float = 0.01
    """Fraction of the bits between pixels that may differ from frame to frame, bit errors, as a part of the pixels'."""
    filling_chance: float = 1e-3
    """Probability below which bits that fill up frames are not zero by chance."""

    layout_bits: int = 1 << 22
    """Bits all over a file by which layouts are distinguished."""
    layout_frames: tuple[int, int] = (8, 64)
    """Frames, at least and at most, that these bits are taken from."""

    # Order of bits (`formats`, `plausibility`).
    bit_order_ratio_difference: float = 0.05
    """Difference of the ratios of the two orders of bits that decides: it is about 1/8 where the spikes are regular."""

    across_bytes_below_share: float = 0.2
    """Covariance of neighbours in two bytes, as a fraction of that of neighbours in a byte, below which bytes hold
    their pixels in the other order: 0.6 to 0.9 in the recordings, below -0.9 where each of their bytes is reversed."""
    crossed_bytes_over_share: float = 0.9
    """Excess over it, as such a fraction, of the covariance of the pixels that the other order makes neighbours: below
    0 in the recordings, above 1.1 where each of their bytes is reversed."""

    # Axis of time (`axes`).
    least_side: int = 8
    """Rows, columns and frames from which on a reading is one of a sensor that could be recorded."""
    longest_side_ratio: int = 4
    """Longer side of a sensor, in shorter ones, up to which a reading is one: cameras have up to 2.5."""

    # Kinds of files (`magic`).
    head_bytes: int = 4096
    """Bytes of a file that are looked at: room for a text header of events, and more than any signature needs."""
    shortest_text_bytes: int = 12
    """Bytes that must be printable for a file to be text: by chance they are in one of 10⁵ files, all being
    different."""
    least_different_bytes: int = 10
    """Different characters of a text: one row of pixels over and over may be printable, but is one character or
    two."""


CONTENT = ContentSettings()
"""The thresholds by which files are read."""
