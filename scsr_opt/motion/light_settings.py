"""`LightSettings`: the numbers that the search for changes of the light hinges on.

Lengths are sensor pixels, times are frames. `MotionSettings` holds them as its field `light`.
"""

from dataclasses import dataclass

from scsr_opt._settings import Settings


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
    prediction_error: float = 0.02
    """Relative error of what a picture predicts for a pixel, where as many samples see what the pixel sees as in the
    mean; with fewer it is inversely larger, up to 1."""
    most_evidence: float = 10.0
    """Log-likelihood, at most, by which a pixel speaks for one lamp and against another."""
    border_evidence: float = 24.0
    """Log-likelihood that each sensor pixel of the length of a border between the parts of two lamps costs. With a
    quarter of it, and of `most_evidence` a third, 540 instead of 346 pixels of 32 recordings were wrong."""
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
