"""The points of a slab that are unknowns, listed row by row (compressed rows), and vectors on them.

In the primal steps these are points in contact, in the dual ones the others.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.grid.callbacks import ColumnAction
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import MPI
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.kernels import Fields, Points

HALO = 2  # rows of neighbouring ranks on either side: the radius of a stencil


class Unknowns:
    """The unknowns of this rank.

    These are points whose pressure lies between its bounds 0 and `top`, or at a bound from which the gap drives it
    (below `level` at 0, above it at `top`).  For gaps as unknowns, the pressure and the gap change places.

    Attributes: count, the number of them; columns (count,) int32, and offsets (nx_local + 1,) of each row in it.
    `lists` and `extended` are (columns, offsets) as the kernels take them, without and with a halo of `HALO` rows.
    Vectors on the set are arrays (count,), or `SetVector`s if neighbouring ranks need them.
    """

    def __init__(self, grid: SlabGrid, fields: Fields, level: float = 0.0, top: float = math.inf) -> None:
        """fields: pressure and gap (nx_local, ny).  Collective."""
        self.grid = grid
        rows = grid.local_shape[0]
        self.halo = grid.around(HALO, rows)
        every = np.empty(rows + 2 * HALO, np.int64)
        counts = every[HALO : HALO + rows]
        grid.threads.deal(lambda a, b: set_kernels.count_unknowns(fields, level, top, (a, b), counts), rows)
        self.halo.fetch(counts, every)
        self.every_offset = np.concatenate([[0], np.cumsum(every)])
        own = self.every_offset[HALO : HALO + rows + 1]
        self.first, self.offsets, self.count = int(own[0]), own - own[0], int(own[-1] - own[0])
        columns = SetVector(self, np.int32)
        self.columns = columns.own
        lists = self.lists
        grid.threads.deal(lambda a, b: set_kernels.list_unknowns(fields, level, top, (a, b), lists), rows)
        self.extended = columns.exchange(), self.every_offset

    @property
    def lists(self) -> Points:
        """(columns, offsets) of this rank's points."""
        return self.columns, self.offsets

    def below(self, level: float, field: np.ndarray) -> SetVector:
        """level − field (nx_local, ny) on the set, in single precision."""
        out = SetVector(self)
        self.grid.threads.deal(
            lambda a, b: set_kernels.take_below(field, self.lists, (a, b), level, out.own), len(field)
        )
        return out

    def add(self, field: np.ndarray, values: np.ndarray) -> None:
        """Adds values (count,) to a field (nx_local, ny) on the set."""
        self.grid.threads.deal(lambda a, b: set_kernels.add_to_rows(field, self.lists, (a, b), values), len(field))

    def convolve(self, values: np.ndarray, action: ColumnAction, out: np.ndarray) -> None:
        """out = (kernel ∗ values) on the set, by full transforms.  Collective."""

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            set_kernels.fill_rows(values, self.lists, first, rows)

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            set_kernels.drain_rows(rows, self.lists, first, out)

        self.grid.convolve(fill, action, drain, np.float32)


class SetVector:
    """A vector (count,) on a set, `own`, within an array `all` of the values of the rows before, its own, and the rows
    after, in the order of `Unknowns.extended`.
    """

    def __init__(self, points: Unknowns, dtype: DTypeLike = np.float32) -> None:
        self.points = points
        self.all = np.empty(points.every_offset[-1], dtype)
        self.own = self.all[points.first : points.first + points.count]

    def start(self) -> list[MPI.Request]:
        """Begins to `exchange`.  `own` may be read meanwhile."""
        return self.points.halo.start(self.own, self.all, (self.points.offsets, self.points.every_offset))

    def exchange(self) -> np.ndarray:
        """The vector with the present values of its halo.  Collective."""
        MPI.Request.Waitall(self.start())
        return self.all
