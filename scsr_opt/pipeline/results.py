"""The `Solution` of a problem that was solved: its picture, and the numbers of all stages."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from scsr_opt.camera.saturation import share_saturated, spike_counts
from scsr_opt.camera.white import White
from scsr_opt.pipeline.assembly import Assembly
from scsr_opt.pipeline.solution import Diagnostics, Solution
from scsr_opt.pipeline.updates import Finished
from scsr_opt.priors.centred import Centred
from scsr_opt.solvers.record import Status


def solution_of(finished: Finished, white: White, seconds: float) -> Solution:
    """The solution after all updates; `seconds`: how long its solves and updates took."""
    assembly, found, stages, first = finished
    used = assembly.measurements.used_frames(assembly.task.clip.key)
    outcome, placed, clip = found.outcome, assembly.measurements.placed, assembly.task.clip
    known, prior = assembly.diagnostics, assembly.method.prior
    if first and isinstance(prior, Centred):
        prior = prior.prior
    diagnostics: Diagnostics = replace(
        known,
        iterations=len(stages),
        quality="best" if first else "fast",
        first_iterations=first or None,
        centred_strength=assembly.strength if first else None,
        misfit_ratio=stages[-1].data / max(stages[first - 1].data, np.finfo(np.float32).tiny) if first else None,
        restored=assembly.restores if assembly.task.options.restores else None,
        solver=type(assembly.method.solver).__name__,
        prior=type(prior).__name__,
        samples=int(np.count_nonzero(placed.weight)),
        positions=placed.finest,
        strength=assembly.strength if known.strength is None else known.strength,
        used_frames=_least_usual_most(used),
        objective=stages[-1].objective,
        speed_max=float(assembly.motion.speed.max()),
        saturated=share_saturated(spike_counts(clip.spikes), len(clip.spikes), clip.bad_pixels),
        seconds={**known.seconds, "solving": seconds - known.seconds.get("restoring", 0.0)},
    )
    return _solution(
        assembly,
        image=outcome.image,
        status=outcome.status,
        stages=stages,
        diagnostics=diagnostics,
        used_frames=used,
        tiles=outcome.tiles,
        white=white,
        state=outcome.state,
    )


def without_picture(assembly: Assembly, white: White) -> Solution:
    """The solution where there is no sample to solve from: a black picture, and a status that says so."""
    nothing = np.zeros(assembly.image.shape, np.float32)
    return _solution(assembly, image=nothing, status=Status.no_samples, diagnostics=assembly.diagnostics, white=white)


def _least_usual_most(used: Float[np.ndarray, "h w"]) -> tuple[float, float, float] | None:
    """The 5 %, 50 % and 95 % quantiles of the pixels that were used."""
    some = used[used > 0]
    if not some.size:
        return None
    least, usual, most = np.quantile(some, (0.05, 0.5, 0.95)).tolist()
    return least, usual, most


def _solution(assembly: Assembly, **found: Any) -> Solution:
    task = assembly.task
    known = {"recording": task.recording, "scale": task.scale, "key": task.clip.key_frame}
    known |= {"white_rate": task.clip.white_rate, "crop": task.options.crop}
    known |= {"light": task.clip.light, "scene": assembly.scene, "bad_pixels": task.bad}
    return Solution(**known, motion=assembly.motion, gain=assembly.gain, **found)
