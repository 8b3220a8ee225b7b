"""How a page holds a series at its full rate: rounded to what its noise hides, differenced, squeezed, as text.

A series x (n,) becomes whole numbers, 0 where x is not finite, else 1 + round((x - low) / step). Of their first or
second differences, whichever is smaller (32 bits, they wrap), the sign goes to the lowest bit (zigzag); the bytes of
all numbers, the lowest first, lie one plane after the other; the planes are compressed by zlib and written in base64.
Smooth series take a fraction of a bit per sample, noise about four.
"""

import zlib
from base64 import b64encode
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.records import Vector

STEPS_PER_SIGMA: Final = 2.0
"""A rounding error of 0.14 standard deviations: it makes the noise 1 % larger."""
_LARGEST_CODE: Final = 2**30
_THIRD_DIFFERENCE: Final = 20.0**0.5
"""Standard deviation of the third difference of white noise, over its own."""
_NORMAL: Final = 1.4826
"""Standard deviation of normal noise over its median absolute value."""


class Packed(NamedTuple):
    """A series as text: `low` and `step` in its unit, how often it was differenced, bytes per number."""

    low: float
    step: float
    order: int
    planes: int
    text: str


def noise_of(values: Vector, is_next: NDArray[np.bool_] | None = None) -> float:
    """Estimate the standard deviation of a series' white noise by its third differences, which motion hardly has.

    is_next (n,): samples that follow the one before at once; None: all do.
    """
    is_finite = np.isfinite(values)
    differences = np.diff(values[is_finite], 3)
    if is_next is not None:
        follows = is_next[is_finite]
        differences = differences[follows[3:] & follows[2:-1] & follows[1:-2]]
    return float(_NORMAL * np.median(np.abs(differences)) / _THIRD_DIFFERENCE) if differences.size else 0.0


def step_of(values: Vector, finest: float, is_next: NDArray[np.bool_] | None = None) -> float:
    """Choose a step: half the noise's standard deviation, see `noise_of`, but no finer than what anybody reads."""
    return max(finest, noise_of(values, is_next) / STEPS_PER_SIGMA)


def pack(values: Vector, step: float) -> Packed:
    """Pack a series (n,) in steps of `step`, or coarser where its range asks for more than 2^30 of them."""
    is_finite = np.isfinite(values)
    finite = values[is_finite]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    step = max(step, (high - low) / _LARGEST_CODE)
    codes = np.zeros(values.size, np.int32)
    codes[is_finite] = 1 + np.rint((finite - low) / step).astype(np.int32)
    candidates = [_zigzag(np.diff(codes, order, prepend=np.zeros(order, np.int32))) for order in (1, 2)]
    order = int(np.argmin([candidate.sum(dtype=np.float64) for candidate in candidates]))
    numbers = candidates[order]
    count = max(1, -(-int(numbers.max(initial=0)).bit_length() // 8))
    planes = numbers.astype("<u4").view(np.uint8).reshape(-1, 4).T[:count]
    squeezer = zlib.compressobj(6, zlib.DEFLATED, 15, 9, zlib.Z_RLE)  # noise repeats nothing but zeros
    squeezed = squeezer.compress(planes.tobytes()) + squeezer.flush()
    return Packed(low, step, order + 1, count, b64encode(squeezed).decode("ascii"))


def _zigzag(numbers: NDArray[np.int32]) -> NDArray[np.uint32]:
    return ((numbers << 1) ^ (numbers >> 31)).view(np.uint32)
