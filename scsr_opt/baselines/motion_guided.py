"""Multi-frame baselines: shift-and-add, and motion-guided super-resolution (MGSR)."""

from typing import SupportsFloat, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from scsr_opt.baselines.inputs import clip_of
from scsr_opt.baselines.playbacks import tfp_picture
from scsr_opt.baselines.settings import DEFAULT
from scsr_opt.baselines.solving import solved
from scsr_opt.camera.recording import USUAL_FRAMES, Recording
from scsr_opt.camera.samples import Samples, spike_intervals
from scsr_opt.motion.estimators.automatic import Dense, estimate_motion
from scsr_opt.motion.estimators.base import Estimator
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.motion.validation import validate_motion
from scsr_opt.operators.sampling import place
from scsr_opt.pipeline.clip import Clip
from scsr_opt.report.figures import bicubic


def shift_and_add(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
    motion: Motion | Estimator | None = None,
) -> Float[np.ndarray, "H W"]:
    """Every measurement put where it belongs on the fine grid, and averaged there (Elad and Hel-Or, 2001; Farsiu,
    Robinson, Elad and Milanfar, 2004).

        U(P) = Σ_j ω_j Y_j b(P − P_j) / Σ_j ω_j b(P − P_j)

    Y_j is the intensity over a spike interval, ω_j its length, P_j the HR position in the key frame of what its pixel
    saw in the middle of it, and b the bilinear weight. (Both papers add whole pictures and round their shifts to the
    fine grid; intervals have a shift each, and bilinear weights move nothing by what rounding loses. Farsiu et al. take
    the median, which is for outliers.) Pixels that no measurement fell on, or hardly any, take a Gaussian mean
    of those around, of the smallest width that finds some.

    U is the picture blurred by a sensor pixel and by the motion during the intervals. Both papers deblur it in a second
    step; that is left out here.

    **Arguments:**
    - `spikes`, `scale`, `key`, `white_rate`: as `tfp_bicubic`. 101 frames around the key frame are used; bad pixels are
      left out.
    - `motion`: a `Motion` or an `Estimator`; `Automatic` if None.

    **Returns:** (s·h, s·w) float32, intensity 1 = white.

    **Raises:** `InputError` if an argument cannot be used.
    """
    clip, scale = clip_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=USUAL_FRAMES)
    shape = (scale * clip.shape[0], scale * clip.shape[1])
    found = _motion(clip, motion)
    samples = spike_intervals(clip.spikes, white_rate=clip.white_rate, bad_pixels=clip.bad_pixels).padded()
    path = trajectory_of(found, key=clip.key, start=0, stop=len(clip.spikes))
    middle = (samples.start + samples.stop) / 2
    places = path.at(jnp.asarray(samples.row), jnp.asarray(samples.column), jnp.asarray(middle))
    row, column, seen = (np.asarray(v, np.float64) for v in places)
    weight = np.asarray(samples.weight) * seen
    centre = np.stack([row, column]) * scale + (scale - 1) / 2
    total, weights = _splat(centre, np.stack([weight * samples.value, weight]), shape)
    if not weights.any():  # nothing was measured: nothing to interpolate between
        return bicubic(tfp_picture(clip), scale)
    return _filled(total, weights, scale)


def _splat(
    position: Float[np.ndarray, "2 n"], values: Float[np.ndarray, "c n"], shape: tuple[int, int]
) -> Float[np.ndarray, "c H W"]:
    """Σ_j values_j b(P − position_j) at every pixel P; positions outside the pixels' centres are left out."""
    height, width = shape
    limit = np.array([[height - 1], [width - 1]])
    inside = ((position >= 0) & (position <= limit)).all(0)
    position, values = position[:, inside], values[:, inside]
    first = np.floor(position).astype(np.int64)
    down, right = position - first
    sums = np.zeros((len(values), height * width))
    for below, beside in ((0, 0), (0, 1), (1, 0), (1, 1)):
        tap = (down if below else 1 - down) * (right if beside else 1 - right)
        # Past the last row or column the tap is 0.
        row, column = np.minimum(first[0] + below, height - 1), np.minimum(first[1] + beside, width - 1)
        for sum_, value in zip(sums, values, strict=True):
            sum_ += np.bincount(row * width + column, value * tap, height * width)
    return sums.reshape(-1, height, width)


def _filled(total: Float[np.ndarray, "H W"], weight: Float[np.ndarray, "H W"], scale: int) -> Float[np.ndarray, "H W"]:
    """total / weight, and where there is little weight, normalised Gaussian means (Knutsson and Westin, 1993)."""
    around = np.full(total.shape, total.sum() / weight.sum())
    few = DEFAULT.neighbourhood_least_frames
    for width in DEFAULT.neighbourhoods_px:
        near, share = (gaussian_filter(v, width * scale) for v in (total, weight))
        around = (near + few * around) / (share + few)
    few = DEFAULT.pixel_least_frames
    return ((total + few * around) / (weight + few)).astype(np.float32)


def mgsr(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    white_rate: SupportsFloat | None = None,
    motion: Motion | Estimator | None = None,
) -> Float[np.ndarray, "H W"]:
    """Motion-guided super-resolution (MGSR), the classical predecessor of the paper's network, as far as it is known
    here: Zhao, Xie, Xiong, Zhang, Yu and Huang, "Super Resolve Dynamic Scene from Continuous Spike Streams", ICCV 2021.

    Between two spikes of a pixel exactly θ of light fell on it, and along the motion that light came from a known path
    over the HR picture. Every spike is an equation:

        ∫_{t_{k−1}}^{t_k} (D_s T_{key→t} X)(p) dt = θ        (light intensity and each spike)
        minimise over X   ½ Σ_k n_k (mean of (D_s T X)(p) over the interval − θ/n_k)² + λ TV(X)

    with n_k the interval's length in frames, divided by those of the recording.

    *What was read and what was assumed.* Read were the abstract and the first lines of the paper, the opening of a
    reader's notes on it, and what later papers of the group write of it. Not read was its method section, and no public
    code of it was found. Stated there: HR intensity is recovered from LR spikes; the relative motion of camera and
    objects tells which points of the scene a pixel's spikes speak of; from it follows a relation between the light
    intensity and each spike, and the picture from these relations; "complex optimization and rigorous assumptions
    (e.g. motion consistency)" limit it (Zhao et al., AAAI 2023). Assumed here, in each case what is usual for a method
    of its kind: optical flow gives a velocity for each pixel (the best of the dense estimates here, `Dense`); a surface
    keeps it over the recording (consistency) and nothing hides anything; least squares in which every frame counts the
    same; total variation as the regularisation, its strength by the noise; 101 frames, as `reconstruct`. So a figure of
    this function is that of a fair method of this description, not of the authors' implementation.

    What `reconstruct` has beside it: the simplest motion that the recording does not contradict, with acceleration,
    motion boundaries and occlusion, and all that was built since.

    **Arguments:**
    - `spikes`, `scale`, `key`, `white_rate`: as `tfp_bicubic`. 101 frames around the key frame are used; bad pixels are
      left out.
    - `motion`: a `Motion` or an `Estimator`; `Dense` without acceleration if None.

    **Returns:** (s·h, s·w) float32, intensity 1 = white.

    **Raises:** `InputError` if an argument cannot be used.
    """
    clip, scale = clip_of(spikes, scale=scale, key=key, white_rate=white_rate, frames=USUAL_FRAMES)
    shape = (scale * clip.shape[0], scale * clip.shape[1])
    frames = len(clip.spikes)
    found = _motion(clip, Dense(acceleration=False) if motion is None else motion)
    motion = Motion.of_velocity(found.velocity)  # the assumptions: it keeps its velocity and hides nothing
    samples = spike_intervals(clip.spikes, white_rate=clip.white_rate, bad_pixels=clip.bad_pixels)
    strength = DEFAULT.noise_factor * (_interval_noise(samples) / frames) ** 0.5 * 2 / scale
    path = trajectory_of(motion, key=clip.key, start=0, stop=frames)
    moved = scale * motion.speed[samples.row, samples.column] * (samples.stop - samples.start)
    long = moved.size > 0 and float(np.quantile(moved, 0.9)) > DEFAULT.long_exposure_px
    samples = eqx.tree_at(lambda s: s.weight, samples, samples.weight / np.float32(frames)).padded()
    placed = place(jax.tree.map(jnp.asarray, samples), path, scale=scale, finest=3 if long else 1, shape=shape)
    return solved(placed, bicubic(tfp_picture(clip), scale), strength)


def _motion(clip: Clip, motion: Motion | Estimator | None) -> Motion:
    if isinstance(motion, Motion):
        return validate_motion(motion, *clip.shape)
    return estimate_motion(
        clip.spikes, key=clip.key, white_rate=clip.white_rate, estimator=motion, bad_pixels=clip.bad_pixels
    )


def _interval_noise(samples: Samples) -> float:
    """Variance of an interval's intensity, times its frames, from how much neighbouring intervals of a pixel differ."""
    value, length = np.asarray(samples.value), np.asarray(samples.weight)
    follows = (samples.row[1:] == samples.row[:-1]) & (samples.column[1:] == samples.column[:-1])
    if not follows.any():
        return 1e-3
    noise = ((value[1:] - value[:-1]) ** 2 * (length[1:] + length[:-1]) / 4)[follows]
    # Passing edges are not noise; and spikes are counted in whole frames, so that there always is some.
    return max(float(np.minimum(noise, np.quantile(noise, 0.9)).mean()), 1e-3)
