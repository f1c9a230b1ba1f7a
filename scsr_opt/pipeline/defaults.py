"""The default prior."""

import functools

from scsr_opt.pipeline.settings import PipelineSettings
from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser


@functools.cache
def default_prior(scale: int, learned_prior_scale: int = PipelineSettings().learned_prior_scale) -> Prior:
    """Ψ where none is named: `RidgeRegulariser.load()` up to `learned_prior_scale`, `HuberTotalVariation()` above."""
    return RidgeRegulariser.load() if scale <= learned_prior_scale else HuberTotalVariation()
