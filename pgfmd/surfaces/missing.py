"""Counts points that were not measured and fills them with a harmonic function (Laplace's equation)."""

from __future__ import annotations

import math

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.slab_grid import SlabGrid

ACCURACY = 1e-12  # norm of the residual, relative to that at the start, at which conjugate gradients stop


def count_missing(grid: SlabGrid, heights: np.ndarray) -> int:
    """Number of heights (nx_local, ny) that are NaN, over all ranks.  Collective."""
    return int(grid.reduction.sum(np.isnan(heights)))


def fill_missing(grid: SlabGrid, heights: np.ndarray) -> None:
    """Replace the heights (nx_local, ny) that are NaN by a solution of Laplace's equation, in place.  Collective.

    Each becomes the mean of its four neighbours, weighted with 1/aₓ² and 1/a_y²; neighbours beyond the edges of
    the array are left out, since opposite edges of a measurement do not match.  So a hole inside a plane is filled
    with that plane.  Conjugate gradients over the missing points alone.  Raises InputError if no point was measured.
    """
    missing = np.isnan(heights)
    largest = grid.reduction.max(np.max(np.abs(heights), where=~missing, initial=0.0))
    exponent = math.frexp(largest)[1]
    np.ldexp(heights, -exponent, out=heights)  # so that squares neither overflow nor underflow
    known, count = grid.reduction.sums(np.sum(heights, where=~missing), missing.sum())
    if count == grid.size:
        raise InputError("no point was measured")
    heights[missing] = known / (grid.size - count)
    holes = _Holes(grid, missing)
    holes.field[...] = heights
    residual = holes.unbalance()
    direction, change = residual.copy(), np.zeros(len(residual))
    squares = first = grid.reduction.dot(residual, residual)
    holes.field[...] = 0.0
    while squares > ACCURACY**2 * first:
        holes.field[missing] = direction
        image = -holes.unbalance()
        length = squares / grid.reduction.dot(direction, image)
        change += length * direction
        residual -= length * image
        before, squares = squares, grid.reduction.dot(residual, residual)
        direction = residual + squares / before * direction
    heights[missing] += change
    np.ldexp(heights, exponent, out=heights)


class _Holes:
    """The missing points of this rank, in a field (nx_local, ny) that has one more row above and below."""

    def __init__(self, grid: SlabGrid, missing: np.ndarray):
        self.grid, (nx, ny) = grid, grid.shape
        self._rows = np.empty((len(missing) + 2, ny))
        self.field = self._rows[1:-1]
        rows, columns = np.nonzero(missing)
        self._points, row = (rows + 1) * ny + columns, rows + grid.rows.start
        self._neighbours = [  # (weight, one side, the other); beyond an edge a point is its own neighbour
            (grid.spacing[1] / grid.spacing[0], self._points - ny * (row > 0), self._points + ny * (row < nx - 1)),
            (grid.spacing[0] / grid.spacing[1], self._points - (columns > 0), self._points + (columns < ny - 1)),
        ]

    def unbalance(self) -> np.ndarray:
        """Σ w (neighbour − point) of `field` at each missing point.  Collective."""
        first, stop = self.grid.rows.start, self.grid.rows.stop
        self._rows[0] = self.grid.fetch(self.field, first - 1, first)
        self._rows[-1] = self.grid.fetch(self.field, stop, stop + 1)
        values = self._rows.ravel()
        twice = 2 * values[self._points]
        return sum(weight * (values[low] + values[high] - twice) for weight, low, high in self._neighbours)
