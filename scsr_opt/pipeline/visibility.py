"""Intervals that can be used for a part of their exposure, cut to that part.

During an exposure a surface may come into view, be hidden, leave the picture, or stop moving as the motion says; a
sample that is not cut then counts as little as its worst moment. But the stretch of time that can be used
is a recording of its own, and an interval that reaches beyond it is one of its ends (`scsr_opt.camera.samples`): ½θ if
a spike begins or ends it, nothing if none does. Without these, dark surfaces, whose intervals are long, are known by
their brightest moments only.

Short stretches are left out, though ends of every length would have to take part for the mean light to be right: ½θ in
a frame or two is too rough to be of use. A scene that is in view for less than its intervals last came out 2 % too dark
(docs/data-term.md, "Ends within a recording").
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from scsr_opt.camera.samples import Samples
from scsr_opt.motion.trajectory import SPACING, Trajectory
from scsr_opt.pipeline.settings import SamplingSettings


def cut_to_seen(
    samples: Samples,
    path: Trajectory,
    *,
    frames: int,
    white_rate: float,
    ends: float,
    settings: SamplingSettings = SamplingSettings(),
) -> Samples:
    """The samples, in the same order, those cut to the longest stretch that can be used whose weight that increases.

    **Arguments:**
    - `samples`: intervals and ends, weighted by duration (`spike_intervals`).
    - `path`: where in the key frame lies what the pixels see, from frame 0 to the last of `frames`.
    - `white_rate`: spikes per frame of a pixel at intensity 1.
    - `ends`: weight of an end per frame.
    - `settings`: from which share of its weight on a pixel counts as seen, and which intervals are cut.
    """
    if len(path.position) == 1:
        return samples
    every = path.usable
    partly = every.min(0) < settings.visible_least_share * every.max(0)
    # Of several intervals that were merged it is not known in which part the spikes lay.
    duration = samples.stop - samples.start
    single = samples.value * duration < 1.5 / white_rate
    chosen = np.flatnonzero(partly[samples.row, samples.column] & single & (duration >= settings.cut_least_frames))
    if chosen.size == 0:
        return samples
    usable = every.reshape(len(every), -1)[:, partly.reshape(-1)]
    number = np.cumsum(partly).reshape(partly.shape) - 1
    start, stop = (np.asarray(times)[chosen] for times in (samples.start, samples.stop))
    pixel = number[samples.row[chosen], samples.column[chosen]]
    enough = settings.visible_least_share * usable.max(0)[pixel]
    begin, end, least = _longest_stretch(usable, pixel, start, stop, enough, first=float(path.first))
    left, weight = end - begin, (end - begin) * np.float32(ends)
    better = (left >= settings.cut_remaining_frames) & (left < stop - start)
    better &= enough * weight > least * samples.weight[chosen]
    # One of the two at most is where the interval begins or ends; the recording's own ends are no spikes.
    spike = ((begin == start) & (start >= 0)) | ((end == stop) & (stop <= frames - 1))
    value = np.where(spike, np.float32(0.5 / white_rate), 0) / np.maximum(left, settings.cut_remaining_frames)
    fields = tuple(np.array(v) for v in (samples.start, samples.stop, samples.value, samples.weight))
    for field, cut in zip(fields, (begin, end, value, weight), strict=True):
        field[chosen[better]] = cut[better]
    return eqx.tree_at(lambda s: (s.start, s.stop, s.value, s.weight), samples, fields)


def _longest_stretch(
    usable: Float[np.ndarray, "moments pixels"],
    pixel: Int[np.ndarray, " n"],
    start: Float[np.ndarray, " n"],
    stop: Float[np.ndarray, " n"],
    enough: Float[np.ndarray, " n"],
    *,
    first: float,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Begin and end, frames, of the longest stretch of each exposure in which its pixel is usable `enough` (0 and 0 if
    there is none), and the least that it is usable during the exposure. Looked at where the exposure begins and ends,
    and at the trajectory's moments in between, the `first` of them at that frame."""
    last = len(usable) - 1
    begin, end = ((time - np.float32(first)) / SPACING for time in (start, stop))
    before = np.clip(np.floor(begin), 0, last - 1).astype(np.int32)
    after = np.clip(np.ceil(end), 1, last).astype(np.int32)
    at_start, at_stop = (
        usable[k, pixel] + np.clip(at - k, 0, 1).astype(np.float32) * (usable[k + 1, pixel] - usable[k, pixel])
        for k, at in ((before, begin), (after - 1, end))
    )
    order = np.argsort(before - after, kind="stable")  # those with most moments first
    span = (after - before)[order]
    least, since = (np.full(start.size, np.inf, np.float32) for _ in range(2))
    longest = np.zeros((2, start.size), np.float32)
    for k in range(span.max(initial=0) + 1):
        some = order[: np.searchsorted(-span, -k, side="right")]  # those with at least k moments
        moment = before[some] + k
        seen, time = usable[moment, pixel[some]], np.float32(first) + np.float32(SPACING) * moment.astype(np.float32)
        if k == 0:
            seen, time = at_start[some], start[some]
        else:
            over = moment == after[some]
            seen, time = np.where(over, at_stop[some], seen), np.where(over, stop[some], time)
        least[some] = np.minimum(least[some], seen)
        good = seen >= enough[some]
        since[some] = np.where(good, np.minimum(since[some], time), np.inf)
        longer = good & (time - since[some] > longest[1, some] - longest[0, some])
        longest[:, some[longer]] = since[some[longer]], time[longer]
    return longest[0], longest[1], least
