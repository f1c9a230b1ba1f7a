"""Simpler ways to a high-resolution picture, to compare `reconstruct` with; each a function of the same form.

    image = BASELINES["mgsr"](spikes, scale=4, key=50, white_rate=0.6)

Every one takes (T, h, w) spikes or a `Recording` and the keyword arguments `scale`, `key` (the middle frame if None)
and `white_rate` (the recording's if None), and returns the picture (s·h, s·w). docs/baselines.md describes each and
what it reaches.
"""

from collections.abc import Callable

import numpy as np

from scsr_opt.baselines.conventional import conventional_camera as conventional_camera
from scsr_opt.baselines.motion_guided import mgsr as mgsr
from scsr_opt.baselines.motion_guided import shift_and_add as shift_and_add
from scsr_opt.baselines.playbacks import stp_bicubic as stp_bicubic
from scsr_opt.baselines.playbacks import tfi_bicubic as tfi_bicubic
from scsr_opt.baselines.playbacks import tfp_bicubic as tfp_bicubic
from scsr_opt.baselines.single_image import stp_sr as stp_sr
from scsr_opt.baselines.single_image import tfi_sr as tfi_sr
from scsr_opt.baselines.single_image import tfp_sr as tfp_sr

BASELINES: dict[str, Callable[..., np.ndarray]] = {
    function.__name__: function
    for function in (
        conventional_camera,
        tfp_bicubic,
        tfi_bicubic,
        stp_bicubic,
        tfp_sr,
        tfi_sr,
        stp_sr,
        shift_and_add,
        mgsr,
    )
}
"""All of them by name, in the order of a table: from one picture of the recording to all of its spikes."""
