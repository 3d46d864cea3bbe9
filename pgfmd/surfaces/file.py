"""Heights that a file holds: measured ones, or made by another program."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pgfmd.options.rules import choice, number, text
from pgfmd.options.section import key, wrong
from pgfmd.surfaces.mirror import folded
from pgfmd.surfaces.surface import Surface

if TYPE_CHECKING:
    from pgfmd.grid.slab_grid import SlabGrid

MARGIN = 10  # a taper takes the tenth part of a side at each edge


@dataclass(frozen=True, kw_only=True)
class FromFile(Surface):
    """The heights in a file.

    A periodic cell repeats the heights: as they are, with a cliff wherever opposite edges differ ("as-is"); after its
    mirror images, in a cell of twice the size ("mirror": heights are continuous and none is changed); or led to their
    mean over the outer tenth of each side ("taper": the size stays, the heights there are not the measured ones).
    """

    kind = "file"
    # .npy, HDF5 (file.h5:dataset), or any format that SurfaceTopography reads; relative to the TOML's folder.  The cell
    # is that of [grid]; what a file says of its size must agree, and of its unit is converted to output.length_unit.
    path: str = key(text(), needed=True)
    dataset: str | None = key(text())  # the same as the part of the path after the colon
    detrend: str = key(choice("none", "mean", "plane"), "none")
    periodic: str = key(choice("as-is", "mirror", "taper"), "as-is")
    height_scale: float = key(number(), 1.0)  # factor on the heights; negative turns them over

    def check(self) -> None:
        if self.height_scale == 0:
            raise wrong(self, "height_scale", "must not be zero")

    @property
    def files(self) -> tuple[str, ...]:
        return (self.source[0],)

    @property
    def source(self) -> tuple[str, str | None]:
        """The heights file and the dataset in it (None: not said), from path, "path:dataset" or dataset."""
        path, colon, dataset = self.path.rpartition(":")
        if self.dataset or not colon or os.path.isfile(self.path):
            return self.path, self.dataset
        return path, dataset or None

    def heights(self, grid: SlabGrid, length_unit: str | None) -> np.ndarray:
        """Read, scaled, levelled and made periodic, as the keys say; see `heights_file.read_heights`.  Collective.

        detrend takes out the mean, or the plane that fits best by least squares.
        """
        from pgfmd.surfaces.heights_file import read_heights  # needs MPI

        copies = 2 if self.periodic == "mirror" else 1
        heights = read_heights(grid, self.source, copies, self.height_scale, length_unit)
        if self.detrend == "mean":
            heights -= grid.reduction.sum(heights) / grid.size
        elif self.detrend == "plane":
            _subtract_plane(grid, heights, [folded(count, copies) for count in grid.shape])
        if self.periodic == "taper":
            mean = grid.reduction.sum(heights) / grid.size
            weights = [_edge_weights(count) for count in grid.shape]
            heights[:] = mean + (heights - mean) * weights[0][grid.rows, None] * weights[1]
        return heights


def _subtract_plane(grid: SlabGrid, heights: np.ndarray, folds: list) -> None:
    """Least-squares plane of the file's heights, in place: with coordinates about their mean, the three coefficients
    are independent; mirror images have the coordinates of what they mirror.  Collective.
    """
    x, y = (fold - fold.mean() for fold in folds)
    nx, ny = grid.shape
    mine = x[grid.rows, None]
    level, along_x, along_y = grid.reduction.sums(heights.sum(), np.sum(mine * heights), np.sum(y * heights))
    slope_x = along_x / (ny * np.sum(x**2)) if np.any(x) else 0.0
    slope_y = along_y / (nx * np.sum(y**2)) if np.any(y) else 0.0
    heights -= level / grid.size + slope_x * mine + slope_y * y


def _edge_weights(count: int) -> np.ndarray:
    """1 in the middle, falling to 0 at both ends like a cosine, over a tenth of the side each."""
    from_edge = np.minimum(np.arange(count), np.arange(count)[::-1]) + 0.5
    return np.sin(np.pi / 2 * np.minimum(from_edge * MARGIN / count, 1)) ** 2
