"""The observation model of Eq. 2 and 4: explicit operators with exact adjoints, and the data term in sampled form.

`Observation` is D_s H T_{k→i} for all frames, in the paper's order, and serves as the reference. `accumulate` makes the
`DataTerm` that reconstructions use, whose cost does not grow with the number of frames.
"""

from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.blur import Blur
from scsr_opt.operators.checks import DotTest, SpectralNorm, dot_test, norm_bound, spectral_norm
from scsr_opt.operators.data_term import DataTerm, Stencil
from scsr_opt.operators.downsample import Downsample
from scsr_opt.operators.exposure import with_exact_exposure, with_exposure
from scsr_opt.operators.losses import Huber, Loss, Welsch, robust_factors
from scsr_opt.operators.observation import Observation
from scsr_opt.operators.operator import Composition, LinearOperator
from scsr_opt.operators.sampling import PlacedSamples, Taps, accumulate, place
from scsr_opt.operators.warp import Warp

__all__ = [
    "Aperture",
    "Blur",
    "Composition",
    "DataTerm",
    "DotTest",
    "Downsample",
    "Huber",
    "LinearOperator",
    "Loss",
    "Observation",
    "PlacedSamples",
    "SpectralNorm",
    "Stencil",
    "Taps",
    "Warp",
    "Welsch",
    "accumulate",
    "dot_test",
    "norm_bound",
    "place",
    "robust_factors",
    "spectral_norm",
    "with_exact_exposure",
    "with_exposure",
]
