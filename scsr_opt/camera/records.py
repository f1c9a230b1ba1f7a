"""Records of a fixed length in bytes that are no spikes: events, structures of C, tables in binary.

Most records hold bits that are always set: a type, a mark of their beginning, the upper bits of a time. Bytes of a
recording that are folded at a length that has nothing to do with its rows and frames have none, as each place then
meets pixels all over the sensor, and few of them fire in every frame. (Bits that are never set do not count: where
stripes pass over a black background, there are lengths at which some places meet black only.)
"""

import math

import numpy as np
from jaxtyping import UInt8

from scsr_opt.camera.settings import CONTENT


def record_length(data: UInt8[np.ndarray, "n"], row_bits: int, frame_bits: int) -> int | None:
    """Length in bytes of the records that bytes consist of; None if there are none, or rows and frames explain them."""
    start = max(0, len(data) - CONTENT.record_sample_bytes) // 2
    sample = np.asarray(data[start : start + CONTENT.record_sample_bytes])
    lengths = range(1, min(CONTENT.longest_record_bytes, len(sample) // CONTENT.least_records) + 1)
    if len(lengths) < 2:
        return None
    found = {length: _always_set(sample, length) for length in lengths}
    best = max(found, key=lambda length: found[length])  # the shortest one of its multiples
    if (
        found[best] < CONTENT.record_set_share
        or np.median(list(found.values())) > CONTENT.other_lengths_set_share * found[best]
    ):
        return None
    bits = np.unpackbits(sample, bitorder="little")
    explained = (_always_set(bits, math.gcd(8 * best, period), 1) for period in (row_bits, frame_bits))
    return None if max(explained) > CONTENT.explained_set_share * found[best] else best


def _always_set(values: UInt8[np.ndarray, "n"], length: int, bits: int = 8) -> float:
    """Fraction of the bits that are set in all pieces of `length` values, each of `bits` bits."""
    pieces = values[: len(values) // length * length].reshape(-1, length)
    return int(np.bitwise_count(np.bitwise_and.reduce(pieces, axis=0)).sum()) / (length * bits)
