"""From spikes to a super-resolved picture: the stages of Eq. 4, one after the other.

    clip ─► motion ─► gains, lens ─► samples ─► strength λ ─► M, c ─► solve ─► Solution
            `──────────────── assemble_task ────────────────'        ▲   │
                                                             updates └───┘

`reconstruct` runs all stages; `assemble` stops before the first iteration and returns the problem, for a solver or a
prior of one's own. `reconstruct_sequence` (`scsr_opt.pipeline.sequence`) solves for many key frames.
"""

import time
from dataclasses import replace
from typing import Any, SupportsIndex

from numpy.typing import ArrayLike

from scsr_opt.camera.recording import Recording
from scsr_opt.camera.white import White
from scsr_opt.errors import InputError, SolveError
from scsr_opt.pipeline.assembly import Assembly, assemble_task
from scsr_opt.pipeline.options import Options
from scsr_opt.pipeline.results import solution_of, without_picture
from scsr_opt.pipeline.solution import Solution
from scsr_opt.pipeline.task import task_of
from scsr_opt.pipeline.updates import CentreUpdate, GainUpdate, LightUpdate, MotionRefinement, solve_with_updates
from scsr_opt.progress import NoProgress, Progress, check_progress
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.record import Status

UPDATES = (LightUpdate(), GainUpdate(), MotionRefinement(), CentreUpdate())
"""Updates that are applied between two solves, in this order."""


def reconstruct(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    options: Options | None = None,
    state: Any = None,
    progress: Progress | None = None,
    throw: bool = False,
    **changes: Any,
) -> Solution:
    """The high-resolution picture X of a moment, from all spikes around it (paper, Eq. 4).

    **Arguments:**
    - `spikes`: (T, h, w) of 0 and 1, or a `Recording`.
    - `scale`: s ≥ 1, any integer; 1 denoises and sharpens only.
    - `key`: frame whose picture is solved for, 0 … T−1; the middle one if None.
    - `options`, `changes`: how to solve (`Options`); `reconstruct(…, strength=0.01)` changes a field of
      `options`, or of the defaults.
    - `state`: `Solution.state` of a similar problem (other strength, data, or more iterations) with the same solver,
      prior and size, from which the solve starts.
    - `progress`: shows what is being done, such as `scsr_opt.report.LineProgress(every=5)`: first motion and strength,
      then the iterations. The first call for a size compiles programs for 10 to 20 s, in silence without it.
    - `throw`: raise `SolveError` where the solve fails. By default the failure is in `Solution.status`.

    The arrays of the caller are copied, or read before the function returns, and never written to. Those of the
    `Solution` belong to the caller.

    **Returns:** `Solution`; `.image` is (s·h, s·w) float32, intensity, 1 = white.

    **Raises:** `InputError` if an argument cannot be used.
    """
    check_progress(progress)
    options = Options.of(options, changes)
    meter = NoProgress() if progress is None else progress
    meter.start(None, "finding motion and strength")
    try:
        assembly = assemble_task(task_of(spikes, scale, key, options))
    finally:
        meter.finish()
    solution = solve(assembly, state, progress).handed_out()
    if throw and not solution.status.usable:
        raise SolveError(solution.status.message)
    return solution


def assemble(
    spikes: ArrayLike | Recording,
    *,
    scale: SupportsIndex,
    key: SupportsIndex | None = None,
    options: Options | None = None,
    **changes: Any,
) -> Problem:
    """Eq. 4 for a moment, up to the first iteration: for a solver or a prior of one's own, or `jax.grad`.

    Arguments and errors are those of `reconstruct`. The motion during exposures is part of the problem: `data.value`
    and `data.gradient` are exact, so every solver ends at the picture of `reconstruct` (without gain and refinement
    rounds, which solve again). A robust loss is no quadratic, and is refused.

    **Returns:** `Problem` with `data` f, `prior` Ψ, `strength` λ and `start` X^(0), (s·h, s·w).
    """
    task = task_of(spikes, scale, key, Options.of(options, changes))
    if task.options.robust is not None:
        raise InputError("assemble was given a robust loss; it gives the problem with squares: leave robust out.")
    assembly = assemble_task(task)
    if not assembly.usable:
        raise InputError(f"There is no problem to assemble: {Status.no_samples.clause}.")
    return assembly.problem()


def solve(
    assembly: Assembly, state: Any = None, progress: Progress | None = None, white: White | None = None
) -> Solution:
    """All of `reconstruct` from the first iteration on: solve, then update and solve again.

    `white`: of 8-bit pictures and figures; that of the clip if None.
    """
    white = assembly.task.find_white() if white is None else white
    if not assembly.usable:
        return without_picture(assembly, white)
    began = time.perf_counter()
    assembly = replace(assembly, method=replace(assembly.method, progress=progress))
    finished = solve_with_updates(assembly, state, UPDATES)
    return solution_of(finished, white, time.perf_counter() - began)
