"""The value of a distributed field above which a given number of its points lie."""

from __future__ import annotations

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.statistics.kernels import count_digits
from pgfmd.parallel.mpi import MPI

DIGIT = 16  # bits of t that one pass over the field fixes


def threshold_for_count(grid: SlabGrid, heights: np.ndarray, count: int) -> float:
    """The height t above which exactly `count` points of the distributed field (nx_local, ny) lie: h > t.  Collective.

    t is the largest height that is not among them; if all heights are, t lies just below the lowest.  Where heights are
    equal, no such t may exist; then fewer points lie above.  Radix selection: four passes each fix 16 bits of t by
    counting; nothing is sorted, and no message has the size of the field.  Raises ValueError if 0 ≤ count ≤ N fails.
    """
    if not 0 <= count <= grid.size:
        raise ValueError(f"{count} of {grid.size} points")
    if count == grid.size:
        return float(np.nextafter(grid.reduction.min(heights), -np.inf))
    place = grid.size - count - 1  # of the threshold among the heights in rising order, from 0
    prefix = 0
    bits = heights.view(np.int64)
    for shift in range(64 - DIGIT, -1, -DIGIT):
        below = _count_up_to(grid, bits, prefix, shift)
        digit = int(np.searchsorted(below, place, side="right"))
        place -= int(below[digit - 1]) if digit else 0
        del below  # half a megabyte, before the next is made
        prefix = prefix << DIGIT | digit
    found = prefix ^ (1 << 63) if prefix >> 63 else ~prefix & (1 << 64) - 1
    return float(np.array(found, np.uint64).view(np.float64))


def _count_up_to(grid: SlabGrid, bits: np.ndarray, prefix: int, shift: int) -> np.ndarray:
    """Number of heights whose keys (`count_digits`) begin with the digits `prefix` and go on with at most each next
    digit: (2^16,) int64.  Collective.
    """
    parts = []

    def part(first: int, stop: int) -> None:
        counts = np.zeros(1 << DIGIT, np.int64)
        count_digits(bits, np.uint64(prefix), shift, first, stop, counts)
        parts.append(counts)

    grid.threads.split(part, len(bits))
    total = parts.pop()  # every rank of a grid has rows
    while parts:
        total += parts.pop()
    grid.comm.Allreduce(MPI.IN_PLACE, total)
    return np.cumsum(total, out=total)
