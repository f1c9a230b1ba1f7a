"""The whole path on one page: simulate a spike camera, reconstruct, compare with the truth.

A picture that comes with scikit-image moves past a simulated sensor, whose pixels see four by four of the picture's.
The recording is then treated like any other: the reconstruction knows the spikes and the rate of white, nothing else.
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scsr_opt._files import whole_file
from scsr_opt._kernels.programs import ready
from scsr_opt.camera import Recording, Sensor, Simulation, simulate, tfp, write_recording
from scsr_opt.camera.scenes import Affine
from scsr_opt.pipeline.solution import Solution
from scsr_opt.progress import Progress, check_progress
from scsr_opt.report import Report, bicubic, figure, write_picture

SCALE = 4
FRAMES = 101
KEY = FRAMES // 2
NAME = "camera"
"""Name of the picture in `skimage.data`."""
DRIFT = (0.03, 0.14)
"""Sensor pixels per frame, down and right: about 14 sensor pixels from the first frame to the last."""
ROTATION = 0.0008
"""Radians per frame: nearly 5 degrees in all."""


@dataclass(frozen=True)
class Demo:
    """Results of the demo.

    **Fields:**
    - `simulation`, `recording`, `solution`: in the order in which they came about.
    - `lines`: what to say of it.
    """

    simulation: Simulation
    recording: Recording
    solution: Solution
    lines: list[str] = field(default_factory=list)


def simulated() -> Simulation:
    """The demo's recording: 128x80 sensor pixels, 101 frames, of a camera that pans and turns a little."""
    from skimage import data

    picture = getattr(data, NAME)()[64:384]
    drift = (DRIFT[0] * SCALE, DRIFT[1] * SCALE)
    scene = Affine(picture, drift=drift, rotation=ROTATION, key=float(KEY))
    return simulate(scene, scale=SCALE, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=1)


def psnr(truth: Float[np.ndarray, "H W"], image: Float[np.ndarray, "H W"], border: int) -> float:
    """Peak signal-to-noise ratio in dB of intensities cut to 0..1, `border` pixels left out on each side."""
    from skimage.metrics import peak_signal_noise_ratio

    inner = np.s_[border:-border, border:-border]
    return float(peak_signal_noise_ratio(*(np.clip(one[inner], 0, 1) for one in (truth, image)), data_range=1.0))


FILES = ("recording.npz", "report.json", "truth.png", "picture.png", "figure.png")
"""Files that `run` writes."""


def run(folder: Path, *, progress: Progress | None = None) -> Demo:
    """Runs the demo and writes recording.npz, picture.png, truth.png, report.json and figure.png into `folder`.

    Where the solve fails (`solution.status.usable` is false) only the recording and the report are written.

    **Raises:** `InputError` if a file cannot be written.
    """
    from scsr_opt import reconstruct

    ready()
    check_progress(progress)
    simulation = simulated()
    recording = Recording.from_array(simulation.spikes, white_rate=simulation.white_rate, name="demo")
    write_recording(folder / "recording.npz", recording)
    started = time.perf_counter()
    solution = reconstruct(recording, scale=SCALE, key=KEY, progress=progress)
    seconds = {"solve": time.perf_counter() - started}
    report = Report.of(solution, seconds=seconds)
    report.write(folder / "report.json")
    if not solution.status.usable:
        return Demo(simulation, recording, solution)
    truth = simulation.truth(float(KEY))
    playback = bicubic(tfp(simulation.spikes, KEY, white_rate=simulation.white_rate), SCALE)
    scores = [psnr(truth, np.asarray(image), 8 * SCALE) for image in (playback, solution.image)]
    write_picture(folder / "truth.png", truth)
    write_picture(folder / "picture.png", solution.image)
    drawn = figure(solution, truth=truth, title="A simulated recording")
    with whole_file(folder / "figure.png") as temporary:
        drawn.savefig(temporary)
    lines = [
        *report.lines(),
        f"PSNR against the truth: {scores[0]:.2f} dB for playback enlarged, {scores[1]:.2f} dB for the reconstruction.",
        f"Look at {folder / 'figure.png'}: playback, reconstruction and truth side by side, the framed part enlarged.",
        f"The recording is {folder / 'recording.npz'}; try: scsr info {folder / 'recording.npz'}",
    ]
    return Demo(simulation, recording, solution, lines)
