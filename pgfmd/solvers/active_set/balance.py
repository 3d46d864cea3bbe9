"""Slabs with as much contact each: a periodic contact is moved along x while a grid is relaxed, and then back.

A patch of the longest wave fills one slab and leaves another empty, and each rank waits for the fullest.  A cell may be
moved by any number of rows; for two ranks one of them halves the contact.
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

LEAST = 1 << 20  # points of a rank from which moving pays
WORTH = 0.05  # points of which the fullest slab is relieved, over the points of a slab, from which moving pays


@contextmanager
def balanced(problem: ContactProblem, state: State) -> Iterator[None]:
    """In the block, heights, pressure and gap (nx_local, ny) are moved in place to where the slabs hold equally much
    contact, if that pays.  Afterwards they are moved back, also after an error that all ranks raise.  Collective.
    """
    grid, shift = problem.grid, 0
    if grid.comm.size > 1 and grid.domain.wraps and grid.size >= LEAST * grid.comm.size:
        shift = best_shift(grid, np.count_nonzero(state.pressure, axis=1))
    if shift == 0:
        yield
        return

    def move(rows: int) -> None:
        state.moved += rows
        move_rows(grid, (problem.heights, state.pressure, state.gap), rows)

    move(shift)
    try:
        yield
    except Exception as error:
        if shared(grid.comm, error):
            move(-shift)
        raise
    move(-shift)


def best_shift(grid: SlabGrid, counts: np.ndarray) -> int:
    """Rows by which the contact is best moved, at most half of those of a slab; 0 if that hardly pays.  counts: of the
    points in contact in each row of this rank.  Collective.
    """
    rows, half = np.empty(grid.shape[0], np.int64), grid.shape[0] // grid.comm.size // 2
    grid.comm.Allgatherv(counts.astype(np.int64), (rows, np.diff(grid.starts)))
    before = np.concatenate([[0], np.cumsum(np.tile(rows, 3))])
    shifts = np.arange(-half, half + 1)
    fullest = np.diff(before[np.add.outer(shifts + len(rows), grid.starts)], axis=1).max(axis=1)
    best = int(np.argmin(fullest))
    return int(shifts[best]) if fullest[half] - fullest[best] > WORTH * grid.size / grid.comm.size else 0


def move_rows(grid: SlabGrid, fields: Sequence[np.ndarray], rows: int) -> None:
    """Row i of the fields (nx_local, ny) becomes row i + `rows` of the cell, in place; `rows`, of either sign, is at
    most what a slab has.  Collective.
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
