"""Small grids on fewer ranks, so that messages do not dominate.  Only the smallest lie on one rank."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.grid.grid_cost import LEAST_ROWS, holders
from pgfmd.grid.slab_grid import SlabGrid, transform_work
from pgfmd.parallel.collectives import await_all, mark_shared, shared, team_of
from pgfmd.parallel.layout import Layout, Range, RowWindow

T = TypeVar("T")


class SubGrid:
    """A grid on some of the ranks of a larger one.  Collective to make.

    Attributes: shape, size, spacing, domain, torus and work as of a `SlabGrid`; layout, of its rows over the ranks of
    the larger grid; local_shape of a field on this rank, which may have no rows; grid: None on ranks without rows.
    """

    def __init__(
        self, parent: SlabGrid, shape: tuple[int, int], lengths: tuple[float, float], least: int = LEAST_ROWS
    ) -> None:
        """least: rows per rank."""
        nx, ny = shape
        count = holders(shape, parent.comm.size, least)
        self.comm, self.shape, self.size = parent.comm, shape, nx * ny
        self.spacing = lengths[0] / nx, lengths[1] / ny
        self.domain = parent.domain
        self.torus = self.domain.torus(shape, self.spacing)
        self.work = transform_work(shape, self.torus)
        self.layout = Layout.spread(parent.comm, nx, count)
        self.local_shape = self.layout.rows.stop - self.layout.rows.start, ny
        team = team_of(parent.comm, count)
        self.grid = None if team is None else parent.like(team, shape, lengths)

    @classmethod
    def coarse(cls, fine: SlabGrid, factor: int = 2) -> SubGrid:
        """The grid of the same domain with 1/factor of the points each way (rounded up).  Collective."""
        nx, ny = -(-fine.shape[0] // factor), -(-fine.shape[1] // factor)
        if fine.domain.wraps:
            return cls(fine, (nx, ny), fine.lengths)
        return cls(fine, (nx, ny), (factor * nx * fine.spacing[0], factor * ny * fine.spacing[1]))

    @property
    def columns(self) -> slice:
        """Columns ky of this rank."""
        return slice(0, 0) if self.grid is None else self.grid.columns

    def no_rows(self) -> np.ndarray:
        """The field (0, ny) of a rank that holds none."""
        return np.empty((0, self.shape[1]))

    def window(self, span: Range, dtype: DTypeLike = np.float32) -> RowWindow:
        """Rows around those of this rank.  Collective."""
        return RowWindow(self.layout, span, self.shape[1], dtype)

    def on_all(self, work: Callable[[SlabGrid], T], without_rows: Callable[[T], T] = lambda value: value) -> T:
        """`work(grid)` on the ranks that hold the grid; the others receive `without_rows` of the value of rank 0.
        Collective.

        Errors that all ranks of `work` raise are raised on all ranks; a rank that fails alone raises its error at once,
        since the others may wait for it in `work`.
        """
        if self.grid is not None and self.grid.comm.size == self.comm.size:
            return work(self.grid)
        value: T | None = None
        failure: Exception | None = None
        if self.grid is not None:
            try:
                value = work(self.grid)
            except Exception as error:
                if not shared(self.grid.comm, error):
                    raise
                failure = error
        await_all(self.comm)
        sent = None if value is None else without_rows(value), failure
        sent = self.comm.bcast(sent if self.comm.rank == 0 else None)
        failure = sent[1] if failure is None else failure
        if failure is not None:
            raise mark_shared(self.comm, failure)
        return value if self.grid is not None else sent[0]  # type: ignore[return-value]  # one of them is a T

    def free(self) -> None:
        """Frees the memory of the transforms.  Collective."""
        if self.grid is not None:
            self.grid.free()
