"""The sensor: recordings in and out, the simulator (paper, Eq. 1 and 2), playback, and samples from spikes.

    recording = read_recording("car.dat", size="400x250")
    picture = tfp(recording, key=50)
    simulation = simulate(Translation(photograph, (0.05, 0.1)), scale=4)

Names are looked up in their modules when first asked for: who only reads a recording does not wait for JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
