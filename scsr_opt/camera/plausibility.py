"""Statistics of how far bits look like spikes, for what a file does not say: its axis of time, its size.

A pixel of a spike camera gathers light until a threshold is reached, so soon after a spike it does not fire again (or,
where it fires in more than half of the frames, two gaps do not follow each other): along time, spikes in frames next to
each other are rarer than chance has it. Nothing of the kind holds along rows and columns, whose pixels started at
random. And pixels above each other see nearly the same light as pixels beside each other do.

For the first, coincidences are counted (`regularity`): lines of bits along an axis are cut into pieces, and the pairs
of neighbours that are both set are compared with the number expected from how many bits of each piece are set. The
ratio is 0 to 0.3 along time in real recordings and 1 to 1.2 along any other axis, for bits of another kind, and for
frames of another size. For the second, `row_agreement` compares pixels a row apart.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from scsr_opt.camera.settings import CONTENT


class Regularity(NamedTuple):
    """Coincidences of neighbours, as a fraction of those that chance would make, and the number of these."""

    ratio: float
    expected: float

    @property
    def certain(self) -> bool:
        """True where there is enough to count."""
        return self.expected >= CONTENT.least_coincidences

    @property
    def regular(self) -> bool:
        """True for trains of an integrator."""
        return self.certain and self.ratio < CONTENT.regular_below_ratio

    @property
    def irregular(self) -> bool:
        """True for lines that are no trains of an integrator. Where there is little to count neither is said."""
        return self.certain and self.ratio > CONTENT.irregular_above_ratio


UNKNOWN = Regularity(1.0, 0.0)


def regularity(blocks: Iterable[Bool[np.ndarray, "n _"]]) -> Regularity:
    """Regularity of blocks of lines of n bits: the lowest that pieces of several lengths give, if there are enough."""
    found = regularities(blocks)
    certain = [each for each in found if each.certain]
    return min(certain) if certain else max(found, key=lambda each: each.expected)


def regularities(blocks: Iterable[Bool[np.ndarray, "n _"]]) -> list[Regularity]:
    """Regularity of blocks of lines of n bits, by pieces of each of `CONTENT.piece_frames`."""
    sums = np.zeros((len(CONTENT.piece_frames), 2))
    for lines in blocks:
        sums += [_of_pieces(lines, length) for length in CONTENT.piece_frames]
    return [Regularity(float(seen / expected), float(expected)) if expected else UNKNOWN for seen, expected in sums]


def unsaturated(lines: Bool[np.ndarray, "n m"]) -> Bool[np.ndarray, "k l"]:
    """Pieces of the lines in which no bits are set in as many frames one after another as only saturation sets them."""
    length = min(len(lines), max(CONTENT.piece_frames))
    pieces = lines[: len(lines) // length * length].reshape(-1, length, lines.shape[1])
    pieces = np.moveaxis(pieces, 1, 0).reshape(length, -1)
    runs = pieces
    for _ in range(min(CONTENT.saturated_frames, length) - 1):
        runs = runs[1:] & pieces[: len(runs) - 1]
    return pieces[:, ~runs.any(axis=0)]


def axis_regularity(stored: Any) -> tuple[Regularity, Regularity, Regularity]:
    """Regularity along each of the three axes of an array or dataset of 0 and 1, from a block in its middle."""
    middle = [
        slice((length - size) // 2, (length - size) // 2 + size)
        for length, size in ((n, min(n, most)) for n, most in zip(stored.shape, CONTENT.axis_block, strict=True))
    ]
    block = np.asarray(stored[tuple(middle)]) != 0
    along = [regularity([np.moveaxis(block, axis, 0).reshape(block.shape[axis], -1)]) for axis in range(3)]
    # Nothing to be counted along an axis says nothing where it is short, or it is not the dark that spaces spikes out.
    bright = bool(block.mean() > CONTENT.dark_below_rate)
    along = [
        Regularity(each.ratio, math.nan)
        if not each.certain and (bright or block.shape[axis] < CONTENT.piece_frames[0])
        else each
        for axis, each in enumerate(along)
    ]
    return (along[0], along[1], along[2])


def contradiction(found: tuple[Regularity, ...], axis: int) -> int | None:
    """Axis that is time by its content, if `axis` clearly is not; else None."""
    others = [other for other in range(3) if other != axis and (found[other].regular or _apart(found, other))]
    return others[0] if found[axis].irregular and len(others) == 1 else None


def _apart(found: tuple[Regularity, ...], axis: int) -> bool:
    """Test of an axis along which alone spikes are too far apart to be counted, as they are along time in the dark."""
    others = [found[other] for other in range(3) if other != axis]
    return not found[axis].certain and all(
        each.certain
        and CONTENT.regular_below_ratio <= each.ratio < CONTENT.bunched_from_ratio
        and found[axis].expected < CONTENT.apart_below_ratio * each.expected
        for each in others
    )


def row_agreement(rates: Shaped[np.ndarray, "n"], widths: Iterable[int]) -> dict[int, tuple[float, float, float]]:
    """Correlation of pixels one, two and three rows apart, for each of some widths.

    **Arguments:**
    - `rates`: spikes of the pixels of a frame or a part of it, row after row, whatever their width is.
    - `widths`: each at most a quarter of them; the others are left out.
    """
    values = _fine(rates)
    energy = float((values * values).sum())

    def correlation(lag: int) -> float:
        return float((values[lag:] * values[:-lag]).sum()) / energy if energy else 0.0

    return {
        width: (correlation(width), correlation(2 * width), correlation(3 * width))
        for width in widths
        if 4 * width <= len(values)
    }


def narrower_width(rates: Shaped[np.ndarray, "n"], width: int, others: Iterable[int]) -> int | None:
    """The one of some `others` of which each row of `width` pixels holds several rows, beside each other.

    They correlate less and less the further apart they are, and those in one row of `width` as much as the last of it
    and the first of the next. (A picture that repeats along its rows has parts of one row that correlate more.)

    **Arguments:** `rates`: spikes of the pixels of some whole rows of `width`.
    """
    values = _fine(rates)
    values = values[: len(values) // width * width]
    variance = float((values * values).mean()) if len(values) else 0.0
    least = max(CONTENT.least_correlation, CONTENT.least_correlation_deviations / max(len(values), 1) ** 0.5)
    for other in sorted(others, reverse=True):
        if width % other or other == width or 8 * width > len(values) or not variance:
            continue
        one, two, three, four = (
            float((values[lag:] * values[:-lag]).mean()) / variance for lag in other * np.arange(1, 5)
        )
        products = np.append(values[other:] * values[:-other], np.zeros(other)).reshape(-1, width // other, other)
        apart = products[:-1].mean(axis=(0, 2)) / variance
        if (
            one >= least
            and min(one - two, two - three, three - four) > CONTENT.least_correlation_drop
            and two >= one / 2
        ):
            if np.ptp(apart) < (one - two) / 2:
                return other
    return None


def bits_reversed(rates: Shaped[np.ndarray, "n"]) -> bool:
    """Test of pixels that are stored with the first of eight in the highest bit: within a byte neighbours agree, across
    bytes the last and the first of eight do not, but those that the other order puts there do.

    **Arguments:** `rates`: spikes of the pixels in the order of the file, beginning on a whole byte.
    """
    values = _fine(rates[: len(rates) // 8 * 8]).reshape(-1, 8)
    if len(values) < 2:
        return False
    variance = float((values * values).mean())
    inside = float((values[:, 1:] * values[:, :-1]).mean())
    across, crossed = float((values[1:, 0] * values[:-1, 7]).mean()), float((values[1:, 7] * values[:-1, 0]).mean())
    least = max(CONTENT.least_correlation, CONTENT.least_correlation_deviations / values.size**0.5) * variance
    return (
        inside > least
        and across < CONTENT.across_bytes_below_share * inside
        and crossed - across > CONTENT.crossed_bytes_over_share * inside
    )


def _fine(rates: Shaped[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Rates without their mean over some pixels of a row."""
    values = rates.astype(float)
    half = CONTENT.row_smoothing_px // 2
    sums = np.cumsum(np.pad(values, (half + 1, half), mode="edge"))
    return values - (sums[CONTENT.row_smoothing_px :] - sums[: -CONTENT.row_smoothing_px]) / CONTENT.row_smoothing_px


def better_width(rates: Shaped[np.ndarray, "n"], width: int, others: Iterable[int]) -> int | None:
    """The one of some `others` whose rows agree, if those of `width` do not; None in all other cases."""
    agreement = row_agreement(rates, {width, *others})
    if width not in agreement:
        return None
    least = max(CONTENT.least_correlation, CONTENT.least_correlation_deviations / len(rates) ** 0.5)
    best = max(agreement, key=lambda each: min(agreement[each]))
    one, two, three = agreement[best]
    # Further apart, rows agree less and less, and not all of a sudden.
    if one < least or min(two, three) < one / 2:
        return None
    # Rows that lie a quarter of the period of a regular grating apart do not correlate, but those two apart then do.
    next_one, next_but_one, _ = agreement[width]
    return (
        best
        if abs(next_one) < CONTENT.disagreeing_correlation_share * one
        and next_but_one > -CONTENT.disagreeing_correlation_share * one
        else None
    )


def _of_pieces(lines: Bool[np.ndarray, "n m"], length: int) -> tuple[float, float]:
    """Coincidences in m lines of n bits cut into pieces of `length`, and how many chance would make.

    The even and the odd entries of a piece are counted apart, so that lines which take turns at two pixels of different
    brightness, as those of frames of half the right size do, are not taken for regular.
    """
    length = min(length, len(lines)) // 2 * 2
    if length < 4 or lines.shape[1] == 0:
        return 0.0, 0.0
    pieces = len(lines) // length
    bits = lines[: pieces * length].reshape(pieces, length, -1)
    # Where a line fires in most frames its gaps are what is regular.
    bits = bits ^ (_counts(bits) > length // 2)[:, None]
    even, odd, half = bits[:, ::2], bits[:, 1::2], length // 2
    # Pairs (0, 1), (2, 3), …, and (1, 2), (3, 4), …, one fewer of these.
    seen = np.count_nonzero(even & odd) + np.count_nonzero(odd[:, :-1] & even[:, 1:])
    expected = float((_counts(even).astype(np.int64) * _counts(odd)).sum()) * (length - 1) / half**2
    return float(seen), expected


def _counts(bits: Bool[np.ndarray, "k n m"]) -> UInt8[np.ndarray, "k m"]:
    """Set bits along the second axis, of at most 255."""
    return bits.view(np.uint8).sum(axis=1, dtype=np.uint8)
