"""Spectra and autocorrelations of distributed fields, averaged over direction, without any array of their size.

A field passes through the grid's transform in blocks; each block of modes is squared and summed into bins while it is
in the cache, and goes back to real space as the autocorrelation, which is summed into bins row by row.  One forward
transform gives a spectrum, one more backward the autocorrelation too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from pgfmd.grid.callbacks import Columns, Rows
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables.kernels import bin_geometry, bin_rows, power_in_place
from pgfmd.observables.spectra import HAIR, bin_edges, lag_edges


@dataclass(frozen=True)
class Measured:
    """One field's second-order statistics; the same on all ranks.  f̂(q) = Σ_r f(r) exp(−iq·r), unnormalised."""

    power: np.ndarray  # Σ |f̂|² over the modes of q = 0 (and below the first edge), each bin, and beyond: (m + 2,)
    acf: np.ndarray | None = None  # Σ C(Δr) over the points of each bin of lags: (k + 2,)
    acf_x: np.ndarray | None = None  # C(Δx, 0): (nx//2 + 1,)
    acf_y: np.ndarray | None = None  # C(0, Δy): (ny//2 + 1,)


class Correlator:
    """Bins for spectra and autocorrelations on a grid.  Collective to make.

    q_edges (m + 1,): bins of |q|, q_edges[i] < |q| ≤ q_edges[i+1]; r_edges (k + 1,): those of the periodic |Δr|.
    """

    def __init__(self, grid: SlabGrid, q_edges: np.ndarray, r_edges: np.ndarray):
        self.grid, self.q_edges, self.r_edges = grid, np.asarray(q_edges), np.asarray(r_edges)
        x, y = (_fold(n) * step for n, step in zip(grid.shape, grid.spacing, strict=True))
        self._modes = _Bins(grid, grid.qx[0] ** 2, grid.qy[:, 0] ** 2, grid.hermitian_weight[:, 0], self.q_edges)
        self._lags = _Bins(grid, y**2, x[grid.rows] ** 2, np.ones(grid.local_shape[0]), self.r_edges)

    def measure(self, fill: Rows, acf: bool = False, watch: Columns | None = None) -> Measured:
        """Spectrum, and on demand autocorrelation, of the field whose rows `fill` makes.  Collective.

        One forward transform, and one backward for the autocorrelation ⟨f(r) f(r + Δr)⟩.
        watch(power, first, stop) sees each block |f̂|² (stop − first, nx), on any thread.
        """
        grid, power, lags = self.grid, {}, {}

        def square(block: np.ndarray, first: int, stop: int):
            parts = block.view(np.float64).reshape(*block.shape, 2)
            power_in_place(parts)
            power[first] = self._modes.sums(parts[..., 0], first, stop)
            if watch is not None:
                watch(parts[..., 0], first, stop)

        if not acf:
            grid.read_spectrum(fill, square)
            return Measured(self._modes.total(power))
        column, row = np.empty(grid.local_shape[0]), np.empty(grid.shape[1])

        def collect(first: int, stop: int, rows: np.ndarray):
            rows /= float(grid.size) ** 2
            lags[first] = self._lags.sums(rows, first, stop)
            column[first:stop] = rows[:, 0]
            if first == 0:
                row[:] = rows[0]

        grid.convolve(fill, square, collect)
        grid.comm.Bcast(row)  # that of rank 0, which holds Δx = 0
        (nx, ny), counts = grid.shape, np.diff(grid.starts)
        along_x = np.empty(nx)
        grid.comm.Allgatherv(column, [along_x, counts])
        return Measured(self._modes.total(power), self._lags.total(lags), along_x[: nx // 2 + 1], row[: ny // 2 + 1])

    def spectrum(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """Means over the bins, given sums (m + 2,): q, value and count of those that hold modes, edges of all."""
        q, value, count = self._modes.mean(sums)
        return {"q": q, "value": value, "count": count, "edges": self.q_edges}

    def radial(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        """The same for an autocorrelation, sums (k + 2,): r, value, count and edges."""
        r, value, count = self._lags.mean(sums)
        return {"r": r, "value": value, "count": count, "edges": self.r_edges}

    def along(self, values: np.ndarray, axis: int) -> dict[str, np.ndarray]:
        """An autocorrelation along an axis as r and value, with one point in each bin of one grid spacing."""
        step = self.grid.spacing[axis]
        steps = np.arange(len(values) + 1)
        return {"r": steps[:-1] * step, "value": values, "count": np.ones(len(values)), "edges": (steps - 0.5) * step}


class _Bins:
    """Sums over bins of √(along[i] + across[j]); entry 0 is what lies below the first edge, the last what is beyond."""

    def __init__(self, grid: SlabGrid, along, across, weight, edges):
        self.comm, self.along, self.across, self.weight = grid.comm, along, across, np.ascontiguousarray(weight)
        self.edges = np.sign(edges) * np.square(edges)
        counts, roots = {}, {}

        def part(first: int, stop: int):
            counts[first], roots[first] = np.zeros((2, len(edges) + 1))
            rows = across[first:stop], self.weight[first:stop]
            bin_geometry(along, *rows, self.edges, counts[first], roots[first])

        grid.threads.split(part, len(across))
        self.count, self.roots = self.total(counts), self.total(roots)

    def sums(self, values: np.ndarray, first: int, stop: int) -> np.ndarray:
        """Weighted sums of values (stop − first, n) over the bins."""
        out = np.zeros(len(self.edges) + 1)
        bin_rows(values, self.along, self.across[first:stop], self.weight[first:stop], self.edges, out)
        return out

    def total(self, parts: dict[int, np.ndarray]) -> np.ndarray:
        """Sum of the parts over blocks, in their order whatever thread made them, and over the ranks.  Collective."""
        out = np.sum([np.zeros(len(self.edges) + 1), *(parts[first] for first in sorted(parts))], axis=0)
        self.comm.Allreduce(MPI.IN_PLACE, out)
        return out

    def mean(self, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean place, mean value and count of each bin that holds something."""
        inner = slice(1, len(self.edges))
        filled = self.count[inner] > 0
        count, roots, sums = (entry[inner][filled] for entry in (self.count, self.roots, sums))
        return roots / count, sums / count, count


def _fold(n: int) -> np.ndarray:
    """Periodic distances of the points 0 … n−1 from point 0, in grid spacings."""
    return np.minimum(np.arange(n), n - np.arange(n)).astype(float)


def wave_number_bins(grid: SlabGrid, spacing: str = "log", bins: int = 20, q_max: float | None = None) -> np.ndarray:
    """Edges (m + 1,) of bins in |q|: `bins` to a decade ("log") or in all up to the largest |q| or q_max ("linear").

    Raises InputError for another spacing.
    """
    if spacing == "linear":
        top = np.hypot(*(np.pi * (n // 2 * 2) / length for n, length in zip(grid.shape, grid.lengths, strict=True)))
        top = top if q_max is None else min(q_max, top)
        return bin_edges(grid.shape, grid.lengths, "linear", width=top / bins or 1.0, q_max=q_max)
    return bin_edges(grid.shape, grid.lengths, spacing, per_decade=bins, q_max=q_max)


def lag_bins(grid: SlabGrid, spacing: str = "log", bins: int = 20) -> np.ndarray:
    """Edges (k + 1,) of bins in distance, up to half the shorter side: `bins` to a decade, or in all ("linear").

    The first bin holds Δr = 0 alone.  Raises InputError for another spacing.
    """
    half, step = min(grid.lengths) / 2, min(grid.spacing)
    if spacing != "log":
        return lag_edges(grid.shape, grid.lengths, half / bins)
    count = max(int(np.ceil(bins * np.log10(half / step) + 0.5)), 0)
    edges = step * 10 ** ((np.arange(count + 1) - 0.5) / bins)
    edges = np.concatenate([[-edges[0], min(edges[0], step / 2)], edges[1:]]) if len(edges) > 1 else np.array([-half])
    return np.append(edges[edges < half], half) * (1 + HAIR)
