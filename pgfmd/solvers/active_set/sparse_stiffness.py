"""An approximate inverse of the compliance on a contact set for any solid: a sparse inverse Cholesky factor.

G_CC ≈ (U Uᵀ)⁻¹, with one column of U per point, which conditions it on its `NEAREST` nearest earlier points (Vecchia;
Schäfer, Katzfuss and Owhadi 2021, doi:10.1137/20M1336254).  Points are ordered coarse to fine: first one per cell of
2ᵏ pixels, then of 2ᵏ⁻¹, and so on; so early columns hold long waves.  With A = g(xₐ − x_b) between a point and these
neighbours, the point last, its column is A⁻¹e/√(eᵀA⁻¹e).  All that is needed is the kernel g = F⁻¹[1/K], so it serves
half-spaces, plates, layers and tables alike.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pgfmd.grid.kernels import jit
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import ColumnAction, sink, source

NEAREST = 16
DENSE = 400  # points of one rank up to which the whole matrix is factorised: in about the time of ten iterations on 64²
WINDOW = 3  # cells each way, on three levels, among which the nearest points are sought
LARGEST = 2**22  # points of a grid: each rank holds its kernel and the whole factor, as slabs alone miss long waves

Ordering = tuple[np.ndarray, ...]  # order, rank, levels, cells and starts: see `ordered`


class SparseStiffness:
    """z = U Uᵀ r on the points of a mask (nx_local, ny), by all ranks alike.  Collective to make."""

    def __init__(self, grid: SlabGrid, compliance: ColumnAction) -> None:
        """compliance: acts as G over the number of points."""
        self.grid, self.comm = grid, grid.comm
        pulse, rows = np.zeros(grid.local_shape), grid.new_field()
        if grid.rows.start == 0:
            pulse[0, 0] = 1
        grid.convolve(source(pulse), compliance, sink(rows))
        self.kernel = np.concatenate(grid.comm.allgather(rows))
        self.kernel = self.kernel + abs(self.kernel[0, 0])  # its mean is 0: with a constant it is positive definite
        self.points: np.ndarray | None = None

    def prepare(self, mask: np.ndarray) -> None:
        """Takes a set of points.  Collective."""
        mask = np.concatenate(self.comm.allgather(mask))
        points = np.flatnonzero(mask)
        if self.points is not None and np.array_equal(points, self.points):
            return
        rows, ny = self.grid.rows, mask.shape[1]
        self.own = slice(*np.searchsorted(points, (rows.start * ny, rows.stop * ny)))
        self.points, self.dense, self.at = points, None, points[self.own] - rows.start * ny
        if 0 < len(points) <= DENSE:
            x, y = np.divmod(points, ny)
            self.dense = cho_factor(self.kernel[x[:, None] - x, y[:, None] - y], check_finite=False)
            return
        columns = np.zeros((len(points), NEAREST + 1), np.int64)
        values = np.zeros(columns.shape)
        if len(points):
            condition(ordered(mask), self.kernel, columns, values)
        place = np.full(mask.size, -1)
        place[points] = np.arange(len(points))
        self.rows, self.entries = place[columns], values  # of U, one column of it in each row here

    def apply(self, residual: np.ndarray, out: np.ndarray) -> None:
        """out = U Uᵀ residual on the points, 0 elsewhere; fields (nx_local, ny).  Collective."""
        values = np.concatenate(self.comm.allgather(residual.ravel()[self.at]))
        if self.dense is not None:
            values = cho_solve(self.dense, values, check_finite=False)
        else:
            products = self.entries * np.einsum("ij,ij->i", self.entries, values[self.rows])[:, None]
            values = np.bincount(self.rows.ravel(), products.ravel(), len(values))
        out[...] = 0
        out.ravel()[self.at] = values[self.own]


def ordered(mask: np.ndarray) -> Ordering:
    """Points of a mask coarse to fine.  order: flat indices; rank (mask.size): their place in it; levels: log₂ of the
    cell that a point represents, in the same order; cells: for each level the point (flat index, or −1) of each cell,
    rows by rows; starts: where each level begins there.
    """
    nx, ny = mask.shape
    level = np.full(mask.size, -1)
    tables, starts, k = [], [0], 0
    index = np.where(mask, np.arange(mask.size).reshape(mask.shape), -1)
    while True:
        tables.append(index.ravel())
        starts.append(starts[-1] + index.size)
        level[index[index >= 0]] = k
        if max(index.shape) == 1:
            break
        padded = np.full((-(-index.shape[0] // 2) * 2, -(-index.shape[1] // 2) * 2), -1)
        padded[: index.shape[0], : index.shape[1]] = index
        index = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2).max(axis=(1, 3))
        k += 1
    points = np.flatnonzero(mask)
    order = points[np.argsort(-level[points], kind="stable")]
    rank = np.full(mask.size, -1)
    rank[order] = np.arange(len(order))
    return order, rank, level[order], np.concatenate(tables), np.array(starts)


@jit
def condition(ordering: Ordering, kernel: np.ndarray, columns: np.ndarray, values: np.ndarray) -> None:
    """The columns of U: flat indices and values for the points in order; unused entries are the point itself with 0."""
    order, rank, levels, cells, starts = ordering
    (nx, ny), most = kernel.shape, columns.shape[1] - 1
    near = np.empty(most + 1, np.int64)
    far = np.empty(most + 1, np.float64)
    matrix = np.empty((most + 1, most + 1))
    column = np.empty(most + 1)
    for n in range(order.size):
        point = order[n]
        i, j, count = point // ny, point % ny, 0
        for level in range(levels[n], min(levels[n] + 3, starts.size - 1)):
            rows, line = (nx - 1 >> level) + 1, (ny - 1 >> level) + 1
            for a in range((i >> level) - WINDOW, (i >> level) + WINDOW + 1):
                for b in range((j >> level) - WINDOW, (j >> level) + WINDOW + 1):
                    other = cells[starts[level] + (a % rows) * line + b % line]
                    if other < 0 or rank[other] >= n:
                        continue
                    x, y = abs(other // ny - i), abs(other % ny - j)
                    x, y = min(x, nx - x), min(y, ny - y)
                    distance, known = float(x * x + y * y), False
                    for m in range(count):
                        known = known or near[m] == other
                    if known or (count == most and distance >= far[count - 1]):
                        continue
                    m = count if count < most else most - 1
                    while m > 0 and far[m - 1] > distance:
                        near[m], far[m] = near[m - 1], far[m - 1]
                        m -= 1
                    near[m], far[m] = other, distance
                    count = min(count + 1, most)
        near[count] = point
        for a in range(count + 1):
            for b in range(a + 1):
                x, y = abs(near[a] // ny - near[b] // ny), abs(near[a] % ny - near[b] % ny)
                matrix[a, b] = kernel[x, y]
        # Cholesky factor L of A; A⁻¹e/√(eᵀA⁻¹e) = L⁻ᵀe
        for a in range(count + 1):
            for b in range(a + 1):
                total = matrix[a, b]
                for m in range(b):
                    total -= matrix[a, m] * matrix[b, m]
                if a == b:
                    matrix[a, a] = np.sqrt(max(total, 1e-12 * kernel[0, 0]))
                else:
                    matrix[a, b] = total / matrix[b, b]
        for a in range(count, -1, -1):
            total = 1.0 if a == count else 0.0
            for m in range(a + 1, count + 1):
                total -= matrix[m, a] * column[m]
            column[a] = total / matrix[a, a]
        for a in range(most + 1):
            columns[n, a] = near[a] if a <= count else point
            values[n, a] = column[a] if a <= count else 0.0
