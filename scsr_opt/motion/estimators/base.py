"""`Estimator`: the base class of everything that finds the motion of a recording."""

import abc

import equinox as eqx

from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.trajectory import Motion


class Estimator(eqx.Module):
    """Estimator of the motion around a key frame; `reconstruct` calls it with pictures of the recording's times."""

    @abc.abstractmethod
    def __call__(self, pictures: MotionFrames) -> Motion:
        """The motion, (h, w), that these pictures show."""
