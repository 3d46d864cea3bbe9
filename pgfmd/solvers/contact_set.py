"""The points in contact of one slab, as compressed rows: vectors on them are short, and no array of the size of the
grid is needed.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from .. import kernels
from ..grid import SlabGrid
from ..transforms import Columns

HALO = 8  # rows of neighbours: enough for stencils, and for coarser grids whose slabs begin elsewhere


class ContactSet:
    """Points of this rank with p > 0, or with p = 0 and a gap below `level`.

    Attributes: count of them; columns (count,) int32 and offsets (nx_local + 1,) into it; vectors on the set are
    (count,).  `lists` and `extended` are (columns, offsets) as the kernels take them, without and with a halo.
    """

    def __init__(self, grid: SlabGrid, pressure: np.ndarray, gap: np.ndarray, level: float, dtype=np.float32):
        self.grid, self.dtype = grid, np.dtype(dtype)
        rows = grid.local_shape[0]
        counts = np.empty(rows, np.int64)
        grid.threads.deal(lambda a, b: kernels.count_contact(pressure, gap, level, a, b, counts), rows)
        self.offsets = np.concatenate([[0], np.cumsum(counts)])
        self.count = int(self.offsets[-1])
        self.columns = np.empty(self.count, np.int32)
        grid.threads.deal(
            lambda a, b: kernels.list_contact(pressure, gap, level, a, b, self.offsets, self.columns), rows
        )
        self._make_halo()

    @property
    def lists(self) -> tuple[np.ndarray, np.ndarray]:
        """(columns, offsets) of this rank's points."""
        return self.columns, self.offsets

    def take(self, field: np.ndarray) -> np.ndarray:
        """The values (count,) of a field (nx_local, ny) on the set."""
        values = np.empty(self.count, field.dtype)
        self.grid.threads.deal(
            lambda a, b: kernels.take_rows(field, self.columns, self.offsets, a, b, values), len(field)
        )
        return values

    def put(self, field: np.ndarray, values: np.ndarray) -> None:
        """Overwrites a field (nx_local, ny) on the set."""
        self.grid.threads.deal(
            lambda a, b: kernels.put_rows(field, self.columns, self.offsets, a, b, values), len(field)
        )

    def add(self, field: np.ndarray, values: np.ndarray) -> None:
        """Adds values (count,) to a field (nx_local, ny) on the set."""
        self.grid.threads.deal(
            lambda a, b: kernels.add_to_rows(field, self.columns, self.offsets, a, b, values), len(field)
        )

    def _make_halo(self) -> None:
        """Learn which points lie in the `HALO` rows before and after those of this rank, around the ring.
        Collective.
        """
        grid, comm = self.grid, self.grid.comm
        counts = np.diff(self.offsets)
        self._thin = min(np.diff(grid.starts)) < HALO
        if self._thin:
            every = np.concatenate(comm.allgather(counts))
            rows = np.arange(grid.rows.start - HALO, grid.rows.stop + HALO) % grid.shape[0]
            offsets = np.concatenate([[0], np.cumsum(every)])
            self._taken = np.concatenate([np.arange(offsets[row], offsets[row + 1]) for row in rows])
            counts = every[rows]
        else:
            ring = np.concatenate([counts[:HALO], counts[-HALO:]])
            previous, following = (np.empty_like(ring) for _ in range(2))
            self._pass_on(ring, previous, ring, following)
            counts = np.concatenate([previous[HALO:], counts, following[:HALO]])
            self._top, self._bottom = int(self.offsets[HALO]), int(self.offsets[-1 - HALO])
            self._before, self._after = int(previous[HALO:].sum()), int(following[:HALO].sum())
        offsets = np.concatenate([[0], np.cumsum(counts)])
        self.extended = self.extend(self.columns), offsets
        if not self._thin:  # the same memory once
            self.columns = self.extended[0][self._before : self._before + self.count]

    def extend(self, values: np.ndarray) -> np.ndarray:
        """`values` (count,) with those of the halo before and after them, as `extended` lists them.  Collective."""
        if self._thin:
            return np.concatenate(self.grid.comm.allgather(values))[self._taken]
        out = np.empty(self._before + self.count + self._after, values.dtype)
        before, after = out[: self._before], out[self._before + self.count :]
        own = out[self._before : self._before + self.count]
        own[:] = values
        self._pass_on(own[self._bottom :], before, own[: self._top], after)
        return out

    def _pass_on(self, bottom: np.ndarray, before: np.ndarray, top: np.ndarray, after: np.ndarray) -> None:
        """`bottom` to the next rank, which receives it as `before`; `top` to the previous one, as `after`.
        Collective.
        """
        comm = self.grid.comm
        if comm.size == 1:
            before[...], after[...] = bottom, top
            return
        kind = MPI._typedict[top.dtype.char]
        previous, following = (comm.rank - 1) % comm.size, (comm.rank + 1) % comm.size
        comm.Sendrecv([bottom, kind], following, recvbuf=[before, kind], source=previous)
        comm.Sendrecv([top, kind], previous, recvbuf=[after, kind], source=following)

    def fill(self, values: np.ndarray):
        """Rows that hold `values` on the set and zero elsewhere (a source for `SlabGrid.convolve`)."""

        def rows(first: int, stop: int, block: np.ndarray):
            kernels.fill_rows(values, self.columns, self.offsets, first, block)

        return rows

    def drain(self, values: np.ndarray):
        """Takes the values on the set out of rows (a sink for `SlabGrid.convolve`)."""

        def rows(first: int, stop: int, block: np.ndarray):
            kernels.drain_rows(block, self.columns, self.offsets, first, values)

        return rows

    def convolve(self, values: np.ndarray, action: Columns, out: np.ndarray, targets: ContactSet | None = None) -> None:
        """out = (kernel ∗ values) on the set, or on `targets`.  Collective."""
        self.grid.convolve(self.fill(values), action, (targets or self).drain(out), self.dtype)
