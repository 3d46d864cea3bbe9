"""A short-ranged kernel between the points of a set, summed in real space."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pgfmd.grid.kernels import jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.solvers.active_set.unknowns import HALO, Part, Points, SetVector

Symbol = Callable[[np.ndarray], np.ndarray]
"""Of an operator: its factor on a mode of wave number |q|, for an array of |q|."""
Vector = tuple[np.ndarray, Points]  # values (count,) on a set, and its points

RADIUS = HALO  # pixels: thirteen points
ROWS = 32  # evaluated together: with `RADIUS` rows more on each side they stay in cache


def lattice_kernel(grid: SlabGrid, symbol: Symbol) -> np.ndarray:
    """Real-space values of `symbol(|q|)` on the pixel lattice, (5, 5), zero beyond the radius of 2 pixels; computed on
    a grid of 64 × 64 with the same spacing, since a short-ranged kernel does not depend on the cell.
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

    def __init__(self, kernel: np.ndarray) -> None:
        corner = kernel[RADIUS:, RADIUS:]
        self.weights = corner[(0, 0, 0, 1, 1, 2), (0, 1, 2, 0, 1, 0)].astype(np.float32)

    def apply(self, values: SetVector, out: np.ndarray) -> None:
        """out (count,) = the kernel applied to `values`.  Collective."""
        values.exchange()
        self.sum(values, out)

    def sum(self, values: SetVector, out: np.ndarray) -> None:
        """The same for values whose halo is present."""
        points = values.points
        vector, (rows, ny) = (values.all, points.extended), points.grid.local_shape

        def part(first: int, stop: int) -> None:
            work = np.empty((ROWS + 2 * RADIUS, ny + 2 * RADIUS), np.float32)
            correlate(vector, self.weights, work, points.lists, (first, stop), out)

        points.grid.threads.deal(part, rows)


@jit
def correlate(
    vector: Vector, weights: np.ndarray, rows: np.ndarray, targets: Points, part: Part, out: np.ndarray
) -> None:
    """out[k] = Σ_st w[s, t] field[i + s, columns[k] + t] at the points k of the rows first ≤ i < stop of one set.  The
    field is a vector (values, points) on another set, 0 elsewhere, and periodic along the rows; row i of `targets` is
    row i + 2 of the field's points.

    weights: w[0, 0], w[0, ±1], w[0, ±2], w[±1, 0], w[±1, ±1], w[±2, 0]; the others are 0.  rows (n + 4, ny + 4): work
    space for n rows at a time.  Points next to each other are evaluated by a vectorised loop.
    """
    values, (sources, begins) = vector
    columns, offsets = targets
    a, b, c, d, e, f = weights[0], weights[1], weights[2], weights[3], weights[4], weights[5]
    ny, batch = rows.shape[1] - 4, rows.shape[0] - 4
    for low in range(part[0], part[1], batch):
        count = min(batch, part[1] - low)
        for i in range(count + 4):
            row = rows[i]
            row[:] = 0
            for k in range(begins[low + i], begins[low + i + 1]):
                row[u(sources[k] + 2)] = values[k]
            row[1] = row[ny + 1]
            row[0] = row[ny]
            row[ny + 2] = row[2]
            row[ny + 3] = row[3]
        for i in range(count):
            p, q, r, s, t = rows[i], rows[i + 1], rows[i + 2], rows[i + 3], rows[i + 4]
            k, end = offsets[low + i], offsets[low + i + 1]
            while k < end:
                stop, shift = k + 1, columns[k] - k
                while stop < end and columns[stop] == shift + stop:
                    stop += 1
                for m in range(k, stop):
                    j = shift + m
                    centre = a * r[u(j + 2)] + b * (r[u(j + 1)] + r[u(j + 3)]) + c * (r[u(j)] + r[u(j + 4)])
                    corners = (q[u(j + 1)] + q[u(j + 3)]) + (s[u(j + 1)] + s[u(j + 3)])
                    across = d * (q[u(j + 2)] + s[u(j + 2)]) + f * (p[u(j + 2)] + t[u(j + 2)])
                    out[u(m)] = centre + e * corners + across
                k = stop
