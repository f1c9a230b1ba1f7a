"""The prior of those who name none."""

import functools

from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser

# Up to ×2 what was learned of pictures is worth 0.8 dB; at ×4 it is worth 0.1 and takes four times as long
# (docs/measurements.md).
_LEARNED = 2


@functools.cache
def default_prior(scale: int) -> Prior:
    """Ψ where none is named: `RidgeRegulariser.load()` up to a scale of 2, `HuberTotalVariation()` above."""
    return RidgeRegulariser.load() if scale <= _LEARNED else HuberTotalVariation()
