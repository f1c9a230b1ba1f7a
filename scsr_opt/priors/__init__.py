"""Priors, knowledge about pictures beforehand: the Ψ of Eq. 4, with its value and its proximal step."""

from scsr_opt.priors.analysis import Analysis
from scsr_opt.priors.bilateral_total_variation import BilateralTotalVariation
from scsr_opt.priors.bounded import Bounded
from scsr_opt.priors.centred import Centred
from scsr_opt.priors.checks import check_prox
from scsr_opt.priors.denoisers import NumpyDenoiser, bilateral, nl_means, tv_chambolle
from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.priors.plug_and_play import PlugAndPlay
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.red import RED
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser
from scsr_opt.priors.total_generalized_variation import TotalGeneralizedVariation
from scsr_opt.priors.total_variation import Dual, TotalVariation
from scsr_opt.priors.wavelet import WaveletL1

__all__ = [
    "RED",
    "Analysis",
    "BilateralTotalVariation",
    "Bounded",
    "Centred",
    "Dual",
    "HuberTotalVariation",
    "NumpyDenoiser",
    "PlugAndPlay",
    "Prior",
    "RidgeRegulariser",
    "TotalGeneralizedVariation",
    "TotalVariation",
    "WaveletL1",
    "bilateral",
    "check_prox",
    "nl_means",
    "tv_chambolle",
]
