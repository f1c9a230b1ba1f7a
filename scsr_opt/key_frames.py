"""Pictures of several moments of one recording, each starting from what is known of the one before.

From one key frame to the next little changes: what moves goes on moving, what rests has been solved for. So the motion
of the last picture is carried on along its own trajectories; only which of its layers is seen where is looked at anew.
It is estimated anew where the recording contradicts it more than it did, or after a while. The picture and the prior's
dual variables are moved along, and the solve goes on from there. (λ is validated for each: that of a picture ten frames
before lost up to 0.2 dB.)
"""

from collections.abc import Iterable, Iterator
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
from scsr_opt.reconstruction import FRAMES, reconstruct
from scsr_opt.solvers.solution import Solution

# A motion is carried on for so many frames at most. On a recording of a car passing pixels that were held out were
# predicted as well as by a motion estimated anew after 5, 20 and 40 frames (0.1219, 0.1206, 0.1202 for 0.1222, 0.1202,
# 0.1200).
_OLDEST = 40
# And as long as no more pixels contradict it than did when it was estimated, times this, and this share of all: on that
# recording 14, 15 and 19 % did after 0, 5 and 20 frames.
_MORE, _SHARE = 1.5, 0.005


def sequence(
    spikes: ArrayLike | Recording, keys: Iterable[SupportsIndex], *, scale: SupportsIndex, **options: Any
) -> Iterator[Solution]:
    """The pictures X of the moments `keys`, one after the other: Eq. 4 of the paper for each (`reconstruct`).

    Made as they are asked for, and the faster the less happens between them.

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


class _Known(NamedTuple):
    """From the pictures before: the last `solution`, at frame `key`; the `motion` that was estimated last, at frame
    `since`, and the share of the pixels that contradicted it then, `against`."""

    solution: Solution
    key: int
    motion: Motion
    since: int
    against: float


def _pictures(
    recording: Recording,
    keys: Iterable[SupportsIndex],
    scale: int,
    estimator: Estimator | None,
    options: dict[str, Any],
) -> Iterator[Solution]:
    known: _Known | None = None
    around = {name: options.get(name) for name in ("white_rate", "bad_pixels")}
    gain = options.get("gain")
    gains = None if gain is None or isinstance(gain, str) else pixel_gain(gain, recording.height, recording.width)
    for key in keys:
        moment, stream = stream_around(recording, key=key, frames=options.get("frames", FRAMES), **around)
        pictures = comparable(
            stream.spikes, key=stream.key, white_rate=stream.white_rate, bad_pixels=stream.bad_pixels, gain=gains
        )
        motion = None if known is None else _carried(known, pictures, moment)
        given = dict(options, velocity=estimator if motion is None else motion)
        if known is not None and motion is not None:
            before = carry(known.motion, known.key - known.since)
            given["state"] = moved_along(before, moment - known.key, scale, known.solution.state)
        solution = reconstruct(recording, scale=scale, key=moment, **given)
        solution.stats["carried"] = motion is not None
        yield solution
        if not solution.result.good or solution.motion is None:
            known = None
        elif known is not None and motion is not None:
            known = known._replace(solution=solution, key=moment)
        else:
            known = _Known(solution, moment, solution.motion, moment, _against(pictures, solution.motion))


def _carried(known: _Known, pictures: Stretches | None, key: int) -> Motion | None:
    """The motion at frame `key`, with its trust; None if the recording contradicts it."""
    if abs(key - known.since) > _OLDEST:
        return None
    motion = carry(known.motion, key - known.since)
    if pictures is not None:
        motion = relabelled(pictures, motion)
    if _against(pictures, motion) > _MORE * known.against + _SHARE:
        return None
    return motion if pictures is None else trusted(pictures, motion)


def _against(pictures: Stretches | None, motion: Motion) -> float:
    """The share of the pixels that contradict a motion."""
    return 0.0 if pictures is None else float(contradicted(pictures, motion).mean())
