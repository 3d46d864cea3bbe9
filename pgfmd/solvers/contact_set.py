"""The points in contact of one slab, as compressed rows: vectors on them are short, and no array of the size of the
grid is needed.
"""

from __future__ import annotations

import numpy as np

from .. import kernels
from ..grid import SlabGrid
from ..transforms import Columns


class ContactSet:
    """Points of this rank with p > 0, or with p = 0 and a gap below `level`.

    Attributes: count of them; columns (count,) int32 and offsets (nx_local + 1,) into it; vectors on the set are
    (count,).
    """

    def __init__(self, grid: SlabGrid, pressure: np.ndarray, gap: np.ndarray, level: float, dtype=np.float32):
        self.grid, self.dtype = grid, np.dtype(dtype)
        rows = grid.local_shape[0]
        counts = np.empty(rows, np.int64)
        grid.threads.split(lambda a, b: kernels.count_contact(pressure, gap, level, a, b, counts), rows)
        self.offsets = np.concatenate([[0], np.cumsum(counts)])
        self.count = int(self.offsets[-1])
        self.columns = np.empty(self.count, np.int32)
        grid.threads.split(
            lambda a, b: kernels.list_contact(pressure, gap, level, a, b, self.offsets, self.columns), rows
        )

    @property
    def lists(self) -> tuple[np.ndarray, np.ndarray]:
        """(columns, offsets), as the kernels take them."""
        return self.columns, self.offsets

    def take(self, field: np.ndarray) -> np.ndarray:
        """The values (count,) of a field (nx_local, ny) on the set."""
        values = np.empty(self.count, field.dtype)
        self.grid.threads.split(
            lambda a, b: kernels.take_rows(field, self.columns, self.offsets, a, b, values), len(field)
        )
        return values

    def put(self, field: np.ndarray, values: np.ndarray) -> None:
        """Overwrites a field (nx_local, ny) on the set."""
        self.grid.threads.split(
            lambda a, b: kernels.put_rows(field, self.columns, self.offsets, a, b, values), len(field)
        )

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

    def convolve(self, values: np.ndarray, action: Columns, out: np.ndarray) -> None:
        """out = (kernel ∗ values) on the set.  Collective."""
        self.grid.convolve(self.fill(values), action, self.drain(out), self.dtype)
