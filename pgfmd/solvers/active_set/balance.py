"""Load balance: a periodic contact is shifted along x so that the slabs hold about equally many unknowns; it is shifted
back when the grid has been relaxed.

A patch of the longest wave fills one slab and leaves another empty, and each rank waits for the fullest.  Any shift is
an equivalent problem.  Shifts of up to half a slab are tried; for two ranks one of these puts half of the unknowns on
each.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.collectives import shared
from pgfmd.parallel.layout import RowPlan
from pgfmd.physics.problem import ContactProblem
from pgfmd.solvers.active_set.active_set import State

LEAST_POINTS = 1 << 20  # per rank, below which nothing is shifted
LEAST_GAIN = 0.05  # decrease of the largest number of unknowns in a slab, over the points of a slab


@contextmanager
def balanced(problem: ContactProblem, state: State, gaps: bool = False) -> Iterator[None]:
    """In the block, heights, pressure and gap (nx_local, ny) are shifted in place, if that pays and the heights may be
    written.  Afterwards they are shifted back, also after an error for which `shared` is true.  After any other error
    the heights are lost: they are set to NaN.  Collective.

    gaps: whether the unknowns are the points that are not in contact.
    """
    grid, shift = problem.grid, 0
    if grid.comm.size > 1 and grid.domain.wraps and grid.size >= LEAST_POINTS * grid.comm.size:
        counts = np.count_nonzero(state.pressure, axis=1)
        if grid.reduction.min(problem.heights.flags.writeable):
            shift = best_shift(grid, grid.shape[1] - counts if gaps else counts)
    if shift == 0:
        yield
        return

    def move(rows: int) -> None:
        state.shift += rows
        move_rows(grid, (problem.heights, state.pressure, state.gap), rows)

    move(shift)
    try:
        yield
    except BaseException as error:
        if isinstance(error, Exception) and shared(grid.comm, error):
            move(-shift)
        else:
            problem.heights.fill(np.nan)
        raise
    move(-shift)


def best_shift(grid: SlabGrid, counts: np.ndarray) -> int:
    """Rows by which the contact is best shifted, at most half of those of a slab; 0 if the gain is below `LEAST_GAIN`.
    counts: number of unknowns in each row of this rank.  Collective.
    """
    rows, half = np.empty(grid.shape[0], np.int64), grid.shape[0] // grid.comm.size // 2
    grid.comm.Allgatherv(counts.astype(np.int64), (rows, np.diff(grid.starts)))
    before = np.concatenate([[0], np.cumsum(np.tile(rows, 3))])
    shifts = np.arange(-half, half + 1)
    fullest = np.diff(before[np.add.outer(shifts + len(rows), grid.starts)], axis=1).max(axis=1)
    best = np.lexsort((np.abs(shifts), fullest))[0]
    return int(shifts[best]) if fullest[half] - fullest[best] > LEAST_GAIN * grid.size / grid.comm.size else 0


def move_rows(grid: SlabGrid, fields: Sequence[np.ndarray], rows: int) -> None:
    """After the call, row i of the fields (nx_local, ny) holds what row i + `rows` of the cell (periodic) held.  rows:
    of either sign, not 0, at most as many as the smallest slab has.  Collective.
    """
    start, stop, count = grid.rows.start, grid.rows.stop, abs(rows)
    plan = RowPlan(grid.layout, [(stop, stop + rows) if rows > 0 else (start + rows, start)])
    for field in fields:
        part = plan.fetch(field, np.empty((count, field.shape[1]), field.dtype))
        turned, part = (field, part) if rows > 0 else (field[::-1], part[::-1])
        stay = len(field) - count
        for first in range(0, stay, count):  # blocks that do not overlap: else NumPy copies the whole field first
            stop = min(first + count, stay)
            turned[first:stop] = turned[first + count : stop + count]
        turned[stay:] = part
