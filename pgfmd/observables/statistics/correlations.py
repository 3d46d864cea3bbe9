"""Spectra and autocorrelations of distributed fields, averaged over direction, without another array of their size.

A field passes through the grid's transform in blocks; each block of modes is squared and summed into bins while it is
in the cache, and goes back to real space as the autocorrelation, which is summed into bins row by row.  One forward
transform gives a spectrum, one more backward the autocorrelation too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgfmd.grid.callbacks import ColumnAction, RowAction
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.statistics.kernels import bin_geometry, bin_rows
from pgfmd.parallel.mpi import MPI


@dataclass(frozen=True)
class Correlations:
    """Second-order statistics of one field f; the same on all ranks.  f̃(q) = (1/N) Σ_r f(r) exp(−iq·r)."""

    power: np.ndarray  # Σ |f̃|² over the modes below the first edge (q = 0 too), in each bin, beyond: (m + 2,)
    acf: np.ndarray | None = None  # Σ C(Δr) over the points of each bin of lags: (k + 2,)
    acf_x: np.ndarray | None = None  # C(Δx, 0): (nx//2 + 1,)
    acf_y: np.ndarray | None = None  # C(0, Δy): (ny//2 + 1,)


class Rings:
    """Bins of ρ = √(along[i] + across[j]) for the entries (j, i) of a distributed array.  Collective to make.

    Bin b holds edges[b] < ρ ≤ edges[b+1].
    along (n,), across (this rank's rows,): squares;  weight (this rank's rows,): factor on the entries of each row.
    Sums have shape (edges + 1,): below the first edge, in each bin, beyond the last edge.
    """

    def __init__(self, grid: SlabGrid, along: np.ndarray, across: np.ndarray, weight: np.ndarray, edges: np.ndarray):
        self.comm, self.along, self.across, self.weight = grid.comm, along, across, np.ascontiguousarray(weight)
        self.edges = np.asarray(edges)
        self._squares = np.sign(edges) * np.square(edges)
        counts, roots = {}, {}

        def part(first: int, stop: int) -> None:
            counts[first], roots[first] = np.zeros((2, len(edges) + 1))
            rows = across[first:stop], self.weight[first:stop]
            bin_geometry(along, *rows, self._squares, counts[first], roots[first])

        grid.threads.split(part, len(across))
        self.count, self.roots = self.total(counts), self.total(roots)

    def sums(self, values: np.ndarray, first: int, stop: int) -> np.ndarray:
        """Weighted sums over the bins of rows first … stop − 1 of this rank, values (stop − first, n)."""
        out = np.zeros(len(self.edges) + 1)
        bin_rows(values, self.along, self.across[first:stop], self.weight[first:stop], self._squares, out)
        return out

    def total(self, parts: dict[int, np.ndarray]) -> np.ndarray:
        """Sum of the parts over blocks, in the order of their rows, and over the ranks.  Collective."""
        out = np.sum([np.zeros(len(self.edges) + 1), *(parts[first] for first in sorted(parts))], axis=0)
        self.comm.Allreduce(MPI.IN_PLACE, out)
        return out

    def means(self, sums: np.ndarray, place: str) -> dict[str, np.ndarray]:
        """Means over the bins that hold something: mean ρ under the name `place`, value, count; and edges of all
        bins.
        """
        inner = slice(1, len(self.edges))
        filled = self.count[inner] > 0
        count, roots, sums = (entry[inner][filled] for entry in (self.count, self.roots, sums))
        return {place: roots / count, "value": sums / count, "count": count, "edges": self.edges}


def mode_rings(grid: SlabGrid, edges: np.ndarray) -> Rings:
    """Bins of |q| for the modes of a grid.  Collective."""
    return Rings(grid, grid.qx[0] ** 2, grid.qy[:, 0] ** 2, grid.hermitian_weight[:, 0], edges)


def lag_rings(grid: SlabGrid, edges: np.ndarray) -> Rings:
    """Bins of the periodic distance |Δr| for the points of a grid.  Collective."""
    x, y = (_fold(n) * step for n, step in zip(grid.shape, grid.spacing, strict=True))
    return Rings(grid, y**2, x[grid.rows] ** 2, np.ones(grid.local_shape[0]), edges)


def squared(block: np.ndarray) -> np.ndarray:
    """|z|² of a block of modes, real, in its memory; the block itself becomes |z|² + 0i."""
    parts = block.view(np.float64).reshape(*block.shape, 2)
    np.multiply(parts, parts, out=parts)
    parts[..., 0] += parts[..., 1]
    parts[..., 1] = 0
    return parts[..., 0]


def correlate(
    grid: SlabGrid, fill: RowAction, modes: Rings, lags: Rings | None = None, watch: ColumnAction | None = None
) -> Correlations:
    """Spectrum, and with `lags` autocorrelation ⟨f(r) f(r + Δr)⟩, of the field whose rows `fill` makes.  Collective.

    One forward transform (modes beyond the last bin may be left out), and one backward for the autocorrelation.
    watch(power, first, stop) sees each block N²|f̃|² (stop − first, nx), on any thread.
    """
    square_size = float(grid.size) ** 2
    power: dict[int, np.ndarray] = {}

    def square(block: np.ndarray, first: int, stop: int) -> None:
        values = squared(block)
        power[first] = modes.sums(values, first, stop)
        if watch is not None:
            watch(values, first, stop)

    if lags is None:
        count = None if watch else int(np.searchsorted(grid.qy[:, 0], modes.edges[-1], side="right"))
        grid.read_spectrum(fill, square, count=count)  # what lies beyond all bins need not be transformed along x
        return Correlations(modes.total(power) / square_size)
    sums: dict[int, np.ndarray] = {}
    column, row = np.empty(grid.local_shape[0]), np.empty(grid.shape[1])

    def collect(first: int, stop: int, rows: np.ndarray) -> None:
        rows /= square_size
        sums[first] = lags.sums(rows, first, stop)
        column[first:stop] = rows[:, 0]
        if first == 0:
            row[:] = rows[0]

    grid.convolve(fill, square, collect)
    grid.comm.Bcast(row)  # that of rank 0, which holds Δx = 0
    (nx, ny), counts = grid.shape, np.diff(grid.starts)
    along_x = np.empty(nx)
    grid.comm.Allgatherv(column, [along_x, counts])
    return Correlations(
        modes.total(power) / square_size, lags.total(sums), along_x[: nx // 2 + 1], row[: ny // 2 + 1]
    )  # fmt: skip


def along_axis(grid: SlabGrid, values: np.ndarray, axis: int) -> dict[str, np.ndarray]:
    """An autocorrelation along an axis as r, value, count and edges, one point in each bin of one grid spacing."""
    step = grid.spacing[axis]
    steps = np.arange(len(values) + 1)
    return {"r": steps[:-1] * step, "value": values, "count": np.ones(len(values)), "edges": (steps - 0.5) * step}


def indicator(field: np.ndarray, threshold: float) -> RowAction:
    """Fills blocks of rows with 1 where the field is above the threshold, and 0 elsewhere."""

    def fill(first: int, stop: int, rows: np.ndarray) -> None:
        np.greater(field[first:stop], threshold, out=rows)

    return fill


def _fold(n: int) -> np.ndarray:
    """Periodic distances of the points 0 … n−1 from point 0, in grid spacings."""
    return np.minimum(np.arange(n), n - np.arange(n)).astype(float)
