"""Solving for the pictures of a plan into a store, by this process or by workers, and going on where a run ended."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from scsr_opt._kernels.memory import give_memory_back
from scsr_opt._kernels.programs import ready
from scsr_opt.camera.white import White
from scsr_opt.errors import InputError
from scsr_opt.pipeline.sequence import reconstruct_sequence, white_of_sequence
from scsr_opt.progress import NoProgress, Progress, check_progress
from scsr_opt.sequences.cluster import Workers, solve_by_workers
from scsr_opt.sequences.files import held, remove, tidy
from scsr_opt.sequences.layout import STATUS_CODES, is_store, need_zarr
from scsr_opt.sequences.outputs import SequenceFormat, export
from scsr_opt.sequences.plan import Plan
from scsr_opt.sequences.store import Picture, SequenceStore

Result = TypeVar("Result")


@dataclass(frozen=True)
class Written:
    """What came of a sequence: `path` that was written, what is known of its `pictures`, how many of them were `there`
    when the run began, and `white` of what is looked at."""

    path: Path
    pictures: list[Picture]
    there: int
    white: str

    @property
    def failed(self) -> list[Picture]:
        """The pictures whose solve failed."""
        return [one for one in self.pictures if one.status is None or not one.status.usable]

    @property
    def estimated(self) -> list[int]:
        """Key frames at which motion was estimated."""
        return [one.key for one in self.pictures if one.motion_from == one.key]


def write_sequence(
    plan: Plan,
    output: str | os.PathLike[str] | SequenceFormat,
    *,
    workers: Workers | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Written:
    """Solves for the pictures of `plan` and writes them to `output`, going on where a run of the same plan ended.

    Pictures go into a store: `output` itself if it ends in `.zarr`, or else `output`.unfinished.zarr beside it, from
    which `output` is made at the end and which is removed then. Memory does not grow with the number of pictures.

    **Arguments:**
    - `output`: see `SequenceFormat`.
    - `workers`: processes that solve for groups of pictures; this process if None. The pictures do not depend on it.
    - `overwrite`: replace an output, or a store of another plan. A store of this plan is gone on with either way.

    **Returns:** what came of it. Where every solve failed, an output other than a store is not written.

    **Raises:** `InputError` if something else is there, the store is another plan's or is being written by another
    run, the recording cannot be read any more, or the disk is full. What is in the store stays.
    """
    check_progress(progress)
    meter = NoProgress() if progress is None else progress
    chosen = output if isinstance(output, SequenceFormat) else SequenceFormat.of(output)
    need_zarr()
    chosen.check(overwrite)
    place = chosen.store
    with held(place):
        store = _prepared(place, plan, overwrite)
        groups, pictures = store.groups, len(plan.keys)
        left = _metered(meter, pictures, "Checking", store.unfinished)
        there = pictures - sum(len(groups[number]) for number in left)

        def solve(solved: Callable[[int], None]) -> None:
            if workers is None:
                for number in left:
                    solve_group(store, plan, number, solved)
            else:
                solve_by_workers(workers, store.path, plan, left, solved)

        if left:
            ready()
            _metered(meter, pictures - there, "Solving", solve)
        written = Written(chosen.path, store.pictures(), there, store.white.sentence)
        missing = sum(one.status is None for one in written.pictures)
        if missing:
            raise InputError(f"{missing} of {pictures} pictures are missing in {place}: give the command again.")
        if not chosen.is_store:
            if len(written.failed) < pictures:
                chosen.begin()
                export(store, chosen, overwrite=overwrite, progress=meter)
            remove(place)
    return written


def solve_group(store: SequenceStore, plan: Plan, number: int, solved: Callable[[int], None]) -> None:
    """Solves for the pictures of a group into the store, from its first one on, whatever is there of it.

    **Arguments:** `solved`: called with 1 after each picture.
    """
    numbers = store.groups[number]
    keys = [plan.keys[one] for one in numbers]
    results: dict[str, list] = {"status": [], "motion_from": [], "iterations": [], "strength": []}
    origin = keys[0]
    solutions = reconstruct_sequence(plan.recording, keys, scale=plan.scale, options=plan.options)
    for one, key, solution in zip(numbers, keys, solutions, strict=True):
        store.write_picture(one, solution)
        give_memory_back()
        found = solution.diagnostics
        origin = origin if found.motion_carried else key
        results["status"].append(STATUS_CODES[solution.status])
        results["motion_from"].append(origin)
        results["iterations"].append(found.iterations)
        results["strength"].append(float("nan") if found.strength is None else found.strength)
        solved(1)
    store.write_results(numbers, results)


def _prepared(place: Path, plan: Plan, overwrite: bool) -> SequenceStore:
    """The store of the plan, made if there is none."""
    if place.exists() or place.is_symlink():
        if not is_store(place):
            raise InputError(f"{place} is there already and is no store of a sequence: give another name.")
        try:
            store = SequenceStore.open(place, write=True)
            store.check(plan)
        except InputError:
            if not overwrite:
                raise
        else:
            tidy(place)
            store.mend_fixed(plan)
            return store
    return SequenceStore.create(place, plan, _white_of(plan))


def _white_of(plan: Plan) -> White:
    """White of all pictures of a plan."""
    if plan.white is not None:
        return plan.white
    ready()
    return white_of_sequence(plan.recording, plan.keys, plan.scale, plan.options)


def _metered(meter: Progress, total: int, what: str, work: Callable[[Callable[[int], None]], Result]) -> Result:
    """What `work` returns, which gets `meter.advance` to report its steps by."""
    meter.start(total, what)
    try:
        return work(meter.advance)
    finally:
        meter.finish()
