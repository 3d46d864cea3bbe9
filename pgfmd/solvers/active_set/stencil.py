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

Rows = tuple[np.ndarray, np.ndarray]
"""A contiguous array by rows, and flat: to reshape it takes long to compile."""

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
        vector, lists = (values.all, points.extended), points.lists
        rows, ny = points.grid.local_shape

        def part(first: int, stop: int) -> None:
            work = np.empty((ROWS + 2 * RADIUS, ny + 2 * RADIUS), np.float32)
            correlate(vector, self.weights, (work, work.reshape(-1)), lists, (first, stop), out)

        points.grid.threads.deal(part, rows)


@inlined
def fill_wrapped(values: np.ndarray, points: Points, first: int, count: int, margin: int, rows: np.ndarray) -> None:
    """rows[i, margin + columns[k]] = values[k] for the points k of row first + i, i < count, 0 elsewhere; `margin`
    columns on either side repeat those of the other.
    """
    columns, offsets = points
    ny = rows.shape[1] - 2 * margin
    for i in range(count):
        row = rows[i]
        row[:] = 0
        for k in range(offsets[first + i], offsets[first + i + 1]):
            row[u(margin + columns[k])] = values[k]
        for j in range(margin):
            row[j] = row[j + ny]
        for j in range(margin):
            row[ny + margin + j] = row[margin + j]


@compiled(fastmath=FAST, no_cpython_wrapper=True)
def _thirteen(flat: np.ndarray, p: int, s: int, weights: tuple[float, ...]) -> float:
    """The stencil around flat index p of rows s apart.  Unsigned indices spare the test for negative ones."""
    a, b, c, d, e, f = weights
    centre = a * flat[u(p)] + b * (flat[u(p - 1)] + flat[u(p + 1)]) + c * (flat[u(p - 2)] + flat[u(p + 2)])
    corners = (flat[u(p - s - 1)] + flat[u(p - s + 1)]) + (flat[u(p + s - 1)] + flat[u(p + s + 1)])
    across = d * (flat[u(p - s)] + flat[u(p + s)]) + f * (flat[u(p - 2 * s)] + flat[u(p + 2 * s)])
    return centre + e * corners + across


@inlined
def apply_stencil(
    work: Rows, weights: np.ndarray, points: Points, first: int, count: int, values: np.ndarray
) -> None:
    """values[k] = Σ_st w[s, t] rows[i + 2 + s, columns[k] + 2 + t] for the points k of row first + i, rows i < count.

    weights: w[0, 0], w[0, ±1], w[0, ±2], w[±1, 0], w[±1, ±1], w[±2, 0]; the others are zero.  Points that lie close
    are evaluated together with what lies between them: a loop over contiguous memory is several times faster.
    """
    columns, offsets = points
    flat, stride = work[1], work[0].shape[1]
    line = np.empty(stride, values.dtype)
    six = (weights[0], weights[1], weights[2], weights[3], weights[4], weights[5])
    for i in range(count):
        base = (i + 2) * stride + 2
        k, end = offsets[first + i], offsets[first + i + 1]
        while k < end:
            stop, start = k + 1, columns[k]
            while stop < end and columns[stop] <= columns[stop - 1] + _APART:
                stop += 1
            if stop - k < _FEW:
                for m in range(k, stop):
                    values[m] = _thirteen(flat, base + columns[m], stride, six)
            else:
                for m in range(columns[stop - 1] - start + 1):
                    line[m] = _thirteen(flat, base + start + m, stride, six)
                for m in range(k, stop):
                    values[m] = line[u(columns[m] - start)]
            k = stop


@jit
def correlate(
    vector: tuple[np.ndarray, Points],
    weights: np.ndarray,
    work: Rows,
    targets: Points,
    part: Part,
    out: np.ndarray,
) -> None:
    """`apply_stencil` to a vector (values, points) on one set, whose rows are listed from two before the first on, for
    the points of another in rows first … stop−1; as many rows at a time as `work` has room for.
    """
    values, points = vector
    first, stop = part
    batch = work[0].shape[0] - 4
    for low in range(first, stop, batch):
        count = min(batch, stop - low)
        fill_wrapped(values, points, low, count + 4, 2, work[0])
        apply_stencil(work, weights, targets, low, count, out)
