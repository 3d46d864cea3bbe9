"""A short-ranged kernel between the points of a set, summed in real space."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pgfmd.grid.kernels import FAST, inlined, jit, u
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.parallel.compiled import compiled
from pgfmd.solvers.active_set.unknowns import HALO, Part, Points, SetVector

Symbol = Callable[[np.ndarray], np.ndarray]
"""Of an operator: its factor on a mode of wave number |q|, for an array of |q|."""

Rows = tuple[np.ndarray, int]
"""Rows one after the other in one array, and their length: to reshape an array takes long to compile."""

RADIUS = HALO  # pixels: thirteen points
ROWS = 32  # evaluated together: with `RADIUS` rows more on each side they stay in cache
_APART, _FEW = 2, 8  # columns between points evaluated together; points below which that is not worth it


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
        points.grid.threads.deal(lambda a, b: correlate(vector, self.weights, ny, points.lists, (a, b), out), rows)


@inlined
def fill_wrapped(values: np.ndarray, points: Points, part: Part, rows: Rows) -> None:
    """Row i of the rows, from column `RADIUS` on, is values[k] at columns[k] for the points k of row first + i, up to
    row stop−1, and 0 elsewhere; `RADIUS` columns on either side repeat those of the other.
    """
    (columns, offsets), (first, stop), (flat, stride) = points, part, rows
    ny = stride - 2 * RADIUS
    for i in range(stop - first):
        row = flat[i * stride : (i + 1) * stride]
        row[:] = 0
        for k in range(offsets[first + i], offsets[first + i + 1]):
            row[u(RADIUS + columns[k])] = values[k]
        for j in range(RADIUS):
            row[j] = row[j + ny]
        for j in range(RADIUS):
            row[ny + RADIUS + j] = row[RADIUS + j]


@compiled(fastmath=FAST, no_cpython_wrapper=True)
def _thirteen(flat: np.ndarray, p: int, s: int, weights: tuple[float, ...]) -> float:
    """The stencil around flat index p of rows s apart.  Unsigned indices spare the test for negative ones."""
    a, b, c, d, e, f = weights
    centre = a * flat[u(p)] + b * (flat[u(p - 1)] + flat[u(p + 1)]) + c * (flat[u(p - 2)] + flat[u(p + 2)])
    corners = (flat[u(p - s - 1)] + flat[u(p - s + 1)]) + (flat[u(p + s - 1)] + flat[u(p + s + 1)])
    across = d * (flat[u(p - s)] + flat[u(p + s)]) + f * (flat[u(p - 2 * s)] + flat[u(p + 2 * s)])
    return centre + e * corners + across


@inlined
def apply_stencil(rows: Rows, weights: np.ndarray, points: Points, part: Part, out: np.ndarray) -> None:
    """out[k] = Σ_st w[s, t] (row i − first + 2 + s of the rows)[columns[k] + 2 + t] for the points k of the rows first
    ≤ i < stop.

    weights: w[0, 0], w[0, ±1], w[0, ±2], w[±1, 0], w[±1, ±1], w[±2, 0]; the others are zero.  Points that lie close
    are evaluated together with what lies between them: a loop over contiguous memory is several times faster.
    """
    (columns, offsets), (first, stop), (flat, stride) = points, part, rows
    line = np.empty(stride, out.dtype)
    six = (weights[0], weights[1], weights[2], weights[3], weights[4], weights[5])
    for i in range(first, stop):
        base = (i - first + 2) * stride + 2
        k, end = offsets[i], offsets[i + 1]
        while k < end:
            end_of_run, start = k + 1, columns[k]
            while end_of_run < end and columns[end_of_run] <= columns[end_of_run - 1] + _APART:
                end_of_run += 1
            if end_of_run - k < _FEW:
                for m in range(k, end_of_run):
                    out[m] = _thirteen(flat, base + columns[m], stride, six)
            else:
                for m in range(columns[end_of_run - 1] - start + 1):
                    line[m] = _thirteen(flat, base + start + m, stride, six)
                for m in range(k, end_of_run):
                    out[m] = line[u(columns[m] - start)]
            k = end_of_run


@jit
def correlate(
    vector: tuple[np.ndarray, Points], weights: np.ndarray, ny: int, targets: Points, part: Part, out: np.ndarray
) -> None:
    """`apply_stencil` to a vector (values, points) on one set, whose rows of ny points are listed from two before the
    first on, for the points of another in rows first … stop−1; `ROWS` rows at a time.
    """
    values, points = vector
    stride = ny + 2 * RADIUS
    rows = np.empty((ROWS + 2 * RADIUS) * stride, values.dtype), stride
    for low in range(part[0], part[1], ROWS):
        high = min(low + ROWS, part[1])
        fill_wrapped(values, points, (low, high + 2 * RADIUS), rows)
        apply_stencil(rows, weights, targets, (low, high), out)
