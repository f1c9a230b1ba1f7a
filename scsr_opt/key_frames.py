"""Pictures of several moments of one recording, each starting from what is known of the one before.

From one key frame to the next little changes: what moves goes on moving, what rests has been solved for. So the motion
of the last picture is carried on along its own trajectories; only which of its layers is seen where is looked at anew.
It is estimated anew where the recording contradicts it more than it did, or after a while; the strength is validated
then, and the gains are found, and both are carried on with it. The picture and the prior's dual variables are moved
along, and the solve goes on from there; from playback where hardly anything was seen.
"""

from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from typing import Any, NamedTuple, SupportsIndex, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from scsr_opt.arrays import own
from scsr_opt.camera.recording import Recording
from scsr_opt.device import check_device
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
from scsr_opt.operators.sampling import PlacedSamples
from scsr_opt.placing import stream_around
from scsr_opt.preparation import FRAMES, Prepared, prepare
from scsr_opt.progress import check_progress
from scsr_opt.reconstruction import solve
from scsr_opt.solvers.solution import Solution

# A motion is carried on for so many frames at most: as long as some of those it was estimated from are used. On a
# recording of a car passing, moving pixels that were held out were predicted as well as by a motion estimated anew
# after 5, 20, 40, 60, 80 and 100 frames (docs/measurements.md).
_OLDEST = 100
# And as long as no more pixels contradict it than did when it was estimated, times this, and this share of all: on that
# recording 6, 8, 16, 19, 21, 23 and 25 % did after 0, 5, 20, 40, 60, 75 and 95 frames, 4.1 times as many at last; a
# turning disc lost 0.3 dB up to 1.6 times, and 0.5 at 4.5.
_MORE, _SHARE = 4.2, 0.005
# Going on from the picture before, a residual of so many tolerances is met nearer to the minimum than one from scratch:
# 2 instead of 1.5 added up to 0.002 % to what pictures of a car are above it, 3 up to 0.006 % (docs/measurements.md).
_NEARER = 2.0
# Where less than this share of the usual weight saw the scene, a picture begins at playback: what has come into view
# was not in the one before, whose border would be there instead, and go slowly, as only the prior decides.
_SEEN = 0.1
# After the last of the items.
_END: Any = object()
Item = TypeVar("Item")


def sequence(
    spikes: ArrayLike | Recording, keys: Iterable[SupportsIndex], *, scale: SupportsIndex, **options: Any
) -> Generator[Solution, None, None]:
    """The pictures X of the moments `keys`, one after the other: Eq. 4 of the paper for each (`reconstruct`).

    Made as they are asked for, and the faster the less happens between them. While a picture is solved for, or used,
    the next one is measured, and the motion of the one after that is carried on.

    **Arguments:**
    - `spikes`, `scale`, `options`: as of `reconstruct`; without `key` and `state`, and `velocity` None or an
      `Estimator`. A picture whose motion is carried on is solved for to twice the solver's tolerance, from nearer.
    - `keys`: frames, best in order and a few frames apart.

    What is handed in may be overwritten as soon as this returns, and what is handed out at any time.

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
    check_device()
    check_progress(options.get("progress"))
    # Its own of all that the caller may overwrite between two pictures.
    recording = replace(recording)
    options = {name: own(value, name) if _may_change(value) else value for name, value in options.items()}
    return _pictures(recording, tuple(keys), whole(scale, "scale", 1), estimator, options)


def _may_change(value: Any) -> bool:
    """Whether it is an array, or anything that one can be made of, which somebody may write to."""
    return isinstance(value, list | tuple) or (hasattr(value, "__array__") and not isinstance(value, np.generic))


class _Followed(NamedTuple):
    """The `motion` that was estimated last, at frame `since`, the share of the pixels that contradicted it then,
    `against`, and the `strength` that was found with it, None where it was not looked for; the pixels' `gain`, None
    for 1."""

    motion: Motion
    since: int
    against: float
    strength: float | None
    gain: Float[np.ndarray, "h w"] | None


class _Moment(NamedTuple):
    """What is known of frame `key`: its motion, if it was `carried` on, and where from."""

    key: int
    pictures: Stretches | None
    carried: Motion | None
    followed: _Followed


def _pictures(
    recording: Recording,
    keys: tuple[SupportsIndex, ...],
    scale: int,
    estimator: Estimator | None,
    options: dict[str, Any],
) -> Generator[Solution, None, None]:
    around = {name: options.get(name) for name in ("white_rate", "bad_pixels")}
    gain = options.get("gain")
    gains = None if gain is None or isinstance(gain, str) else pixel_gain(gain, recording.height, recording.width)

    def moments(
        wanted: Iterable[SupportsIndex], followed: _Followed | None
    ) -> Generator[tuple[_Moment, Prepared | None], None, None]:
        """The motion of each; where it is not carried on, all that is prepared."""
        for key in wanted:
            moment, stream = stream_around(recording, key=key, frames=options.get("frames", FRAMES), **around)
            pictures = comparable(
                stream.spikes, key=stream.key, white_rate=stream.white_rate, bad_pixels=stream.bad_pixels, gain=gains
            )
            motion = None if followed is None else _carried(followed, pictures, moment)
            prepared = None
            if followed is None or motion is None:
                prepared = prepare(recording, scale=scale, key=moment, **options, velocity=estimator)
                λ = float(prepared.rounds.strength) if prepared.asked.validates else None
                followed = _Followed(prepared.motion, moment, _against(pictures, prepared.motion), λ, prepared.gains)
            yield _Moment(moment, pictures, motion, followed), prepared

    def ready(
        known: Generator[tuple[_Moment, Prepared | None], None, None],
    ) -> Generator[tuple[_Moment, Prepared], None, None]:
        """The measurements of each."""
        with closing(known):
            for now, prepared in known:
                if prepared is None:
                    given = {**options, "gain": now.followed.gain}
                    if now.followed.strength is not None:
                        given["strength"] = now.followed.strength
                    prepared = prepare(recording, scale=scale, key=now.key, **given, velocity=now.carried)
                    solver = prepared.rounds.solver
                    solver = replace(solver, tolerance=_NEARER * solver.tolerance)
                    prepared = replace(prepared, rounds=replace(prepared.rounds, solver=solver))
                yield now, prepared

    done, followed, before = 0, None, None
    while done < len(keys):
        with closing(_ahead(ready(_ahead(moments(keys[done:], followed))))) as steps:
            for now, prepared in steps:
                solution = solve(prepared, _start(now, prepared, before))
                solution.stats["carried"] = now.carried is not None
                followed = now.followed
                if not solution.result.good or solution.motion is None:
                    followed = None
                elif now.carried is None and solution.motion is not prepared.motion:
                    λ = None if followed.strength is None else solution.stats["strength"]
                    followed = _Followed(
                        solution.motion, now.key, _against(now.pictures, solution.motion), λ, solution.gain
                    )
                before = None if followed is None else (now.key, solution)
                done += 1
                yield solution.handed_out()
                if followed is not now.followed:
                    break  # what was begun is not what is wanted


def _ahead(items: Generator[Item, None, None]) -> Generator[Item, None, None]:
    """The items, each made in a thread while the one before it is used."""
    with closing(items), ThreadPoolExecutor(1) as beside:
        task = beside.submit(next, items, _END)
        while (item := task.result()) is not _END:
            task = beside.submit(next, items, _END)
            yield item


def _start(now: _Moment, prepared: Prepared, before: tuple[int, Solution] | None) -> Any:
    """The state of the last solve, moved along to this picture, with playback where hardly anything of it was seen;
    None where the motion is new."""
    if before is None or now.carried is None:
        return None
    key, solution = before
    assert solution.motion is not None  # or there were nothing to carry on
    kept = prepared.rounds.solver.kept(solution.state)
    moved = moved_along(solution.motion, now.key - key, prepared.asked.scale, kept)
    if moved is kept:
        return kept
    there = prepared.rounds.solver.image(moved)
    begun = _where_seen(prepared.taken.placed, there, prepared.image)
    return jax.tree.map(lambda leaf: begun if leaf is there else leaf, moved)


@eqx.filter_jit
def _where_seen(
    placed: PlacedSamples, picture: Float[Array, "H W"], elsewhere: Float[Array, "H W"]
) -> Float[Array, "H W"]:
    """`picture`, and where hardly any of the samples are, the picture `elsewhere`."""
    seen, s = placed.seen(), placed.scale
    hardly = seen < _SEEN * jnp.mean(seen)
    return jnp.where(jnp.repeat(jnp.repeat(hardly, s, axis=1), s, axis=0), elsewhere, picture)


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
