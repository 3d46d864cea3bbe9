"""Single bodies about the centre of the patch: paraboloid (Hertz), cone (Sneddon), flat punch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.options.rules import POSITIVE, choice, number, pair
from pgfmd.options.section import key
from pgfmd.surfaces.rigid_surface import Surface, coordinates

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid


@dataclass(frozen=True, kw_only=True)
class Paraboloid(Surface):
    """−r²/(2R) about the centre of the cell."""

    kind = "paraboloid"
    radius: float = key(POSITIVE, about="R", unit="length", needed=True, example=1000.0)

    def heights(self, grid: SlabGrid, length_unit: str | None = None) -> np.ndarray:
        x, y = _from_centre(grid)
        return -(x**2 + y**2) / (2 * self.radius)


@dataclass(frozen=True, kw_only=True)
class Cone(Surface):
    """−slope · r about the centre of the cell."""

    kind = "cone"
    slope: float = key(POSITIVE, about="of the flank", unit="1", needed=True, example=0.1)

    def heights(self, grid: SlabGrid, length_unit: str | None = None) -> np.ndarray:
        x, y = _from_centre(grid)
        return -self.slope * np.hypot(x, y)


@dataclass(frozen=True, kw_only=True)
class Punch(Surface):
    """A flat punch at the centre of the cell, at height 0 if not tilted.  Beyond its face the height falls by
    d²/(2 edge), d the distance, at most to −depth; with edge = 0 by `depth` at once.
    """

    kind = "punch"
    shape: str = key(choice("round", "square"), "round", "of the face")
    radius: float = key(POSITIVE, about="of a round face, half the side of a square one", unit="length", needed=True,
                        example=100.0)  # fmt: skip
    depth: float = key(POSITIVE, 1e3, "of the surroundings below the face", unit="length")
    edge: float = key(number(low=0), 0.0, "radius of the rounded border; 0: sharp", unit="length")
    tilt: tuple[float, float] = key(pair(number()), (0.0, 0.0), "slopes of the face along x and y", unit="1")

    def heights(self, grid: SlabGrid, length_unit: str | None = None) -> np.ndarray:
        x, y = _from_centre(grid)
        r = np.hypot(x, y) if self.shape == "round" else np.maximum(np.abs(x), np.abs(y))
        beyond = np.maximum(r - self.radius, 0.0)
        fall = np.minimum(beyond**2 / (2 * self.edge), self.depth) if self.edge else self.depth * (beyond > 0)
        return self.tilt[0] * x + self.tilt[1] * y - fall


def _from_centre(grid: SlabGrid) -> tuple[np.ndarray, np.ndarray]:
    """Positions x (nx_local, 1) and y (1, ny) counted from the centre of the cell."""
    x, y = coordinates(grid)
    return x - grid.lengths[0] / 2, y - grid.lengths[1] / 2
