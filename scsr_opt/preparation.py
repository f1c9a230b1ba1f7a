"""What is found out before the first iteration: motion, measurements, and how strong the prior has to be."""

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal, SupportsFloat, SupportsIndex

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from scsr_opt.camera.gain import gain_is_known, spread_of
from scsr_opt.camera.gain_network import gain_at_rest
from scsr_opt.camera.measuring import Intervals, Measuring
from scsr_opt.camera.recording import Recording
from scsr_opt.device import check_device
from scsr_opt.errors import InputError
from scsr_opt.inputs import check_type, flag, picture_shape, pixel_gain, prior_strength, whole
from scsr_opt.motion.alignment import Stretches
from scsr_opt.motion.estimate import Automatic, Estimator, comparable, motion_in
from scsr_opt.motion.handed_in import checked, given
from scsr_opt.motion.trajectory import Motion, Trajectory, trajectory_of
from scsr_opt.operators.blur import Blur
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.optics import estimate_gaussian_optics
from scsr_opt.operators.robust import Loss
from scsr_opt.placing import Measurements, Stream, first_picture, measured, stream_around
from scsr_opt.priors.default import default_prior
from scsr_opt.priors.prior import Prior
from scsr_opt.progress import Progress, check_progress
from scsr_opt.rounds import Rounds
from scsr_opt.skip import Plan, plan_of
from scsr_opt.solvers.default import default_solver
from scsr_opt.solvers.iterate import Solver, run
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA
from scsr_opt.strength import (
    Validated,
    in_parts,
    longest_merged,
    noise_of_mean,
    relative_strength,
    strength_of_noise,
    validated_strength,
)

# Spike frames used around the key frame (2.5 ms at 40 kHz): enough to see every sensor pixel through many apertures,
# short enough for motion to be smooth.
FRAMES = 101


class Clock:
    """Seconds by part of the work."""

    def __init__(self):
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now

    def resume(self) -> None:
        """What passed since the last lap was something else."""
        self._last = time.perf_counter()


@dataclass(frozen=True, eq=False)
class Asked:
    """What a picture is asked for by: a moment of a recording, and the options of `reconstruct`, checked.

    **Fields:** as the options, but for `gain`: "auto" or "blind" where gains are looked for, None where they are known;
    `lens`: None until "estimate" has found one; `estimator`: None where a motion was handed in; `validates`: whether
    the strength is looked for; `one_by_one`: whether no measurements are merged, as each is to be judged.
    """

    stream: Stream
    scale: int
    estimator: Estimator | None
    measuring: Measuring
    gain: Literal["auto", "blind"] | None
    lens: Blur | None
    refine: int
    skip: bool
    validates: bool
    one_by_one: bool

    def compared(self, gain: Float[np.ndarray, "h w"] | None) -> Stretches | None:
        """The pictures that show the motion, if any can."""
        stream = self.stream
        return comparable(
            stream.spikes, key=stream.key, white_rate=stream.white_rate, bad_pixels=stream.bad_pixels, gain=gain
        )

    def estimated(self, pictures: Stretches | None) -> Motion:
        """The motion that these show, by the estimator."""
        if pictures is None:
            return Motion.none(*self.stream.spikes.shape[1:])
        return motion_in(pictures, self.estimator)

    def followed(self, motion: Motion) -> Trajectory:
        """A motion through all frames."""
        return trajectory_of(motion, key=self.stream.key, start=0, stop=len(self.stream.spikes))

    def measured(
        self, motion: Motion, gain: Float[np.ndarray, "h w"] | None, path: Trajectory | None = None
    ) -> Measurements:
        """The measurements along a motion; `path`: as `followed`, where that is at hand."""
        # Where strengths are not tried, nothing has to stay in pieces for that.
        longest = longest_merged(self.stream, motion, self.scale, self.lens) if self.validates else None
        return measured(
            self.stream,
            self.followed(motion) if path is None else path,
            scale=self.scale,
            measuring=self.measuring,
            gain=gain,
            merge=self.skip,
            longest=1 if self.one_by_one else longest,
            on_sensor=self.skip and not self.refine,
        )

    def validated(
        self,
        motion: Motion,
        taken: Measurements | Trajectory,
        image: Float[Array, "H W"],
        rounds: Rounds,
        *,
        gain: Float[np.ndarray, "h w"] | None,
        noise: float,
    ) -> Validated:
        """The strength that predicts measurements which were held out; `taken`: as of `validated_strength`."""
        return validated_strength(
            self.stream,
            motion,
            taken,
            image,
            scale=self.scale,
            prior=rounds.prior,
            solver=rounds.solver,
            measuring=self.measuring,
            gain=gain,
            optics=rounds.optics,
            noise=noise,
            skip=self.skip,
        )

    def plan(self, motion: Motion, taken: Measurements, noise: float) -> Plan | None:
        """What the measurements were made by; None if nothing was to be skipped."""
        if not self.skip:
            return None
        samples = taken.samples
        plan = plan_of(
            self.stream.spikes,
            motion,
            taken.still_for,
            taken.merged_for,
            pixel=samples.row * self.stream.spikes.shape[2] + samples.column,
            light=taken.light,
            used=np.asarray(taken.placed.weight)[: samples.row.size],
            noise=noise * self.stream.white_rate,
            bad_pixels=self.stream.bad_pixels,
        )
        # Nothing else is ever merged.
        return plan if isinstance(self.measuring, Intervals) else replace(plan, intervals=plan.samples)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A problem that is ready to be solved (`scsr_opt.reconstruction.solve`).

    **Fields:**
    - `asked`, `motion`; `taken`: the measurements; `gains`: of each pixel, None for 1, and `resting`, those found where
      nothing moves; `noise`: standard deviation of a pixel's mean; `plan`.
    - `rounds`: how it is solved; `image`: X^(0); `near`: a picture near the solution, where there is one;
      `term`: M, c and e of the measurements, summed here, as a sequence prepares a picture while it solves for another.
    - `learned`: what was found about the camera. `clock`: how long each part took.
    """

    asked: Asked
    motion: Motion
    taken: Measurements
    gains: Float[np.ndarray, "h w"] | None
    resting: Float[np.ndarray, "h w"] | None
    noise: float
    plan: Plan | None
    rounds: Rounds
    image: Float[Array, "H W"]
    near: Float[Array, "H W"] | None
    term: DataTerm | None
    learned: dict[str, float]
    clock: Clock

    @property
    def usable(self) -> bool:
        """Whether there is anything to reconstruct from."""
        return bool(self.asked.stream.spikes.any()) and bool(jnp.any(self.taken.placed.weight > 0))

    def validated(self) -> Validated:
        """The strength that predicts measurements which were held out."""
        asked = self.asked
        return asked.validated(self.motion, self.taken, self.image, self.rounds, gain=self.gains, noise=self.noise)


def prepare(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    frames: SupportsIndex = FRAMES,
    white_rate: SupportsFloat | None = None,
    velocity: ArrayLike | Sequence[float | int] | Estimator | Motion | None = None,
    bad_pixels: ArrayLike | None = None,
    samples: Measuring | None = None,
    gain: ArrayLike | Literal["auto", "blind"] | None = "auto",
    optics: Blur | Literal["estimate"] | None = None,
    prior: Prior | None = None,
    strength: SupportsFloat | None = None,
    robust: Loss | None = None,
    solver: Solver | None = None,
    refine: SupportsIndex = 0,
    skip: bool = True,
    progress: Progress | None = None,
    keep_images: bool = False,
) -> Prepared:
    """All of `scsr_opt.reconstruct` before the first iteration; its arguments but `state`."""
    clock = Clock()
    check_device()
    check_progress(progress)
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
    height, width = recording.height, recording.width
    scale, skip = whole(scale, "scale", 1), flag(skip, "skip")
    shape = picture_shape(recording, scale)
    check_type(samples, Measuring, "samples", "Intervals()")
    check_type(prior, Prior, "prior", "HuberTotalVariation()")
    prior = default_prior(scale) if prior is None else prior
    check_type(solver, Solver, "solver", "FISTA()")
    if solver is not None:
        solver.check(prior)
    check_type(robust, Loss, "robust", "Huber()")
    lens = None if isinstance(optics, str) and optics == "estimate" else optics
    check_type(lens, Blur, "optics", "Blur.gaussian(shape, sigma), or 'estimate'")
    looked_for = gain if isinstance(gain, str) and gain in ("auto", "blind") else None
    gains = None if gain is None or looked_for is not None else pixel_gain(gain, height, width)
    refine = whole(refine, "refine", 0)
    if strength is not None:
        strength = prior_strength(strength)
    else:
        relative_strength(prior)  # one without is refused before anything is computed
    _, stream = stream_around(recording, key=key, frames=frames, white_rate=white_rate, bad_pixels=bad_pixels)
    velocity = Automatic(skip=skip) if velocity is None else velocity
    asked = Asked(
        stream=stream,
        scale=scale,
        estimator=velocity if isinstance(velocity, Estimator) else None,
        measuring=Intervals() if samples is None else samples,
        gain=looked_for,
        lens=lens,
        refine=refine,
        skip=skip,
        # Outliers that were held out would decide.
        validates=strength is None and robust is None,
        # A mean of intervals hides the outlier among them.
        one_by_one=robust is not None,
    )
    clock.lap("reading")

    def gains_at_rest() -> Float[np.ndarray, "h w"]:
        return gain_at_rest(stream.spikes, white_rate=stream.white_rate, bad_pixels=stream.bad_pixels, skip=skip)

    # First alone: of small pictures NumPy takes three times as long in two threads as in one after the other.
    pictures = asked.compared(gains) if isinstance(velocity, Estimator) else None
    with ThreadPoolExecutor(1) as beside:  # what the motion is not needed for
        by_noise = beside.submit(noise_of_mean, stream)
        started = beside.submit(first_picture, stream, shape, sharp=True)
        # Little work, where windows of the sensor tell; all of it waits until it is needed.
        at_rest = beside.submit(gains_at_rest) if looked_for is not None and skip else None
        if isinstance(velocity, Estimator):
            motion = asked.estimated(pictures)
        elif isinstance(velocity, Motion):
            motion = checked(velocity, height, width)
        else:
            motion = given(velocity, height, width)
        noise, image = by_noise.result(), started.result()
    del pictures  # hundreds of megabytes where the sensor is large
    clock.lap("motion")

    learned: dict[str, float] = {}
    known, resting = gain_is_known(motion.moved(len(stream.spikes))), None
    if looked_for is not None and not known.all():
        resting = gains_at_rest() if at_rest is None else at_rest.result()
        gains = None if (resting == 1).all() else np.where(known, 1, resting)
        learned["gain_spread_at_rest"] = spread_of(resting, ~known)
    λ = strength_of_noise(noise, scale, prior) if strength is None else strength
    rounds = Rounds(
        solver=FISTA() if solver is None else solver,
        prior=prior,
        strength=jnp.asarray(λ, jnp.float32),
        optics=lens,
        robust=robust,
        progress=progress,
        keep_images=keep_images,
        skip=skip,
    )
    path, found = asked.followed(motion), None
    with ThreadPoolExecutor(2) as beside:
        # What strengths are tried on is measured anew where it is no more than parts of the picture.
        if asked.validates and lens is optics and in_parts(stream, scale, lens):
            found = beside.submit(asked.validated, motion, path, image, rounds, gain=gains, noise=noise)
        taken = asked.measured(motion, gains, path)
        planned = beside.submit(asked.plan, motion, taken, noise)
        clock.lap("samples")
    plan = planned.result()
    prepared = Prepared(asked, motion, taken, gains, resting, noise, plan, rounds, image, None, None, learned, clock)
    if not prepared.usable:
        return prepared
    if lens is not optics:
        σ = learned["optics_sigma"] = _sigma_of_optics(taken, motion, stream, rounds, image)
        prepared = replace(prepared, rounds=replace(rounds, optics=Blur.gaussian(shape, σ * scale)))
    if asked.validates:
        λ, near, term = prepared.validated() if found is None else found.result()
        rounds = replace(prepared.rounds, strength=jnp.asarray(λ, jnp.float32))
        prepared = replace(prepared, rounds=rounds, near=near, term=term)
    if solver is None:
        apart = taken.placed.on_sensor and prepared.rounds.optics is None
        chosen = default_solver(prior, strength=λ, scale=scale, apart=apart)
        prepared = replace(prepared, rounds=replace(prepared.rounds, solver=chosen))
    clock.lap("strength")  # what it takes beyond the samples, where it is looked for beside them
    return replace(prepared, term=prepared.rounds.term(taken.placed, sums=prepared.term))


# Sensor pixels that it takes, at least, to predict a tenth of them from the others.
_ENOUGH = 100


def _sigma_of_optics(
    taken: Measurements, motion: Motion, stream: Stream, rounds: Rounds, image: Float[Array, "H W"]
) -> float:
    """Standard deviation of the lens's blur, sensor pixels, by solves without corrections."""
    moved = float(motion.speed.max()) * len(stream.spikes)
    if motion.speed.size < _ENOUGH or moved < 1:
        raise InputError(
            f"optics is 'estimate', but this recording has {motion.speed.size} pixels and moves by {moved:.2g} of "
            f"them; it takes {_ENOUGH} pixels and a motion by 1 to tell a lens from a soft picture: hand in the Blur."
        )

    def solved(term: DataTerm) -> Float[Array, "H W"]:
        return jnp.asarray(run(rounds.solver, Problem(term, rounds.prior, rounds.strength), image).image)

    pixel = taken.padded.row * motion.speed.shape[1] + taken.padded.column
    return estimate_gaussian_optics(taken.placed, jnp.asarray(pixel), solved).sigma
