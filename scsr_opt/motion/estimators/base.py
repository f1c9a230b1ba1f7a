"""The face that every way of finding the motion has."""

import equinox as eqx

from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.trajectory import Motion


class Estimator(eqx.Module):
    """How the motion is found; called by `reconstruct` with the recording's stretches."""

    def __call__(self, pictures: MotionFrames) -> Motion:
        raise NotImplementedError
