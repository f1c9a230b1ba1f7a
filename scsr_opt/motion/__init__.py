"""Motion of the scene: velocities, estimators of them, and the trajectories that follow from them.

Velocities are (2, h, w), sensor pixels per frame, [0] down, [1] right, on the key frame's grid.
"""

from scsr_opt.motion.estimators.automatic import Automatic as Automatic
from scsr_opt.motion.estimators.automatic import Dense as Dense
from scsr_opt.motion.estimators.automatic import Global as Global
from scsr_opt.motion.estimators.automatic import Still as Still
from scsr_opt.motion.estimators.automatic import estimate_motion as estimate_motion
from scsr_opt.motion.estimators.base import Estimator as Estimator
from scsr_opt.motion.estimators.frames import MotionFrames as MotionFrames
from scsr_opt.motion.estimators.optical_flow import ILK as ILK
from scsr_opt.motion.estimators.optical_flow import TVL1 as TVL1
from scsr_opt.motion.estimators.phase import PhaseCorrelation as PhaseCorrelation
from scsr_opt.motion.settings import MotionSettings as MotionSettings
from scsr_opt.motion.trajectory import Layers as Layers
from scsr_opt.motion.trajectory import Motion as Motion
from scsr_opt.motion.trajectory import Trajectory as Trajectory
from scsr_opt.motion.trajectory import Trust as Trust
from scsr_opt.motion.trajectory import trajectory_of as trajectory_of
