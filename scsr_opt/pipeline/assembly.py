"""Stages before the first iteration: motion, gains, samples, strength, and the problem that they make."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from scsr_opt._kernels.device import on_device
from scsr_opt._kernels.memory import give_memory_back
from scsr_opt.calibration.gain import gain_is_known, spread_of
from scsr_opt.calibration.optics import estimate_gaussian_optics
from scsr_opt.errors import InputError
from scsr_opt.motion.estimators.evidence import light_explains
from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.trajectory import Motion
from scsr_opt.operators.blur import Blur
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.operators.exposure import with_exact_exposure
from scsr_opt.pipeline.initial_image import initial_image
from scsr_opt.pipeline.measurement import Measurements
from scsr_opt.pipeline.outer_loop import Majorized, MajorizeMinimize
from scsr_opt.pipeline.scene_summary import SceneSummary
from scsr_opt.pipeline.solution import Diagnostics
from scsr_opt.pipeline.strength import ValidatedStrength, in_parts, noise_of_mean, strength_of_noise
from scsr_opt.pipeline.task import Task
from scsr_opt.solvers.default import default_solver, general_solver
from scsr_opt.solvers.loop import run
from scsr_opt.solvers.problem import Problem


@dataclass(frozen=True, eq=False)
class Assembly:
    """Eq. 4 for one picture, ready to be solved.

    **Fields:**
    - `task`; `motion`; `noise`, the standard deviation of a pixel's mean over the clip, intensity.
    - `gain` of each pixel, (h, w), None for 1; `gain_known`, (h, w), where the scene moves far enough to tell a pixel's
      gain; `gain_at_rest`, the gains found elsewhere, None where they were not looked for.
    - `measured`, the samples as they were taken; `measurements`, those that are solved for, over the gains found.
    - `scene`, the summary of what each part of the scene needed.
    - `method`, prior, strength, lens and solver.
    - `restores`: whether the solution is restored and solved for again (`Options.quality`).
    - `image`, X^(0); `near`, a picture near the solution, where one is known; `term`: M, c and e, where summed.
    - `diagnostics` so far.
    """

    task: Task
    motion: Motion
    noise: float
    gain: Float[np.ndarray, "h w"] | None
    gain_known: Bool[np.ndarray, "h w"]
    gain_at_rest: Float[np.ndarray, "h w"] | None
    measured: Measurements
    measurements: Measurements
    scene: SceneSummary | None
    method: MajorizeMinimize
    restores: bool
    image: Float[Array, "H W"]
    near: Float[Array, "H W"] | None
    term: DataTerm | None
    diagnostics: Diagnostics

    @property
    def usable(self) -> bool:
        """True where there is any sample to reconstruct from."""
        return bool(self.task.clip.spikes.any()) and bool((np.asarray(self.measurements.placed.weight) > 0).any())

    @property
    def strength(self) -> float:
        """λ."""
        return float(self.method.strength)

    def problem(self) -> Problem:
        """The problem that is solved: f with the motion during exposures and its exact gradient, Ψ, λ, and X^(0)."""
        term = self.method.term(self.measurements.placed) if self.term is None else self.term
        term = eqx.tree_at(lambda t: t.bound, term, None, is_leaf=lambda leaf: leaf is None)
        data = with_exact_exposure(term, self.measurements.placed)
        return Problem(data, self.method.prior, self.method.strength, start=self.image)

    def solve(self, state: Any = None) -> Majorized:
        """Solves from `image`, or from the `state` of a similar problem."""
        return self.method(self.measurements.placed, self.image, state, near=self.near, term=self.term)

    def with_validated_strength(self) -> "Assembly":
        """This problem with the strength that predicts held-out samples."""
        task, method, prior = self.task, self.method, self.task.options.prior
        assert prior is not None  # Options.validated
        search = task.strength_search(prior, method.solver, gain=self.gain, optics=method.optics, noise=self.noise)
        return self.with_strength(search.find(task.clip, self.motion, self.measurements, self.image))

    def with_strength(self, found: ValidatedStrength) -> "Assembly":
        """This problem with a validated strength, and the prior that it is for."""
        method = replace(self.method, strength=on_device(np.float32(found.strength)), prior=found.prior)
        restores = self.task.options.restores and found.restored
        known = replace(self.diagnostics, restored_deviations=found.deviations)
        return replace(self, method=method, restores=restores, near=found.image, term=found.term, diagnostics=known)

    def with_sums(self) -> "Assembly":
        """This problem with M and c summed."""
        return replace(self, term=self.method.term(self.measurements.placed, sums=self.term))


def assemble_task(task: Task) -> Assembly:
    """Motion, bad pixels, gains, samples, strength and problem of a task, in this order.

    **Raises:** `InputError` where the lens is to be estimated and the recording cannot tell it.
    """
    seconds, began = {"reading": task.reading_seconds}, time.perf_counter() - task.reading_seconds

    def lap(name: str) -> None:
        seconds[name] = time.perf_counter() - began - sum(seconds.values())

    gains, frames, known_motion = task.options.known_gain, None, None
    if task.clip.light is not None:
        task, frames, known_motion = _with_checked_light(task)
    elif task.estimator is not None:
        frames = task.motion_frames(gains)
    task = task.at_wanted_light()
    options, clip, prior = task.options, task.clip, task.options.prior
    assert prior is not None  # Options.validated
    shortcuts, settings = options.shortcuts, options.settings
    with ThreadPoolExecutor(1) as executor:  # what does not depend on the motion, beside it
        noise_task = executor.submit(noise_of_mean, clip, settings.strength)
        image_task = executor.submit(initial_image, clip, task.shape, sharp=True, settings=settings.sampling)
        early = options.finds_gain and shortcuts.sampled_gains  # little work, where windows of the sensor tell
        rest_task = executor.submit(task.estimate_gain_at_rest) if early else None
        motion = task.estimate_motion(frames) if known_motion is None else known_motion
        path_task = executor.submit(task.trajectory, motion)
        if options.finds_bad_pixels:  # so few that the motion stays as it is
            task = task.without(task.find_resting(frames, motion))
            clip = task.clip
        noise, image, path = noise_task.result(), image_task.result(), path_task.result()
        unexplained = task.light_unexplained(motion, frames)
    del frames
    give_memory_back()  # half of what the motion took, two gigabytes for a sensor of 1000×1000 pixels
    lap("motion")

    gain, at_rest, spread_at_rest = options.known_gain, None, None
    known = gain_is_known(motion.moved(len(clip.spikes)), settings.gain)
    if options.finds_gain and not known.all():
        at_rest = task.estimate_gain_at_rest() if rest_task is None else rest_task.result()
        gain = None if (at_rest == 1).all() else np.where(known, 1, at_rest)
        spread_at_rest = spread_of(at_rest, ~known)

    λ = options.strength
    if λ is None:
        λ = strength_of_noise(noise, task.scale, prior, settings.strength)
    method = MajorizeMinimize(
        # The default solver of the problem is chosen below, when its strength is known.
        solver=options.solver or general_solver(prior),
        prior=prior,
        strength=on_device(np.float32(float(λ))),
        optics=options.lens,
        robust=options.robust,
        keep_images=options.keep_images,
        finished_tiles=shortcuts.finished_tiles,
        settings=settings.outer_loop,
        tile_settings=settings.tiles,
    )
    strength_task = None
    with ThreadPoolExecutor(2) as executor:
        # Where strengths are tried on parts of the picture, these are measured anew, beside the whole.
        parts = in_parts(clip, task.scale, options.lens, settings.strength)
        if options.selects_strength and not options.estimates_optics and parts:
            search = task.strength_search(prior, method.solver, gain=gain, optics=options.lens, noise=noise)
            strength_task = executor.submit(search.find, clip, motion, path, image)
        measured = task.measure(motion, gain, path)
        scene_task = executor.submit(task.summarise, motion, measured, noise)
        lap("samples")
    assembly = Assembly(
        task=task,
        motion=motion,
        noise=noise,
        gain=gain,
        gain_known=known,
        gain_at_rest=at_rest,
        measured=measured,
        measurements=measured,
        scene=scene_task.result(),
        method=method,
        restores=options.restores,
        image=image,
        near=None,
        term=None,
        diagnostics=Diagnostics(
            gain_spread_at_rest=spread_at_rest,
            bad_pixels=None if task.bad is None else task.bad.numbers,
            light_depth=None if clip.light is None else clip.light.depth,
            light_frequency=_hertz(task),
            light_unexplained=unexplained,
            seconds=seconds,
        ),
    )
    if not assembly.usable:
        return assembly
    if options.estimates_optics:
        assembly = _with_estimated_optics(assembly)
    if strength_task is not None:
        assembly = assembly.with_strength(strength_task.result())
    elif options.selects_strength:
        assembly = assembly.with_validated_strength()
    if options.solver is None:
        block_diagonal = measured.placed.on_sensor and assembly.method.optics is None
        if assembly.restores:  # solved again, with a prior that has only a proximal step
            block_diagonal = False
        solver = default_solver(
            assembly.method.prior,
            strength=assembly.strength,
            scale=task.scale,
            block_diagonal=block_diagonal,
            steepest=settings.data_proximal_steepness,
        )
        assembly = replace(assembly, method=replace(assembly.method, solver=solver))
    lap("strength")
    return assembly.with_sums()


def _with_checked_light(task: Task) -> tuple[Task, MotionFrames | None, Motion]:
    """The task with its light of each pixel, or without where that explains nothing; its short pictures, and the motion
    in them."""
    gains, settings = task.options.known_gain, task.options.settings.motion
    plain = replace(task, clip=task.clip._replace(light=None))
    frames, lamps = task.motion_frames(gains), task.clip.light is not None and not task.clip.light.uniform
    motion = task.estimate_motion(frames)
    for _ in range(settings.light.lamp_rounds if lamps else 0):
        if frames is None:
            break
        task = task.with_light_along(motion, frames)
        frames = task.motion_frames(gains)
        motion = task.estimate_motion(frames)
    plain_frames = plain.motion_frames(gains)
    if frames is None or plain_frames is None:
        return task, frames, motion
    plain_motion = plain.estimate_motion(plain_frames)
    if light_explains((frames, motion), (plain_frames, plain_motion), settings):
        return task, frames, motion
    return plain, plain_frames, plain_motion


def _with_estimated_optics(assembly: Assembly) -> Assembly:
    """The assembly with the Gaussian lens that predicts held-out pixels best, by solves without corrections."""
    task, motion, method = assembly.task, assembly.motion, assembly.method
    measurements, settings = assembly.measurements, task.options.settings.optics
    moved = float(motion.speed.max()) * len(task.clip.spikes)
    if motion.speed.size < settings.least_pixels or moved < settings.least_motion_px:
        raise InputError(
            f"optics is 'estimate', but this recording has {motion.speed.size} pixels and moves by {moved:.2g} of "
            f"them; it takes {settings.least_pixels} pixels and a motion by {settings.least_motion_px:g} to tell a "
            f"lens from a soft picture: give the Blur."
        )

    def solved(term: DataTerm) -> Float[Array, "H W"]:
        return jnp.asarray(run(method.solver, Problem(term, method.prior, method.strength), assembly.image).image)

    pixel = measurements.padded.row * motion.speed.shape[1] + measurements.padded.column
    sigma = estimate_gaussian_optics(
        measurements.placed, jnp.asarray(pixel), solved, tried=settings.sigmas_px, share=settings.held_out_share
    ).sigma
    return replace(
        assembly,
        method=replace(method, optics=Blur.gaussian(task.shape, sigma * task.scale)),
        diagnostics=replace(assembly.diagnostics, optics_sigma=sigma),
    )


def _hertz(task: Task) -> float | None:
    """How often the light repeats, Hz; None where it does not."""
    light = task.clip.light
    return None if light is None or light.frequency is None else light.frequency * task.recording.readout_rate
