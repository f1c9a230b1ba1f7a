"""A conventional camera that looks at the same scene (the paper's Fig. 7)."""

from typing import SupportsFloat, SupportsIndex

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from scsr_opt._validation import number
from scsr_opt.baselines.inputs import clip_of, repaired
from scsr_opt.baselines.settings import DEFAULT
from scsr_opt.camera.rates import interval_rates
from scsr_opt.camera.recording import Recording
from scsr_opt.errors import InputError
from scsr_opt.report.figures import bicubic
from scsr_opt.report.pictures import quantise

FRAME_TIME = 1 / 120
"""Seconds: the frame time of the conventional camera in the paper's Fig. 7."""


def conventional_camera(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
    exposure: SupportsFloat | None = None,
    read_noise: SupportsFloat = 0.0,
    seed: int = 0,
) -> Float[np.ndarray, "H W"]:
    """The picture that a conventional camera with the same lens and the same pixels would have taken.

        round(255 · clip(mean light during the exposure + noise, 0, 1)) / 255, enlarged by bicubic interpolation

    All light between opening and closing of the shutter makes one picture: what moves meanwhile is blurred. The paper
    compares with a camera at 120 frames per second in auto-exposure mode; the exposure it chose is not given. Intensity
    1 is taken as full scale, without gamma. The light is read off the exact times of the spikes, so the recording's
    own quantisation adds about one of the 255 steps to an exposure of 100 frames, less to longer ones.

    **Arguments:**
    - `spikes`, `scale`, `key`, `white_rate`: as `tfp_bicubic`.
    - `exposure`: seconds, its middle at the key frame; rounded to whole frames of the recording's `readout_rate`
      (40,000 a second for an array). If not given: 1/120 s, or as much of it as the recording has around the key frame.
    - `read_noise`: standard deviation of the camera's own Gaussian noise, in steps of 1/255. The photons' noise is that
      of the recording.
    - `seed`: of that noise.

    **Returns:** (s·h, s·w) float32, intensity 1 = white.

    **Raises:** `InputError` if an argument cannot be used, or the exposure reaches past the recording's end.
    """
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
    noise = number(read_noise, "read_noise", lambda v: v >= 0, "of at least 0, in steps of 1/255")
    seconds = FRAME_TIME if exposure is None else number(exposure, "exposure", lambda v: v > 0, "above 0, in seconds")
    # Cut at one more than there are: that is refused below, and infinitely many could not be rounded.
    frames = max(round(min(seconds * recording.readout_rate, recording.frames + 1)), 1)
    clip, scale = clip_of(
        recording,
        scale=scale,
        key=key,
        white_rate=white_rate,
        frames=min(frames + 2 * DEFAULT.exposure_margin_frames, recording.frames),
    )
    # Frame t is the light of [t − ½, t + ½].
    before, after = clip.key + 0.5, len(clip.spikes) - clip.key - 0.5
    half = frames / 2
    if exposure is None:
        half = min(half, before, after)
    elif half > min(before, after):
        fits = 2 * min(before, after)
        raise InputError(
            f"exposure is {seconds:g} s, {seconds * recording.readout_rate:.0f} frames, but only {fits:.0f} lie around "
            f"the key frame: ask for at most {fits / recording.readout_rate:g} s, or choose another key frame."
        )
    edges = np.array([clip.key - half, clip.key + half])
    light = repaired(clip, interval_rates(clip.spikes, edges, white_rate=clip.white_rate)[0])
    noisy = light + noise / 255 * np.random.default_rng(seed).standard_normal(light.shape)
    return bicubic(quantise(noisy).astype(np.float32) / np.float32(255), scale)
