"""Settings of motion estimation reach their stages."""

import numpy as np
import pytest
from skimage import data

from scsr_opt import Options, reconstruct
from scsr_opt.camera.scenes import Translation
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.motion import Automatic, Layers, Motion, MotionSettings
from scsr_opt.motion.estimators.settings import ParametricSettings
from scsr_opt.motion.settings import EvidenceSettings, FrameSettings, ReliabilitySettings
from scsr_opt.motion.trajectory_settings import TrajectorySettings
from scsr_opt.pipeline.settings import PipelineSettings
from scsr_opt.pipeline.task import task_of

HEIGHT, WIDTH = 24, 32


@pytest.fixture(scope="module")
def pan() -> np.ndarray:
    """Spikes of a pan by 0.2 sensor pixels per frame."""
    scene = Translation(data.camera()[100:148, 100:164] / 255, velocity=(0.24, -0.32))
    return simulate(scene, scale=2, frames=61, sensor=Sensor(photons=1000.0), seed=0).spikes


def estimated(pan: np.ndarray, settings: MotionSettings) -> Motion:
    """The motion that `reconstruct` estimates by these settings."""
    task = task_of(pan, 2, None, Options(settings=PipelineSettings(motion=settings)))
    return task.estimate_motion(task.motion_frames(None))


def test_reconstruct_passes_settings_to_motion_frames_and_trust(pan):
    trust = estimated(pan, MotionSettings()).trust
    assert trust is not None and trust.after.size == 15 and trust.share.min() < 0.99
    settings = MotionSettings(frames=FrameSettings(most_pictures=9), reliability=ReliabilitySettings(error_weight=0.0))
    options = PipelineSettings(motion=settings)
    motion = reconstruct(pan, scale=2, strength=0.01, gain=None, settings=options).motion
    assert motion is not None and motion.trust is not None
    assert motion.trust.after.size == 9 and (motion.trust.share == 1).all()


def test_task_passes_settings_to_the_choice_of_motion(pan):
    """A pan that nothing may contradict is taken for rest."""
    assert estimated(pan, MotionSettings()).speed.min() > 0.15
    never = MotionSettings(
        evidence=EvidenceSettings(contradiction_likelihood=1e9), parametric=ParametricSettings(score_per_number=1e9)
    )
    assert not estimated(pan, never).moves


def test_task_passes_settings_to_the_trajectory(pan):
    """Half a pixel of motion: at the edge of the layer in front, pixels see it and the background by halves."""
    label = np.zeros((HEIGHT, WIDTH), np.int32)
    label[8:16, 10:20] = 1
    velocity = np.zeros((2, 2, HEIGHT, WIDTH), np.float32)
    velocity[1, 1] = 0.125
    layers = Layers(velocity, np.zeros_like(velocity), label, np.array([0, 1], np.int32))
    motion = Motion.of_layers(layers, np.ones((HEIGHT, WIDTH), np.float32))

    def visible(settings: TrajectorySettings) -> np.ndarray:
        options = Options(motion=motion, settings=PipelineSettings(motion=MotionSettings(trajectory=settings)))
        return np.asarray(task_of(pan, 2, 32, options).trajectory(motion).visible)

    usual, lenient = visible(TrajectorySettings()), visible(TrajectorySettings(partial_share=0.2, whole_share=0.4))
    assert (usual == 0).any() and (lenient >= usual).all() and lenient.sum() > usual.sum() + 1


def test_settings_of_equal_values_are_one_key_of_compiled_programs():
    assert MotionSettings() == MotionSettings() and hash(MotionSettings()) == hash(MotionSettings())
    assert Automatic().settings == Automatic(settings=MotionSettings()).settings
    assert MotionSettings(frames=FrameSettings(most_pictures=9)) != MotionSettings()
