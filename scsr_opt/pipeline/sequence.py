"""Pictures of several key frames of one recording, each starting from motion, strength and picture of the one before.

Little changes from one key frame to the next: motions continue, and parts at rest have been solved for. The motion of
the last picture is therefore carried on along its own trajectories; only the labels of its layers are found again. The
motion is estimated again if the recording contradicts it more than at first, or after a number of frames. The strength
is then validated and the gains are estimated, and both are carried on together with the motion. The picture and the
prior's dual variables are moved along, and the solve starts from these, or from playback where there were few samples.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from typing import Any, NamedTuple, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from scsr_opt._kernels.programs import ready
from scsr_opt._validation import whole
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.white import White, find_white_around
from scsr_opt.errors import InputError, shown
from scsr_opt.motion.estimators.evidence import contradicted
from scsr_opt.motion.estimators.frames import MotionFrames
from scsr_opt.motion.estimators.layered import relabelled
from scsr_opt.motion.propagation import carry, moved_along
from scsr_opt.motion.reliability import with_trust
from scsr_opt.motion.trajectory import Motion
from scsr_opt.operators.sampling import PlacedSamples
from scsr_opt.pipeline.assembly import Assembly, assemble_task
from scsr_opt.pipeline.options import Options
from scsr_opt.pipeline.reconstruct import solve
from scsr_opt.pipeline.settings import SequenceSettings
from scsr_opt.pipeline.solution import Solution
from scsr_opt.pipeline.task import Task, task_of
from scsr_opt.progress import Progress, check_progress


def reconstruct_sequence(
    spikes: ArrayLike | Recording,
    keys: Iterable[SupportsIndex],
    *,
    scale: SupportsIndex,
    options: Options | None = None,
    progress: Progress | None = None,
    **changes: Any,
) -> Generator[Solution, None, None]:
    """The pictures X of the key frames `keys`, one after the other: Eq. 4 of the paper for each (`reconstruct`).

    A picture is solved for when the generator is asked for it, and the faster the less changed since the one before.
    Meanwhile motion, samples and problem of the next one are made.

    **Arguments:**
    - `spikes`, `scale`, `options`, `changes`, `progress`: as of `reconstruct`; `motion` must be None or an
      `Estimator`. A picture whose motion is carried on is solved to twice the solver's tolerance, as it starts nearer
      to its minimum.
    - `keys`: key frames, best in order and a few frames apart; a frame may be repeated.

    **Returns:** a `Solution` for each; `.image` is (s·h, s·w) float32, intensity, 1 = white; all have one `.white`.
    If `.diagnostics.motion_carried` is true, `.motion` was carried on from an earlier picture, and may differ from the
    motion that would be estimated at this key frame.

    **Raises:** `InputError` as `reconstruct`; for `key` and `state`, which the sequence determines itself; and, when
    the function is called, for keys that are no frames of the recording.
    """
    ready()
    check_progress(progress)
    for name in ("key", "state"):
        if name in changes:
            raise InputError(f"reconstruct_sequence was given {name}; it finds that itself, picture by picture.")
    asked = Options.of(options, changes)
    if isinstance(asked.motion, Motion):
        raise InputError(
            "reconstruct_sequence was given a Motion, which holds at one key frame; give an Estimator, or nothing."
        )
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
    frames, scale = _frames(keys, recording), whole(scale, "scale", 1)
    # Refuses what cannot be used now, not with the first picture, and copies arrays that the caller may overwrite.
    asked = asked.validated(recording, scale)
    return _pictures(replace(recording), frames, scale, asked, progress)


def _frames(keys: Any, recording: Recording) -> tuple[int, ...]:
    """The key frames as ints. **Raises:** `InputError` if one is no frame of the recording, or there is none."""
    frames = None if isinstance(keys, str | bytes) or not isinstance(keys, Iterable) else tuple(keys)
    if not frames:
        raise InputError(f"keys is {shown(keys)}; it must be the frames of the pictures: [50], or range(50, 100, 5).")
    return tuple(whole(key, f"keys[{number}]", 0, recording.frames - 1) for number, key in enumerate(frames))


def white_of_sequence(recording: Recording, keys: Sequence[int], scale: int, options: Options) -> White:
    """White of all pictures of a sequence, from the light of all their frames, without the isolated pixels that its
    middle picture finds."""
    part = recording if options.crop is None else recording.crop(*options.crop)
    middle = task_of(recording, scale, keys[len(keys) // 2], replace(options, light="constant"))
    frames, rate = whole(options.frames, "frames", 1), options.white_rate
    return find_white_around(
        part,
        min(keys),
        max(keys),
        frames,
        white_rate=None if rate is None else float(rate),
        bad_pixels=middle.clip.bad_pixels,
        settings=options.settings.white,
    )


class _Followed(NamedTuple):
    """A motion that was estimated, and what is carried on with it.

    **Fields:** `motion`, at frame `since`; `contradicted`, the share of the pixels that contradicted it then;
    `bad_pixels`, the option, with the pixels that were found; `options` of the pictures that follow: the gains, and
    where it was validated, the strength and what it is for.
    """

    motion: Motion
    since: int
    contradicted: float
    bad_pixels: Any
    options: dict[str, Any]


def _kept_options(
    options: Options, gain: Float[np.ndarray, "h w"] | None, strength: float | None, restored: bool
) -> dict[str, Any]:
    """`_Followed.options`, of what was found for a picture that was solved for with these options."""
    kept: dict[str, Any] = {"gain": gain}
    if not options.selects_strength:
        return kept
    if options.restores and not restored:  # the strength is that of the usual prior
        kept |= {"quality": "fast", "prior": None}
    return kept | {"strength": strength}


class _Moment(NamedTuple):
    """A key frame: `task`; `frames`, by which motion is compared; `carried`, the motion that was carried on to it, None
    where it was estimated; `followed`, the motion that it follows."""

    task: Task
    frames: MotionFrames | None
    carried: Motion | None
    followed: _Followed

    @property
    def key(self) -> int:
        """The key frame, counted from the recording's first frame."""
        return self.task.clip.key_frame


def _pictures(
    recording: Recording,
    keys: tuple[int, ...],
    scale: int,
    options: Options,
    progress: Progress | None,
) -> Generator[Solution, None, None]:
    white, settings = white_of_sequence(recording, keys, scale, options), options.settings.sequence

    def assembled(key: int, followed: _Followed | None) -> tuple[_Moment, Assembly]:
        """Motion and problem at a key frame."""
        if followed is not None and _reaches(followed, key, settings):
            task = task_of(recording, scale, key, replace(options, bad_pixels=followed.bad_pixels))
            frames = task.motion_frames(task.options.known_gain)
            motion = _carried(followed, frames, task)
            if motion is not None:
                changes = Options.of(task.options, {"motion": motion, **followed.options})
                assembly = assemble_task(task_of(recording, scale, key, changes))
                solver = assembly.method.solver
                solver = replace(solver, tolerance=settings.tolerance_factor * solver.tolerance)
                assembly = replace(assembly, method=replace(assembly.method, solver=solver))
                return _Moment(task, frames, motion, followed), assembly
        task = task_of(recording, scale, key, options)
        frames = task.motion_frames(task.options.known_gain)
        assembly = assemble_task(task)
        share = _contradicted(frames, assembly.motion, task)
        kept = _kept_options(task.options, assembly.gain, assembly.strength, assembly.restores)
        followed = _Followed(assembly.motion, key, share, assembly.task.options.bad_pixels, kept)
        return _Moment(task, frames, None, followed), assembly

    done, followed, before = 0, None, None
    while done < len(keys):
        with closing(_ahead(assembled, keys[done:], followed)) as steps:
            for now, assembly in steps:
                solution = solve(assembly, _start(now, assembly, before), progress, white)
                del assembly  # a third of a gigabyte for 400×250 pixels, which the next picture may need
                carried = replace(solution.diagnostics, motion_carried=now.carried is not None)
                solution = replace(solution, diagnostics=carried)
                followed = now.followed
                if not solution.status.usable or solution.motion is None:
                    followed = None
                elif now.carried is None and solution.motion is not followed.motion:
                    known = solution.diagnostics
                    kept = _kept_options(now.task.options, solution.gain, known.strength, known.restored is True)
                    share = _contradicted(now.frames, solution.motion, now.task)
                    followed = followed._replace(motion=solution.motion, contradicted=share, options=kept)
                before = None if followed is None else (now.key, solution)
                done += 1
                yield solution.handed_out()
                if followed is not now.followed and done < len(keys) and _reaches(now.followed, keys[done], settings):
                    break  # the pictures that were begun follow another motion


def _ahead(
    assembled: Callable[[int, _Followed | None], tuple[_Moment, Assembly]],
    keys: Sequence[int],
    followed: _Followed | None,
) -> Generator[tuple[_Moment, Assembly], None, None]:
    """Motion and problem at each key frame, each made in a thread while the one before it is used. Nothing here holds
    on to what was used."""
    with ThreadPoolExecutor(1) as beside:
        task = beside.submit(assembled, keys[0], followed)
        for following in keys[1:]:
            task, made = beside.submit(assembled, following, task.result()[0].followed), task
            yield made.result()
            del made
        yield task.result()


def _start(now: _Moment, assembly: Assembly, before: tuple[int, Solution] | None) -> Any:
    """The state of the last solve, moved along to this picture, with playback where hardly anything of it was seen;
    None where the motion is new."""
    if before is None or now.carried is None:
        return None
    key, solution = before
    assert solution.motion is not None  # or there were nothing to carry on
    kept = assembly.method.solver.kept(solution.state)
    settings = assembly.task.options.settings.motion.trajectory
    moved = moved_along(solution.motion, now.key - key, assembly.task.scale, kept, settings)
    if moved is kept:
        return kept
    there = assembly.method.solver.image(moved)
    seen_share = assembly.task.options.settings.sequence.seen_share
    begun = _where_seen(assembly.measurements.placed, there, assembly.image, seen_share)
    return jax.tree.map(lambda leaf: begun if leaf is there else leaf, moved)


@eqx.filter_jit
def _where_seen(
    placed: PlacedSamples, picture: Float[Array, "H W"], elsewhere: Float[Array, "H W"], seen_share: float
) -> Float[Array, "H W"]:
    """`picture`, and where hardly any of the samples are, the picture `elsewhere`."""
    seen, s = placed.seen(), placed.scale
    hardly = seen < seen_share * jnp.mean(seen)
    return jnp.where(jnp.repeat(jnp.repeat(hardly, s, axis=1), s, axis=0), elsewhere, picture)


def _carried(followed: _Followed, frames: MotionFrames | None, task: Task) -> Motion | None:
    """The motion at the task's key frame, with its trust; None if the recording contradicts it."""
    key, settings, limits = task.clip.key_frame, task.options.settings.motion, task.options.settings.sequence
    motion = carry(followed.motion, key - followed.since, settings.trajectory)
    if frames is not None:
        motion = relabelled(frames, motion, settings)
    most = limits.contradicted_factor * followed.contradicted + limits.contradicted_share
    if _contradicted(frames, motion, task) > most:
        return None
    return motion if frames is None else with_trust(frames, motion, settings)


def _reaches(followed: _Followed, key: int, settings: SequenceSettings) -> bool:
    """Whether a motion may be carried on to a key frame, if the recording does not contradict it there."""
    return abs(key - followed.since) <= settings.carried_frames


def _contradicted(frames: MotionFrames | None, motion: Motion, task: Task) -> float:
    """The share of the pixels that contradict a motion."""
    return 0.0 if frames is None else float(contradicted(frames, motion, task.options.settings.motion).mean())
