"""Slabs begin where every rank gets its share of the contact: heights are periodic, so rows may be rolled.

Work on a contact set is split by rows, and a single mountain, in one rank's slab, would keep the others waiting.
"""

from __future__ import annotations

import numpy as np

from ..grid import SlabGrid
from .hard_wall import State

TRIALS = 64  # beginnings that are tried
WORTH = 1.2  # largest share of a rank over what it could be, above which rows are rolled


def best_shift(grid: SlabGrid, pressure: np.ndarray) -> int:
    """By how many rows to roll, for the pressure (nx_local, ny) of a start; 0 if that gains little.  Collective."""
    nx = grid.shape[0]
    if grid.comm.size == 1 or nx < 4 * TRIALS:
        return 0
    counts = np.concatenate(grid.comm.allgather(np.count_nonzero(pressure, axis=1)))
    shifts = np.arange(0, nx, nx // TRIALS)
    before = np.concatenate([[0], np.cumsum(np.tile(counts, 2))])  # points before each row of two periods
    largest = np.diff(before[shifts[:, None] + np.asarray(grid.starts)], axis=1).max(axis=1)
    best = int(np.argmin(largest))
    return int(shifts[best]) if largest[0] > WORTH * largest[best] else 0


def roll(grid: SlabGrid, field: np.ndarray, shift: int) -> None:
    """Overwrite a field (nx_local, ny) so that global row i becomes what row i + shift was.  Collective."""
    if shift:
        field[...] = grid.fetch(field, grid.rows.start + shift, grid.rows.stop + shift)


class RolledBack:
    """A state of rolled rows as monitors may see it: its fields are where they belong.  Reading one is collective."""

    def __init__(self, grid: SlabGrid, state: State, shift: int):
        self._grid, self._state, self._shift = grid, state, shift

    def __getattr__(self, name: str):
        value = getattr(self._state, name)
        if name not in ("pressure", "gap") or not self._shift:
            return value
        first, stop = self._grid.rows.start - self._shift, self._grid.rows.stop - self._shift
        return self._grid.fetch(value, first, stop)
