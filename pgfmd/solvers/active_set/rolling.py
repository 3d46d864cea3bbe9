"""Slabs begin where every rank gets its share of the contact: heights are periodic, so rows may be rolled.

Work on a contact set is split by rows, and a single mountain, in one rank's slab, would keep the others waiting.
"""

from __future__ import annotations

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.solvers.active_set.active_set import State

BLOCK = 64  # rows that are moved together
TRIALS = 64  # beginnings that are tried
WORTH = 1 / 32  # of a slab's points: work on so many takes as long as to roll its rows, there and back


def best_shift(grid: SlabGrid, other: SlabGrid, pressure: np.ndarray, opened: bool = False, shift: int = 0) -> int:
    """By how many rows to roll fields of `grid`, for a pressure (nx_local, ny) on another grid of the same cell; 0 if
    that gains little.  Collective.

    Work is with the points in contact, or if `opened` with the others; row i of `pressure` is row i + shift there.
    """
    nx = grid.shape[0]
    if grid.comm.size == 1 or nx < 4 * TRIALS:
        return 0
    work = np.roll(np.concatenate(other.comm.allgather(np.count_nonzero(pressure, axis=1))), shift)
    if opened:
        work = other.shape[1] - work
    shifts = np.arange(0, nx, nx // TRIALS)
    before = np.concatenate([[0], np.cumsum(np.tile(work, 2))])  # before each row of two periods
    edges = (shifts[:, None] + np.asarray(grid.starts)) * (len(work) / nx)
    largest = np.diff(np.interp(edges, np.arange(len(before)), before), axis=1).max(axis=1)
    best = int(np.argmin(largest))
    return int(shifts[best]) if largest[0] - largest[best] > WORTH * other.size / grid.comm.size else 0


def rolled(grid: SlabGrid, field: np.ndarray, shift: int) -> np.ndarray:
    """The field (nx_local, ny) whose global row i is row i + shift of that one; itself if that is 0.  Collective."""
    return grid.fetch(field, grid.rows.start + shift, grid.rows.stop + shift) if shift else field


def roll(grid: SlabGrid, field: np.ndarray, shift: int) -> None:
    """The same in place: only rows that cross to another rank need memory.  Collective."""
    shift %= grid.shape[0]
    start, stop, rows = grid.rows.start, grid.rows.stop, len(field)
    if shift == 0:
        return
    if grid.comm.size == 1:
        field[...] = np.roll(field, -shift, axis=0)
        return
    kept, back = rows - shift, shift + rows - grid.shape[0]  # own rows that move up, or, around the cell, down
    bring = grid.begin_fetch(field, max(start + shift, stop), min(stop + shift, start + grid.shape[0]))
    step = min(BLOCK, abs(shift if kept > 0 else back - rows))
    for first in range(0, kept, step):
        last = min(first + step, kept)
        field[first:last] = field[first + shift : last + shift]
    for last in range(back, 0, -step):
        first = max(last - step, 0)
        field[rows - back + first : rows - back + last] = field[first:last]
    bring(field[max(kept, 0) : rows - max(back, 0)])


class RolledBack:
    """A state of rolled rows as monitors may see it: its fields are where they belong.  Reading one is collective."""

    def __init__(self, grid: SlabGrid, state: State):
        self._grid, self._state = grid, state

    def __getattr__(self, name: str):
        value = getattr(self._state, name)
        return rolled(self._grid, value, -self._state.shift) if name in ("pressure", "gap") else value
