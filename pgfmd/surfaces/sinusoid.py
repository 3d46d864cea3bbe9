"""A wave in one or two directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.grid.cell import Cell
from pgfmd.options.rules import flag, integer, number
from pgfmd.options.section import key, wrong
from pgfmd.surfaces.rigid_surface import Surface, coordinates

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid


@dataclass(frozen=True, kw_only=True)
class Sinusoid(Surface):
    """Δ cos(qx), or Δ cos(qx) cos(qy)."""

    kind = "sinusoid"
    amplitude: float = key(number(), about="Δ", unit="length", needed=True, example=1.0)
    waves: int = key(integer(1), 1, "wavelengths in the cell")
    two_dimensional: bool = key(flag(), False, "true: Δ cos(qx) cos(qy)")

    def check_in(self, cell: Cell) -> None:
        for direction, points in zip("xy" if self.two_dimensional else "x", cell.n, strict=False):
            if self.waves > points / 2:
                raise wrong(self, "waves", f"{points} points in {direction} resolve no more than {points // 2}")

    def heights(self, grid: SlabGrid, length_unit: str | None = None) -> np.ndarray:
        return sinusoid(grid, self.amplitude, (self.waves, self.waves if self.two_dimensional else 0))


def sinusoid(grid: SlabGrid, amplitude: float, waves: tuple[int, int] = (1, 0)) -> np.ndarray:
    """Δ cos(2π m x/lx) cos(2π n y/ly) with waves = (m, n): a 1-D wave for n = 0, the 2-D sinusoid for (1, 1)."""
    x, y = coordinates(grid)
    (lx, ly), (m, n) = grid.lengths, waves
    return amplitude * np.cos(2 * np.pi * m / lx * x) * np.cos(2 * np.pi * n / ly * y)
