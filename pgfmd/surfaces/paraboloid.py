"""One parabolic asperity, for Hertz contact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.options.rules import POSITIVE
from pgfmd.options.section import key
from pgfmd.surfaces.surface import Surface, coordinates

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid


@dataclass(frozen=True, kw_only=True)
class Paraboloid(Surface):
    """−r²/(2R) about the centre of the cell."""

    kind = "paraboloid"
    radius: float = key(POSITIVE, about="R", unit="length", needed=True, example=1000.0)

    def heights(self, grid: SlabGrid, length_unit: str | None = None) -> np.ndarray:
        return paraboloid(grid, self.radius)


def paraboloid(grid: SlabGrid, radius: float) -> np.ndarray:
    """−r²/2R about the centre of the cell, r the distance to it."""
    x, y = coordinates(grid)
    return -((x - grid.lengths[0] / 2) ** 2 + (y - grid.lengths[1] / 2) ** 2) / (2 * radius)
