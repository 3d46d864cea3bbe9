"""Rows of a distributed field together with some of its neighbours' rows, fetched again and again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import MPI, datatype


class RowWindow:
    """Rows low … high−1 (global, periodic) of a field on `grid`; the range is extended to hold this rank's whole slab.
    The caller writes the rows of its slab; `exchange` fetches the others.  Collective to make.

    Attributes: low, first row of the extended range; rows (its length, ny); own: the slab's part, a view of `rows`.
    """

    def __init__(self, grid: SlabGrid, low: int, high: int, dtype: DTypeLike = np.float32) -> None:
        comm = grid.comm
        first, stop = grid.rows.start, grid.rows.stop
        self.comm, self._datatype = comm, datatype(dtype)
        self.low, high = min(low, first), max(high, stop)
        self.rows = np.zeros((high - self.low, grid.shape[1]), dtype)
        self.own = self.rows[first - self.low : stop - self.low]
        # The rows that each rank lacks, as pieces (owner, rows local to the owner, place in `rows`).
        wanted = comm.allgather([(self.low, first), (stop, high)])
        self._sends = [
            (target, rows)
            for target, ranges in enumerate(wanted)
            for piece in ranges
            for owner, rows, _ in _pieces(piece[0], piece[1], grid.starts)
            if owner == comm.rank and target != comm.rank
        ]
        mine = [
            (owner, rows, at - self.low)
            for piece in wanted[comm.rank]
            for owner, rows, at in _pieces(piece[0], piece[1], grid.starts)
        ]
        self._copies = [(rows, at) for owner, rows, at in mine if owner == comm.rank]
        self._receives = [(owner, rows.stop - rows.start, at) for owner, rows, at in mine if owner != comm.rank]

    def exchange(self) -> None:
        """Fetch the rows below and above those of the slab from the ranks that own them.  Collective."""
        requests = [self.comm.Irecv([self.rows[at : at + n], self._datatype], owner) for owner, n, at in self._receives]
        requests += [self.comm.Isend([self.own[rows], self._datatype], target) for target, rows in self._sends]
        for rows, at in self._copies:
            self.rows[at : at + rows.stop - rows.start] = self.own[rows]
        MPI.Request.Waitall(requests)


def _pieces(low: int, high: int, starts: np.ndarray) -> Iterator[tuple[int, slice, int]]:
    """The periodic range low … high−1 cut at the edges of slabs: (owner, rows local to the owner, first row in the
    numbering of the range).
    """
    nx = int(starts[-1])
    while low < high:
        row = low % nx
        owner = int(np.searchsorted(starts, row, side="right")) - 1
        length = min(high - low, int(starts[owner + 1]) - row)
        local = row - int(starts[owner])
        yield owner, slice(local, local + length), low
        low += length
