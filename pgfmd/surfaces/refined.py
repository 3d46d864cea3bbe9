"""Heights on the grid on which contacts are solved, which may be finer than that of the surface ([grid] refine)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.grid.transfer import interpolate
from pgfmd.surfaces.surface import Surface

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid


def refined_heights(surface: Surface, cell: Cell, grid: SlabGrid, length_unit: str | None) -> np.ndarray:
    """The heights (nx_local, ny) of a surface in a cell, on the grid of `cell.refined`.  Collective.

    Raises InputError on all ranks, as `Surface.heights` does.
    """
    if cell.refine == 1:
        return surface.heights(grid, length_unit)
    own = grid.like(grid.comm, cell.shape, cell.lengths)
    with own.freed():
        return interpolate(own, grid, surface.heights(own, length_unit))
