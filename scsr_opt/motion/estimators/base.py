"""`Estimator`: the base class of all motion estimators."""

import abc

import equinox as eqx

from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.trajectory import Motion


class Estimator(eqx.Module):
    """An estimator of the motion around a key frame; `reconstruct` calls it with short pictures of the clip."""

    @abc.abstractmethod
    def __call__(self, pictures: MotionFrames) -> Motion:
        """The `Motion`, in sensor pixels on the key frame's grid (h, w), of the scene in these pictures."""
