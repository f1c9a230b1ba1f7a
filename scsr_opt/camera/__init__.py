"""The sensor: recordings in and out, the simulator (paper, Eq. 1 and 2), playback, and samples from spikes.

    recording = read_recording("car.dat", size="400x250")
    picture = tfp(recording, key=50)
    simulation = simulate(Translation(photograph, (0.05, 0.1)), scale=4)

Names are looked up in their modules when first asked for: who only reads a recording does not wait for JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scsr_opt.camera.flat import parse_size
    from scsr_opt.camera.formats import read_recording
    from scsr_opt.camera.gain import blind_gain, flat_gain, with_gain
    from scsr_opt.camera.gain_network import gain_at_rest
    from scsr_opt.camera.measuring import Intervals, Measuring, Windows
    from scsr_opt.camera.noise import Noise, estimate_photons
    from scsr_opt.camera.playback import stp, tfi, tfp
    from scsr_opt.camera.rates import interval_rates
    from scsr_opt.camera.recording import Recording
    from scsr_opt.camera.samples import Samples, spike_intervals, windows
    from scsr_opt.camera.scenes import Affine, Box, Ellipse, MovingObject, Scene, Static, Translation, TurningDisc
    from scsr_opt.camera.simulator import Sensor, Simulation, simulate
    from scsr_opt.camera.video import Video
    from scsr_opt.camera.writing import write_recording

_MODULES = {
    "recording": ("Recording",),
    "formats": ("read_recording",),
    "writing": ("write_recording",),
    "flat": ("parse_size",),
    "simulator": (
        "Sensor",
        "Simulation",
        "simulate",
    ),
    "scenes": (
        "Affine",
        "Box",
        "Ellipse",
        "MovingObject",
        "Scene",
        "Static",
        "Translation",
        "TurningDisc",
    ),
    "video": ("Video",),
    "playback": (
        "stp",
        "tfi",
        "tfp",
    ),
    "rates": ("interval_rates",),
    "samples": (
        "Samples",
        "spike_intervals",
        "windows",
    ),
    "measuring": (
        "Intervals",
        "Measuring",
        "Windows",
    ),
    "gain": (
        "blind_gain",
        "flat_gain",
        "with_gain",
    ),
    "gain_network": ("gain_at_rest",),
    "noise": (
        "Noise",
        "estimate_photons",
    ),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "Affine",
    "Box",
    "Ellipse",
    "Intervals",
    "Measuring",
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
    "blind_gain",
    "estimate_photons",
    "flat_gain",
    "gain_at_rest",
    "interval_rates",
    "parse_size",
    "read_recording",
    "simulate",
    "spike_intervals",
    "stp",
    "tfi",
    "tfp",
    "windows",
    "with_gain",
    "write_recording",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
