"""What is known about pictures beforehand: the Ψ of Eq. 4, with its value and its proximal step."""

from scsr_opt.priors.analysis import Analysis
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.total_variation import Dual, TotalVariation

__all__ = ["Analysis", "Dual", "Prior", "TotalVariation"]
