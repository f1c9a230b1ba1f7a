from .flat import parse_size
from .formats import read_recording
from .noise import Noise, estimate_photons
from .playback import stp, tfi, tfp
from .rates import interval_rates
from .recording import Recording
from .samples import Samples, spike_intervals, windows
from .sampling_rules import Intervals, SamplingRule, Windows
from .scenes import Affine, Box, Ellipse, MovingObject, Scene, Static, Translation, TurningDisc
from .simulator import Sensor, Simulation, simulate
from .video import Video
from .writing import write_recording

__all__ = [
    "Affine",
    "Box",
    "Ellipse",
    "Intervals",
    "SamplingRule",
    "MovingObject",
    "Noise",
    "Recording",
    "Samples",
    "Scene",
    "Sensor",
    "Simulation",
    "Static",
    "Translation",
    "TurningDisc",
    "Video",
    "Windows",
    "estimate_photons",
    "interval_rates",
    "parse_size",
    "read_recording",
    "simulate",
    "spike_intervals",
    "stp",
    "tfi",
    "tfp",
    "windows",
    "write_recording",
]
