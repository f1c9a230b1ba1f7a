"""Pictures of several moments of one recording, each starting from what is known of the one before.

From one key frame to the next little changes: what moves goes on moving, what rests has been solved for. So the motion
of the last picture is carried on along its own trajectories; only which of its layers is seen where is looked at anew.
It is estimated anew where the recording contradicts it more than it did, or after a while; the strength is validated
then and carried on with it. The picture and the prior's dual variables are moved along, and the solve goes on from
there.
"""

from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, SupportsIndex

from numpy.typing import ArrayLike

from scsr_opt.camera.recording import Recording
from scsr_opt.errors import InputError
from scsr_opt.inputs import pixel_gain, whole
from scsr_opt.motion.alignment import Stretches
from scsr_opt.motion.carry import carry, moved_along
from scsr_opt.motion.estimate import comparable
from scsr_opt.motion.estimator import Estimator
from scsr_opt.motion.evidence import contradicted
from scsr_opt.motion.layers import relabelled
from scsr_opt.motion.trajectory import Motion
from scsr_opt.motion.trust import trusted
from scsr_opt.placing import stream_around
from scsr_opt.preparation import FRAMES, Prepared, prepare
from scsr_opt.reconstruction import solve
from scsr_opt.solvers.solution import Solution

# A motion is carried on for so many frames at most. On a recording of a car passing pixels that were held out were
# predicted as well as by a motion estimated anew after 5, 20 and 40 frames (0.1219, 0.1206, 0.1202 for 0.1222, 0.1202,
# 0.1200).
_OLDEST = 40
# And as long as no more pixels contradict it than did when it was estimated, times this, and this share of all: on that
# recording 14, 15 and 19 % did after 0, 5 and 20 frames.
_MORE, _SHARE = 2.0, 0.005
# After the last of the keys.
_END: Any = object()


def sequence(
    spikes: ArrayLike | Recording, keys: Iterable[SupportsIndex], *, scale: SupportsIndex, **options: Any
) -> Generator[Solution, None, None]:
    """The pictures X of the moments `keys`, one after the other: Eq. 4 of the paper for each (`reconstruct`).

    Made as they are asked for, and the faster the less happens between them. While a picture is solved for, or used,
    the next one is prepared.

    **Arguments:**
    - `spikes`, `scale`, `options`: as of `reconstruct`; without `key` and `state`, and `velocity` None or an
      `Estimator`.
    - `keys`: frames, best in order and a few frames apart.

    **Returns:** a `Solution` for each; `.image` is (s·h, s·w) float32, intensity 1 = white. Where
    `.stats["carried"]` is true, `.motion` is that of a picture before, carried on: not always what would be estimated
    there.

    **Raises:** `InputError` as `reconstruct`, and for options that it finds itself.
    """
    for name in ("key", "state"):
        if name in options:
            raise InputError(f"sequence was given {name}; it finds that itself, picture by picture.")
    estimator = options.pop("velocity", None)
    if estimator is not None and not isinstance(estimator, Estimator):
        raise InputError("sequence was given a velocity, which holds at one moment; hand in an Estimator, or nothing.")
    if isinstance(keys, str) or not isinstance(keys, Iterable):
        raise InputError(f"keys is {keys!r}; it must be the frames of the pictures: [50], or range(50, 100, 5).")
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
    return _pictures(recording, keys, whole(scale, "scale", 1), estimator, options)


class _Followed(NamedTuple):
    """The `motion` that was estimated last, at frame `since`, the share of the pixels that contradicted it then,
    `against`, and the `strength` that was found with it; None where it was not looked for."""

    motion: Motion
    since: int
    against: float
    strength: float | None


class _Ready(NamedTuple):
    """A picture that can be solved for, at frame `key`; whether its motion was `carried` on, and from where."""

    key: int
    prepared: Prepared
    pictures: Stretches | None
    carried: bool
    followed: _Followed


def _pictures(
    recording: Recording,
    keys: Iterable[SupportsIndex],
    scale: int,
    estimator: Estimator | None,
    options: dict[str, Any],
) -> Generator[Solution, None, None]:
    around = {name: options.get(name) for name in ("white_rate", "bad_pixels")}
    gain = options.get("gain")
    gains = None if gain is None or isinstance(gain, str) else pixel_gain(gain, recording.height, recording.width)

    def ready(key: SupportsIndex, followed: _Followed | None) -> _Ready:
        moment, stream = stream_around(recording, key=key, frames=options.get("frames", FRAMES), **around)
        pictures = comparable(
            stream.spikes, key=stream.key, white_rate=stream.white_rate, bad_pixels=stream.bad_pixels, gain=gains
        )
        motion = None if followed is None else _carried(followed, pictures, moment)
        given = dict(options, velocity=estimator if motion is None else motion)
        if followed is not None and motion is not None and followed.strength is not None:
            given["strength"] = followed.strength
        prepared = prepare(recording, scale=scale, key=moment, **given)
        if followed is None or motion is None:
            λ = float(prepared.rounds.strength) if prepared.asked.validates else None
            followed = _Followed(prepared.motion, moment, _against(pictures, prepared.motion), λ)
        return _Ready(moment, prepared, pictures, motion is not None, followed)

    waiting, before = iter(keys), None
    # While a picture is solved for the next one is prepared: that takes its motion, but not the picture.
    with ThreadPoolExecutor(1) as ahead:
        key = next(waiting, _END)
        task = None if key is _END else ahead.submit(ready, key, None)
        while task is not None:
            now = task.result()
            key = next(waiting, _END)
            task = None if key is _END else ahead.submit(ready, key, now.followed)
            solution = solve(now.prepared, _start(now, before))
            solution.stats["carried"] = now.carried
            followed = now.followed
            if not solution.result.good or solution.motion is None:
                followed = None
            elif not now.carried and solution.motion is not now.prepared.motion:
                λ = None if followed.strength is None else solution.stats["strength"]
                followed = _Followed(solution.motion, now.key, _against(now.pictures, solution.motion), λ)
            if task is not None and followed is not now.followed:
                task = ahead.submit(ready, key, followed)  # what was begun is not what is wanted
            before = None if followed is None else (now.key, solution)
            yield solution


def _start(now: _Ready, before: tuple[int, Solution] | None) -> Any:
    """The state of the last solve, moved along to this picture; None where the motion is new."""
    if before is None or not now.carried:
        return None
    key, solution = before
    assert solution.motion is not None  # or there were nothing to carry on
    kept = now.prepared.rounds.solver.kept(solution.state)
    return moved_along(solution.motion, now.key - key, now.prepared.asked.scale, kept)


def _carried(followed: _Followed, pictures: Stretches | None, key: int) -> Motion | None:
    """The motion at frame `key`, with its trust; None if the recording contradicts it."""
    if abs(key - followed.since) > _OLDEST:
        return None
    motion = carry(followed.motion, key - followed.since)
    if pictures is not None:
        motion = relabelled(pictures, motion)
    if _against(pictures, motion) > _MORE * followed.against + _SHARE:
        return None
    return motion if pictures is None else trusted(pictures, motion)


def _against(pictures: Stretches | None, motion: Motion) -> float:
    """The share of the pixels that contradict a motion."""
    return 0.0 if pictures is None else float(contradicted(pictures, motion).mean())
