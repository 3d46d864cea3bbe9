"""The points of a slab that are unknowns, listed row by row (compressed rows), and vectors on them.

In the primal steps these are the points in contact, hence the name; in the dual ones they are the others.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.grid.callbacks import ColumnAction
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.mpi import MPI, datatype
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.kernels import Fields, Points

HALO = 8  # rows of neighbouring ranks: enough for stencils, and for meshes and blocks whose slabs begin elsewhere


class ContactSet:
    """The unknowns of this rank.

    These are points whose pressure lies between its bounds 0 and `top`, or at a bound from which the gap drives it
    (below `level` at 0, above it at `top`).  For gaps as unknowns, the pressure and the gap change places.

    Attributes: count, the number of them; columns (count,) int32, and offsets (nx_local + 1,) of each row in it.
    `lists` and `extended` are (columns, offsets) as the kernels take them, without and with a halo.  Vectors on the set
    are arrays (count,), or `SetVector`s if neighbouring ranks need them.
    """

    def __init__(self, grid: SlabGrid, fields: Fields, level: float = 0.0, top: float = math.inf) -> None:
        """fields: pressure and gap (nx_local, ny).  Collective."""
        self.grid = grid
        rows = grid.local_shape[0]
        counts = np.empty(rows, np.int64)
        grid.threads.deal(lambda a, b: set_kernels.count_unknowns(fields, level, top, (a, b), counts), rows)
        self.offsets = np.concatenate([[0], np.cumsum(counts)])
        self.count = int(self.offsets[-1])
        offsets = self._plan_halo(counts)
        columns = SetVector(self, np.int32)
        self.columns = columns.own
        lists = self.lists
        grid.threads.deal(lambda a, b: set_kernels.list_unknowns(fields, level, top, (a, b), lists), rows)
        self.extended = columns.exchange(), offsets

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

    def _plan_halo(self, counts: np.ndarray) -> np.ndarray:
        """Exchanges the `counts` of points per row with the ranks that hold the `HALO` rows before and after this
        slab (periodic).  Returns the offsets of the rows before, its own, and the rows after.  Collective.
        """
        grid, comm = self.grid, self.grid.comm
        self.thin = min(np.diff(grid.starts)) < HALO
        if self.thin:
            every = np.concatenate(comm.allgather(counts))
            rows = np.arange(grid.rows.start - HALO, grid.rows.stop + HALO) % grid.shape[0]
            offsets = np.concatenate([[0], np.cumsum(every)])
            self.taken = np.concatenate([np.arange(offsets[row], offsets[row + 1]) for row in rows])
            counts = every[rows]
        else:
            ring = np.concatenate([counts[:HALO], counts[-HALO:]])
            previous, following = (np.empty_like(ring) for _ in range(2))
            pass_on(comm, ring, previous, ring, following)
            counts = np.concatenate([previous[HALO:], counts, following[:HALO]])
            self.first_end, self.last_begin = int(self.offsets[HALO]), int(self.offsets[-1 - HALO])
            self.before, self.after = int(previous[HALO:].sum()), int(following[:HALO].sum())
        return np.concatenate([[0], np.cumsum(counts)])

    def convolve(self, values: np.ndarray, action: ColumnAction, out: np.ndarray) -> None:
        """out = (kernel ∗ values) on the set, by full transforms.  Collective."""

        def fill(first: int, stop: int, rows: np.ndarray) -> None:
            set_kernels.fill_rows(values, self.lists, first, rows)

        def drain(first: int, stop: int, rows: np.ndarray) -> None:
            set_kernels.drain_rows(rows, self.lists, first, out)

        self.grid.convolve(fill, action, drain, np.float32)


class SetVector:
    """A vector (count,) on a set, `own`, in one array with the values of the rows before and after those of this rank.

    If a slab is thinner than the halo, the halo spans several ranks, and `exchange` gathers the whole vector instead.
    """

    def __init__(self, points: ContactSet, dtype: DTypeLike = np.float32) -> None:
        self.points = points
        if points.thin:
            self.own = np.empty(points.count, dtype)
        else:
            self._all = np.empty(points.before + points.count + points.after, dtype)
            self.own = self._all[points.before : points.before + points.count]

    def exchange(self) -> np.ndarray:
        """The vector with the present values of its halo, in the order of `ContactSet.extended`.  Collective."""
        points, comm = self.points, self.points.grid.comm
        if points.thin:
            return np.concatenate(comm.allgather(self.own))[points.taken]
        before, after = self._all[: points.before], self._all[points.before + points.count :]
        pass_on(comm, self.own[points.last_begin :], before, self.own[: points.first_end], after)
        return self._all


def pass_on(comm: MPI.Comm, bottom: np.ndarray, before: np.ndarray, top: np.ndarray, after: np.ndarray) -> None:
    """Sends `bottom` to the next rank, which receives it in `before`, and `top` to the previous one, which receives it
    in `after`.  Ranks form a ring.  Collective.
    """
    if comm.size == 1:
        before[...], after[...] = bottom, top
        return
    kind = datatype(top.dtype)
    previous, following = (comm.rank - 1) % comm.size, (comm.rank + 1) % comm.size
    comm.Sendrecv([bottom, kind], following, recvbuf=[before, kind], source=previous)
    comm.Sendrecv([top, kind], previous, recvbuf=[after, kind], source=following)
