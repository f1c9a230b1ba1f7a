"""One translation for the whole scene, found by phase correlation of pictures along the recording.

The peak of a cross-correlation is searched over the whole picture, so that no first guess is needed and no motion is
too fast, which Gauss–Newton (`parametric`) does not guarantee. In return there is one velocity for everything that
moves.

Pictures close in time are compared first; farther ones after they have been moved back by the velocity found so far.
Then a remainder of a pixel or two is left, and a window that fades out the border (which does not move) causes no bias.
The median over the pairs of a level removes single failures.

Source: Guizar-Sicairos, Thurman and Fienup, "Efficient subpixel image registration algorithms", Optics Letters 2008, as
in `skimage.registration.phase_cross_correlation`.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, shift
from skimage.registration import phase_cross_correlation

from scsr_opt.errors import InputError
from scsr_opt.motion.estimators.base import Estimator
from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.settings import DEFAULTS, MotionSettings
from scsr_opt.motion.trajectory import Motion


class PhaseCorrelation(Estimator):
    """One velocity for the whole scene, by phase correlation.

    Suitable for a scene that moves as a whole, by less than half its size between neighbouring stretches; of a scene
    with several motions, the one of the most contrast is found. The confidence, equal for all pixels, measures how well
    the pairs agree: ½ where their velocities, over the recording, scatter by a pixel (median absolute deviation).
    Pictures smaller than 8 × 8 sensor pixels or without any contrast show no motion (confidence 0).

    **Fields:** `upsampling`: a pair's displacement is found to 1 / `upsampling` sensor pixels. `settings`: thresholds.

    **Raises:** `InputError` for `upsampling` below 1, and if there are fewer than two stretches.
    """

    upsampling: int = 50
    settings: MotionSettings = eqx.field(static=True, default=DEFAULTS, kw_only=True)

    def __check_init__(self):
        if self.upsampling < 1:
            raise InputError(f"upsampling is {self.upsampling}; it must be a whole number of at least 1.")

    def __call__(self, pictures: MotionFrames) -> Motion:
        images = np.asarray(pictures.picture)
        number, height, width = images.shape
        if number < 2:
            raise InputError(
                f"The recording gives {number} picture(s), but phase correlation compares at least two: "
                "use more frames."
            )
        options, least = self.settings.phase, self.settings.comparison.least_side_px
        if min(height, width) < least:
            return _no_motion(height, width)
        fine, coarse = (gaussian_filter(images, sigma, axes=(1, 2)) for sigma in options.band_px)
        contrast = fine - coarse
        if not (contrast.std((1, 2)) > options.least_contrast).all():
            return _no_motion(height, width)
        times = np.asarray(pictures.after, np.float64)
        length = times[-1] - times[0]
        velocity, scatter = np.zeros(2), 0.0
        for span in options.span_shares:
            apart = min(max(round(span * (number - 1)), 1), number - 1)
            starts = np.unique(np.linspace(0, number - 1 - apart, options.most_pairs).round().astype(int))
            gaps = times[starts + apart] - times[starts]
            pairs = zip(starts, gaps, strict=True)
            found = [
                _displacement(contrast[k], contrast[k + apart], velocity * gap, self.upsampling, least)
                for k, gap in pairs
            ]
            velocities = np.array(
                [d / gap for d, gap in zip(found, gaps, strict=True) if d is not None], np.float64
            ).reshape(-1, 2)
            if len(velocities) == 0:
                break
            velocity = np.median(velocities, axis=0)
            scatter = float(np.median(np.abs(velocities - velocity), axis=0).max())
        field = np.broadcast_to(velocity[:, None, None], (2, height, width))
        return Motion.of_velocity(field, np.full((height, width), 1 / (1 + (scatter * length) ** 2)))


def _no_motion(height: int, width: int) -> Motion:
    """Rest, with confidence 0."""
    return Motion.of_velocity(np.zeros((2, height, width)), np.zeros((height, width)))


def _displacement(
    first: Float[np.ndarray, "h w"],
    second: Float[np.ndarray, "h w"],
    known: Float[np.ndarray, " 2"],
    upsampling: int,
    least: int,
) -> Float[np.ndarray, " 2"] | None:
    """Displacement of the picture from `first` to `second`, sensor pixels, near a `known` one; None if that leaves an
    overlap of fewer than `least` pixels a side."""
    whole = np.rint(known)
    size = np.array(first.shape)
    overlap = size - np.abs(whole).astype(int)
    if (overlap < least).any():
        return None
    # The parts that overlap: a point at p in the first lies at p + whole in the second. The rest of the known
    # displacement, half a pixel at most, is halved between the pictures, so that both are blurred alike.
    origin = np.maximum(-whole, 0).astype(int)
    there = np.maximum(whole, 0).astype(int)
    a = first[origin[0] : origin[0] + overlap[0], origin[1] : origin[1] + overlap[1]]
    b = second[there[0] : there[0] + overlap[0], there[1] : there[1] + overlap[1]]
    rest = known - whole
    if rest.any():
        a = shift(a, rest / 2, order=1, mode="nearest")
        b = shift(b, -rest / 2, order=1, mode="nearest")
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in overlap))
    a, b = (window * (x - (window * x).sum() / window.sum()) for x in (a, b))
    if not (a.any() and b.any()):
        return None
    # No normalisation, which its documentation allows though its annotation does not: phases alone would weight the
    # noise of empty frequencies as much as the picture.
    moved_back, _, _ = phase_cross_correlation(
        a,
        b,
        upsample_factor=upsampling,
        normalization=None,  # pyright: ignore[reportArgumentType]
    )
    return known - np.asarray(moved_back)
