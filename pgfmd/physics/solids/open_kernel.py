"""The compliance of an elastic solid that is loaded on a patch only: the kernel of a point load, cut off at the torus.

On a half-space the kernel is 1/(π E' r).  Split at a length 1/α of a few spacings, its short-ranged part is the one
that the modes of the grid resolve, as in a periodic cell; the long-ranged part is smooth, and summed on the torus:

    Â(q) = (2/E'|q|) erf(|q|/2α) + (aₓ a_y/πE') Σ_r erf(α r)/r cos(q·r),

the first term 2/(√π α E') at q = 0, the summand 2α/√π at r = 0, and r the least distance on the torus.  The sum runs
over the rows and columns of a quadrant, as Â is even in qx and in qy.

A layer of thickness d adds (1/πE') ∫ (1/F(q) − 1) J0(qr) dq to the kernel, which is smooth over d.  If d is of the
order of a spacing, only the part that erfc(q/2α) leaves is summed, the rest is a factor of modes.  On a rigid base
kernels fall off exponentially over d: the modes of a torus that is much wider than d are those of a periodic cell.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.domain import SPLIT
from pgfmd.grid.kernels import scale_even
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import ColumnAction
from pgfmd.parallel.collectives import slab_starts
from pgfmd.parallel.mpi import MPI, datatype

CLOSE = 6.0  # α r from which erf is 1 in double precision
THIN = 0.04  # thickness over half a side of the torus up to which images of a slab on a rigid base are below 1e-12
RESOLVED = 1.5, 3.0  # spacings of a thickness from which the grid resolves what it adds: of a layer, of a slab
THICK = 25.0  # q d from which F is 1 to the last digit
BAND = 64  # rows at a time, so that temporary arrays stay small
NODES = 600  # of the spline: its error is below 1e-9 of the values


class Layer(Protocol):
    """What of a solid counts here; see `Solid`."""

    @property
    def thickness(self) -> float: ...
    @property
    def contact_modulus(self) -> float: ...
    def factor(self, q: np.ndarray) -> np.ndarray: ...
    def compliance(self, q: np.ndarray) -> np.ndarray: ...
    def mean_stiffness(self, periodic: bool = True) -> float: ...


def half_space_table(grid: SlabGrid) -> np.ndarray:
    """E' Â(q) of a half-space for the modes of this rank with kx ≥ 0: (nky_local, Nx // 2 + 1).  Collective."""
    alpha = SPLIT / max(grid.spacing)
    table = cosine_transform(grid, lambda x, y: _long_ranged(x, y, alpha))
    from scipy.special import erf  # slow to import

    for first in range(0, len(table), BAND):
        q = np.sqrt(half_q_squared(grid, first, min(first + BAND, len(table))))
        near = np.full(q.shape, 2 / (math.sqrt(math.pi) * alpha))
        table[first : first + BAND] += np.divide(2 * erf(q / (2 * alpha)), q, out=near, where=q > 0)
    return table


def layer_table(grid: SlabGrid, solid: Layer) -> np.ndarray:
    """E' Â(q) of a slab on a rigid base or a layer on a half-space.  Collective."""
    d, q, rigid = solid.thickness, np.sqrt(half_q_squared(grid)), solid.mean_stiffness(periodic=False)
    if rigid > 0 and d <= THIN * min(grid.period) / 2:
        table = solid.contact_modulus * solid.compliance(q)
        table[q == 0] = solid.contact_modulus / rigid
        return table
    resolved = d >= RESOLVED[rigid > 0] * max(grid.spacing)
    if rigid > 0 and not resolved:  # the kernel of a torus on which d is thin, cut off
        nx, ny = (max(n, math.ceil(1.01 * d / (THIN * a))) for n, a in zip(grid.shape, grid.spacing, strict=True))
        wide = grid.like(grid.comm, (nx, ny), (nx * grid.spacing[0], ny * grid.spacing[1]))
        return cropped_table(wide, grid, layer_table(wide, solid))
    alpha = SPLIT / max(grid.spacing)
    cut = not rigid and not resolved
    change = _change(solid, math.hypot(*grid.period) / 2, alpha if cut else math.inf)
    table = half_space_table(grid)
    table += cosine_transform(grid, lambda x, y: change(np.hypot(x, y)))
    if cut:
        from scipy.special import erf

        waves = np.where(q > 0, q, 1e-9 / d)
        table += (1 / solid.factor(waves) - 1) * 2 * erf(waves / (2 * alpha)) / waves
    return table


def _change(solid: Layer, furthest: float, alpha: float) -> Callable[[np.ndarray], np.ndarray]:
    """∫ (1/F(q) − 1) erfc(q/2α) J0(qr) dq as a function of r up to `furthest`: a spline between values by Gauss's rule
    on pieces that J0 crosses about once.
    """
    from scipy.interpolate import CubicSpline  # slow to import
    from scipy.special import erfc, j0

    d = solid.thickness
    end = min(THICK / d, 12 * alpha)
    pieces = max(50, int(end * furthest / math.pi) + 1)
    points, weights = np.polynomial.legendre.leggauss(6)
    q = ((np.arange(pieces)[:, None] + (points + 1) / 2) * (end / pieces)).ravel()
    weight = np.tile(weights, pieces) * (end / pieces / 2) * (1 / solid.factor(q) - 1)
    weight *= erfc(q / (2 * alpha)) if alpha < math.inf else 1.0
    scale = d if alpha == math.inf else max(d, 1 / alpha)
    places = np.linspace(0.0, math.asinh(furthest / scale), NODES)
    spline = CubicSpline(places, [float(weight @ j0(q * r)) for r in scale * np.sinh(places)])
    return lambda r: spline(np.arcsinh(r / scale))


def _long_ranged(x: np.ndarray, y: np.ndarray, alpha: float) -> np.ndarray:
    """erf(α r)/r at the points (x, y), of rows x and columns y."""
    from scipy.special import erf

    r = np.hypot(x, y)
    out = np.divide(1.0, r, out=np.full(r.shape, 2 * alpha / math.sqrt(math.pi)), where=r > 0)
    close = np.ix_(x[:, 0] * alpha < CLOSE, y[0] * alpha < CLOSE)
    out[close] *= np.where(r[close] > 0, erf(alpha * r[close]), 1.0)
    return out


def half_q_squared(grid: SlabGrid, first: int = 0, stop: int | None = None) -> np.ndarray:
    """|q|² of the modes with kx ≥ 0 of this rank: (columns, Nx // 2 + 1)."""
    return grid.qx[:, : grid.torus[0] // 2 + 1] ** 2 + grid.qy[first:stop] ** 2


def cosine_transform(grid: SlabGrid, kernel: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """aₓ a_y/π Σ kernel(x, y) cos(q·r) over the torus, (nky_local, Nx // 2 + 1), by a quadrant; kernel: at rows x
    (count, 1) and columns y (1, Ny // 2 + 1).  Collective.
    """
    starts = slab_starts(grid.torus[0] // 2 + 1, grid.comm.size)
    x = np.arange(starts[grid.comm.rank], starts[grid.comm.rank + 1])[:, None] * grid.spacing[0]
    y = np.arange(grid.torus[1] // 2 + 1)[None, :] * grid.spacing[1]
    rows = np.empty((len(x), y.size))
    for first in range(0, len(x), BAND):
        part = slice(first, first + BAND)
        np.multiply(kernel(x[part], y), grid.pixel_area / math.pi, out=rows[part])
    return _cosines(grid, rows, y.size)


def cropped_table(wide: SlabGrid, grid: SlabGrid, table: np.ndarray) -> np.ndarray:
    """The table, like `half_space_table`, of a grid of the same spacing and ranks and a smaller torus, whose points
    respond to each other as those of `wide` do, which has the given table.  Collective.
    """
    counts = [n // 2 + 1 for n in grid.torus]
    entries = _cosines(wide, table.copy(), counts[0])[:, : counts[1]] / wide.modes
    return _cosines(grid, entries, counts[1])


def _cosines(grid: SlabGrid, rows: np.ndarray, count: int) -> np.ndarray:
    """Σ f(i, j) cos(π i k/I) cos(π j m/J) over −I < i ≤ I, −J < j ≤ J of an even f, (count split over the ranks, I + 1)
    with m first, of which the first `count`; rows: (I + 1 split over the ranks, J + 1), overwritten.  Collective.
    """
    from scipy.fft import dct

    rows = dct(rows, type=1, axis=1, workers=grid.threads.count, overwrite_x=True)
    starts = slab_starts(count, grid.comm.size)
    if (comm := grid.comm).size > 1:  # counted in numbers: bytes may be more than 2³¹
        parts = [rows[:, first:stop].copy() for first, stop in zip(starts[:-1], starts[1:], strict=True)]
        pieces, item = [np.empty((n, parts[comm.rank].shape[1])) for n in comm.allgather(len(rows))], datatype(float)
        requests = [comm.Irecv([piece, item], rank) for rank, piece in enumerate(pieces)]
        MPI.Request.Waitall(requests + [comm.Isend([part, item], rank) for rank, part in enumerate(parts)])
        rows = np.concatenate(pieces)
    turned = np.ascontiguousarray(rows[:, : starts[grid.comm.rank + 1] - starts[grid.comm.rank]].T)
    return dct(turned, type=1, axis=1, workers=grid.threads.count, overwrite_x=True)


def positive(grid: SlabGrid, table: np.ndarray) -> np.ndarray:
    """The table; raises InputError unless all its entries are positive.  Collective."""
    if not (least := grid.reduction.min(table)) > 0:
        nx, ny = grid.shape
        raise InputError(
            f'grid.boundary = "open": the response of {nx} x {ny} points with spacings {grid.spacing[0]:g} and '
            f"{grid.spacing[1]:g} is not positive ({least:.2g}); take pixels or sides that are less oblong"
        )
    return table


def multiply_even(grid: SlabGrid, dtype: np.dtype, factor: float, table: np.ndarray, divide: bool) -> ColumnAction:
    """Column action that multiplies each mode by factor · table, or by factor/table except for the mean mode, which
    becomes 0.
    """
    real, has_mean = np.dtype(dtype), divide and grid.columns.start == 0

    def act(block: np.ndarray, first: int, stop: int) -> None:
        scale_even(block.view(real).reshape(*block.shape, 2), table[first:stop], factor, divide)
        if has_mean and first == 0:
            block[0, 0] = 0

    return act
