"""Arrays whose rows start on cache lines, and on different cache sets."""

from __future__ import annotations

import itertools
import math
from typing import TypeVar

import numpy as np
from numpy.typing import DTypeLike

ALIGNMENT = 64  # bytes: a cache line and the widest vector register
PAGE = 4096  # bytes
STAGGER = 11 * ALIGNMENT  # bytes by which a field begins later in a page than the one before
Count = TypeVar("Count", int, np.ndarray)
_made = itertools.count()


def aligned_bytes(count: int, begin: int = 0, unit: int = ALIGNMENT) -> np.ndarray:
    """`count` bytes of new memory, `begin` bytes after a cache line, or another unit, begins."""
    raw = np.empty(count + unit, np.uint8)
    return raw[(begin - raw.ctypes.data) % unit :][:count]


def new_field(shape: tuple[int, int], dtype: DTypeLike = np.float64, widens: bool = True) -> np.ndarray:
    """A new array of float64, or of float32 and, if it `widens`, in the second half of as much memory (`widened`),
    which begins at another place of a page than those made before.

    Large arrays lie as far apart as they are long, and a page.  At 4096² that is 2²⁷ + 2¹² bytes: the first cache of
    AMD's Zen then seems to take entries at like places of two arrays for the same (Lipp et al. 2020,
    doi:10.1145/3320269.3384746, section 3), and a loop over pressure and gap takes seven times as long.
    """
    begin, size = next(_made) * STAGGER % PAGE, math.prod(shape)
    itemsize = 8 if widens else np.dtype(dtype).itemsize
    return aligned_bytes(size * itemsize, begin, PAGE).view(dtype)[-size:].reshape(shape)


def widened(field: np.ndarray, change: np.ufunc, number: float, rows: int) -> np.ndarray:
    """change(field, number) in double precision, for a field of single precision from `new_field`, in its memory: the
    field is lost.  rows: so many are changed at a time, in their order, since the result catches up with the field.
    """
    memory, before = field.base, field.ctypes.data - field.nbytes
    assert memory is not None
    out = np.ndarray(field.shape, np.float64, memory, before - memory.ctypes.data)
    for first in range(0, len(field), rows):
        part = slice(first, first + rows)
        change(field[part], number, out=out[part], dtype=np.float64)
    return out


def row_stride(count: Count, itemsize: int) -> Count:
    """Items from one row of `count` items to the next: padded to an odd number of cache lines.

    Rows then start on cache lines, and rows a power of two apart do not fall on the same cache sets.
    """
    lines = -(-count * itemsize // ALIGNMENT) | 1
    return lines * ALIGNMENT // itemsize


def aligned(shape: tuple[int, int], dtype: DTypeLike, pad: bool = True) -> np.ndarray:
    """A new array of that shape whose rows start on cache lines.

    pad: rows are padded, so that they start on different cache sets.  Without it, rows that fill whole cache lines are
    not padded: compiled loops are faster on a contiguous array.
    """
    itemsize = np.dtype(dtype).itemsize
    whole = shape[1] * itemsize % ALIGNMENT == 0
    stride = shape[1] if whole and not pad else row_stride(shape[1], itemsize)
    return aligned_bytes(shape[0] * stride * itemsize).view(dtype).reshape(shape[0], stride)[:, : shape[1]]


def with_padding(array: np.ndarray) -> np.ndarray:
    """An `aligned` array together with its padding: contiguous, so that compiled loops know its strides."""
    return np.lib.stride_tricks.as_strided(array, (len(array), array.strides[0] // array.itemsize))
