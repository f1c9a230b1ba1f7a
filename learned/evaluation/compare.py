"""Optimizers and networks side by side, stage by stage, on one recording and by one measure: Eq. 4.

The problem is assembled once (`learned.evaluation.reference_problem`): motion, samples, strength λ, and Huber-TV as Ψ.
Every X^(t) of every model is measured by it, whatever prior or network made it. Where the scene moves during exposures,
f is taken exact at each X^(t), so that all are measured by the same f.
"""

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, SupportsFloat, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from learned.evaluation.costs import Cost, cost
from learned.evaluation.inference import Run, sparing
from learned.evaluation.reference_problem import PRIOR, ReferenceProblem, read, reference_problem, reference_task
from learned.evaluation.stage_report import SHARED, Comparison, Hybrid, ModelStages, StageMeasures, shown_stages
from learned.training.validation import border_of, psnr, quality
from learned.zoo import LoadedModel, Model, Network, Optimizer, model
from scsr_opt._arrays import as_array
from scsr_opt.camera.recording import Recording
from scsr_opt.errors import InputError, shown
from scsr_opt.pipeline.solution import Solution
from scsr_opt.pipeline.task import Task
from scsr_opt.progress import NoProgress, Progress, check_progress
from scsr_opt.solvers.proximal_gradient import FISTA
from scsr_opt.solvers.record import Status

# Solver of the reference solution, and the solver that starts at a network's picture.
_CONVERGED = Optimizer("fista-huber", PRIOR, FISTA(iterations=2000, tolerance=1e-6))
_ORDINARY = Optimizer("fista-huber", PRIOR, FISTA())
# Largest ratio of the means of a true picture and of the recording's light. Pictures in other units are further off:
# numbers of an 8-bit file by 255, and by 1/257 if these are read as numbers of 16 bits. What moves into the picture,
# and a white rate that is not quite right, change it less.
_TRUTH_RATIO = 8.0


def compare_stages(
    spikes: ArrayLike | Recording,
    models: Sequence[str | Model | LoadedModel],
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    truth: ArrayLike | None = None,
    white_rate: SupportsFloat | None = None,
    gain: ArrayLike | None = None,
    strength: SupportsFloat | None = None,
    costs: bool = True,
    progress: Progress | None = None,
) -> Comparison:
    """Every stage of every model on one recording, and each kind of model started at the other's picture.

    Optimizers use the λ of the shared problem, which is found for Huber-TV, times the relative strength of their prior;
    `reconstruct` finds the λ of each prior anew, which may give a better picture. Optimizers keep both pictures of each
    iteration until these are measured, 8 bytes a pixel and iteration.

    **Arguments:**
    - `spikes`, `scale`, `key`, `white_rate`, `gain`, `strength`: as of `reconstruct`; gains of 1 if none are given.
    - `models`: a list of names (`learned.zoo`), paths of `.scsr` files, or models (also of `load_model`); each once.
    - `truth`: (s·h, s·w), the picture of the key frame, intensity (1 = white), where it is known;
      `scsr_opt.report.read_picture` reads it from a file.
    - `costs`: whether seconds and FLOPs are measured, for which a network is compiled once for each of its stages.
    - `progress`: reports the models that are done.

    **Raises:** `InputError` if an argument cannot be used, or the recording holds no usable sample.
    """
    check_progress(progress)
    if isinstance(models, str):
        raise InputError(f"models is {models!r}; it must be a list of names, such as {models.split(',')}.")
    task = reference_task(spikes, scale=scale, key=key, white_rate=white_rate)
    known = None if truth is None else _truth(task, truth)
    chosen = [_model(one, task.scale) for one in models]
    if not chosen:
        raise InputError("There is nothing to compare: name at least one model.")
    number = Counter(one.name for one in chosen)
    again = sorted(name for name, times in number.items() if times > 1)
    if again:
        raise InputError(f"Of the models to compare, {', '.join(again)} comes more than once: name each once.")
    for one in chosen:
        one.check(task.scale)
    networks = [one for one in chosen if isinstance(one, Network)]
    meter = NoProgress() if progress is None else progress
    meter.start(2 + len(chosen) + len(networks), "comparing")
    try:
        posed = reference_problem(task, gain=gain, strength=strength)
        if not posed.usable:
            raise InputError(Status.no_samples.message)
        meter.advance(1)
        solution = _CONVERGED.solve(posed)
        # Once more, to time it without compilation.
        before = reference_problem(task, gain=gain, strength=strength).seconds if costs else None
        measure = _Measure(posed, jnp.asarray(solution.image), known, before)
        meter.advance(1)
        rows, last = [], {}
        for one in chosen:
            row, last[one.name] = measure.optimizer(one) if isinstance(one, Optimizer) else measure.network(one)
            rows.append(row)
            meter.advance(1)
        scratch = _ORDINARY.solve(posed) if networks else None
        hybrids = []
        for one in networks:
            if scratch is not None and np.isfinite(last[one.name]).all():
                hybrids.append(_hybrid(measure, one, last[one.name], scratch))
            meter.advance(1)
    finally:
        meter.finish()
    return Comparison(
        recording=task.recording,
        scale=task.scale,
        key=task.clip.key_frame,
        frames=len(task.clip.spikes),
        strength=float(posed.strength),
        reference=solution.image,
        reference_objective=float(read(posed, jnp.asarray(solution.image)).objective),
        reference_status=solution.status,
        reference_iterations=len(solution.stages),
        truth=known,
        models=tuple(rows),
        hybrids=tuple(hybrids),
    )


def _model(one: Any, scale: int) -> Model:
    """**Raises:** `InputError` if it is neither a model nor the name of one."""
    known = model(one, scale) if isinstance(one, str) else one.model if isinstance(one, LoadedModel) else one
    if not isinstance(known, Optimizer | Network):
        raise InputError(f"models holds {shown(one)}; give names of models, paths of .scsr files, or models.")
    return known


def _truth(task: Task, truth: ArrayLike) -> Float[np.ndarray, "H W"]:
    """**Raises:** `InputError` if it is no picture of the shape that is solved for, or certainly not in intensity."""
    picture = as_array(truth, "The truth")
    if picture.shape != task.shape or picture.dtype.kind not in "fiu":
        raise InputError(
            f"The truth is {picture.dtype} of shape {picture.shape}; it must hold numbers and be of the shape of the "
            f"pictures, {task.shape}."
        )
    picture = picture.astype(np.float32)
    if not np.isfinite(picture).all():
        raise InputError("The truth holds a value that is not finite; every pixel of it must be a finite number.")
    mean, measured = float(picture.mean()), float(task.clip.spikes.mean() / task.clip.white_rate)
    if measured and not measured / _TRUTH_RATIO <= mean <= measured * _TRUTH_RATIO:
        raise InputError(
            f"The truth's mean is {mean:.3g}, but the recording's light is {measured:.3g} in the mean: the truth must "
            f"be intensity, 1 = white, as scsr_opt.report.read_picture reads it from a file of any number of bits."
        )
    return picture


class _Stage(NamedTuple):
    """A stage that is to be measured: R^(t), X^(t), and the model's own objective there (NaN if it has none)."""

    gradient_step: Any
    image: Any
    own: float


@dataclass(frozen=True)
class _Measure:
    """The measure of the stages of one model.

    **Fields:** `posed`; `reference`, the converged solution; `truth`, if known; `before`, the seconds that assembling
    takes, None if costs are not measured.
    """

    posed: ReferenceProblem
    reference: Float[Array, "H W"]
    truth: Float[np.ndarray, "H W"] | None
    before: float | None

    def optimizer(self, model: Optimizer) -> tuple[ModelStages, Float[np.ndarray, "H W"]]:
        solution = model.solve(self.posed, keep_images=True)
        stages = [_Stage(s.gradient_step, s.image, s.objective) for s in solution.stages]
        each = None
        if self.before is not None:
            problem = model.problem(self.posed)
            state = eqx.filter_jit(model.solver.init)(problem, self.posed.first)
            each = cost(model.solver.step, problem, state)
        measured, pictures = self._all(self.posed.first, stages, [_times(each, t) for t in range(1, len(stages) + 1)])
        prior = SHARED if eqx.tree_equal(model.prior, PRIOR) else type(model.prior).__name__
        strength = solution.diagnostics.strength
        row = ModelStages(model.name, solution.status, self.before, measured, pictures, prior, strength)
        return row, solution.image

    def network(
        self, model: Network, start: Float[np.ndarray, "H W"] | None = None, *, costs: bool = True
    ) -> tuple[ModelStages, Float[np.ndarray, "H W"]]:
        found = model.run(self.posed.task, start, self.posed.motion)
        stages = [_Stage(*pictures, math.nan) for pictures in zip(found.gradient_steps, found.images, strict=True)]
        spent: list[Cost | None] = [None] * len(stages)
        before = None
        if self.before is not None and costs:
            begin = time.perf_counter()
            made = model.call(self.posed.task)
            jax.block_until_ready(eqx.filter(made.arguments, eqx.is_array))
            before = time.perf_counter() - begin
            spent = [
                cost(_upto, made.function, made.arguments, place, options=sparing()) for place in range(len(stages))
            ]
        measured, pictures = self._all(found.start, stages, spent)
        image = np.asarray(found.images[-1])
        status = Status.stages_done if np.isfinite(image).all() else Status.non_finite
        return ModelStages(model.name, status, before, measured, pictures), image

    def _all(
        self, start: Float[Array, "H W"], stages: Sequence[_Stage], spent: Sequence[Cost | None]
    ) -> tuple[tuple[StageMeasures, ...], dict[int, tuple[np.ndarray, np.ndarray]]]:
        shown = shown_stages(len(stages))
        measured, pictures = [], {}
        before, slope = start, read(self.posed, start).slope
        for number, (stage, each) in enumerate(zip(stages, spent, strict=True), 1):
            step, image = jnp.asarray(stage.gradient_step), jnp.asarray(stage.image)
            reading, numbers = read(self.posed, image), _numbers(before, slope, step, image, self.reference)
            measures = {name: float(value) for name, value in numbers._asdict().items()}
            data, prior = float(reading.data), float(reading.prior)
            misfit = max(2 * data / self.posed.weight, 0.0)
            measured.append(
                StageMeasures(
                    number=number,
                    objective=data + prior,
                    data=data,
                    prior=prior,
                    own=stage.own,
                    misfit=math.sqrt(misfit) if math.isfinite(misfit) else math.nan,
                    **measures,
                    **self._judged(stage.image, number in shown),
                    seconds=math.nan if each is None else each.seconds,
                    flops=math.nan if each is None or each.flops is None else each.flops,
                )
            )
            if number in shown:
                pictures[number] = (np.asarray(stage.gradient_step), np.asarray(stage.image))
            before, slope = image, reading.slope
        return tuple(measured), pictures

    def _judged(self, image: Any, shown: bool) -> dict[str, float]:
        """PSNR; and of the stages shown the structural similarity, which takes a second for a large picture."""
        if self.truth is None:
            return {"psnr": math.nan, "ssim": math.nan}
        border = border_of(min(self.posed.task.clip.shape), self.posed.task.scale)
        if shown:
            return dict(zip(("psnr", "ssim"), quality(self.truth, image, border), strict=True))
        return {"psnr": psnr(self.truth, image, border), "ssim": math.nan}


class _Numbers(NamedTuple):
    """‖X − X*‖/‖X*‖; ‖X − X^(t−1)‖/‖X^(t−1)‖; the cosines of R − X^(t−1) and X − X^(t−1) with the steepest
    descent at X^(t−1)."""

    distance: Float[Array, ""]
    change: Float[Array, ""]
    downhill_r: Float[Array, ""]
    downhill_x: Float[Array, ""]


@jax.jit
def _numbers(
    before: Float[Array, "H W"],
    slope: Float[Array, "H W"],
    gradient_step: Float[Array, "H W"],
    image: Float[Array, "H W"],
    reference: Float[Array, "H W"],
) -> _Numbers:
    return _Numbers(
        _norm(image - reference) / _norm(reference),
        _norm(image - before) / _norm(before),
        _cosine(gradient_step - before, -slope),
        _cosine(image - before, -slope),
    )


def _norm(image: Float[Array, "H W"]) -> Float[Array, ""]:
    return jnp.linalg.norm(image)


def _cosine(a: Float[Array, "H W"], b: Float[Array, "H W"]) -> Float[Array, ""]:
    """⟨a, b⟩ / (‖a‖ ‖b‖); not a number where one of them is 0, which has no direction."""
    return jnp.sum((a / _norm(a)) * (b / _norm(b)))


def _upto(function: Any, arguments: tuple[Any, ...], place: int) -> Float[Array, "H W"]:
    """X^(t) alone: the compiler leaves out the stages after it."""
    found: Run = function(*arguments)
    return found.images[place]


def _times(each: Cost | None, count: int) -> Cost | None:
    return None if each is None else Cost(each.seconds * count, None if each.flops is None else each.flops * count)


def _hybrid(measure: _Measure, network: Network, image: Float[np.ndarray, "H W"], scratch: Solution) -> Hybrid:
    posed = measure.posed
    went_on = _ORDINARY.solve(posed, start=image)
    row, _ = measure.network(network, np.asarray(measure.reference), costs=False)
    return Hybrid(
        network=network.name,
        optimizer=_ORDINARY.name,
        iterations_from_scratch=len(scratch.stages),
        objective_from_scratch=float(read(posed, jnp.asarray(scratch.image)).objective),
        iterations=len(went_on.stages),
        objective=float(read(posed, jnp.asarray(went_on.image)).objective),
        stages=row.stages,
    )
