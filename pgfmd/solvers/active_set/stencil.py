"""A short-ranged kernel between the points of a set, summed in real space."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.solvers.active_set import kernels as set_kernels
from pgfmd.solvers.active_set.unknowns import HALO, Unknowns

Symbol = Callable[[np.ndarray], np.ndarray]
"""Of an operator: what it multiplies a mode of wave number |q| by."""

RADIUS = HALO  # pixels: thirteen points
ROWS = 32  # evaluated together: with `RADIUS` rows more on each side they stay in cache


def lattice_kernel(grid: SlabGrid, symbol: Symbol) -> np.ndarray:
    """Real-space values of `symbol(|q|)` on the pixel lattice, (5, 5), zero beyond the radius of 2 pixels.

    They are computed on a grid of 64 × 64 with the same spacing: a short-ranged kernel does not depend on the cell.
    """
    n = 64
    ax, ay = grid.spacing
    q = np.hypot(2 * np.pi * np.fft.fftfreq(n, ax)[:, None], 2 * np.pi * np.fft.rfftfreq(n, ay)[None, :])
    kernel = np.fft.irfft2(symbol(q), s=(n, n))
    offsets = np.arange(-RADIUS, RADIUS + 1)
    inside = offsets[:, None] ** 2 + offsets[None, :] ** 2 <= RADIUS**2
    return np.where(inside, kernel[np.ix_(offsets, offsets)], 0.0)


class Stencil:
    """z = S K Sᵀ r: S restricts to a set of points, K is a `lattice_kernel`."""

    def __init__(self, grid: SlabGrid, kernel: np.ndarray) -> None:
        self.grid, corner = grid, kernel[RADIUS:, RADIUS:]
        self.weights = corner[(0, 0, 0, 1, 1, 2), (0, 1, 2, 0, 1, 0)].astype(np.float32)

    def apply(self, points: Unknowns, extended: np.ndarray, out: np.ndarray) -> None:
        """out (count,) = the kernel applied to `extended` (`SetVector.exchange`), on the set."""
        vector, lists = (extended, points.extended), points.lists
        rows, ny = self.grid.local_shape

        def part(first: int, stop: int) -> None:
            work = np.empty((ROWS + 2 * RADIUS, ny + 2 * RADIUS), np.float32)
            set_kernels.correlate(vector, self.weights, work, lists, (first, stop), out)

        self.grid.threads.deal(part, rows)
