"""The compliance of an elastic solid that is loaded on a patch only: the kernel of a point load, cut off at the torus.

On a half-space the kernel is 1/(π E' r).  It is split at a length 1/α of a few spacings.  The short-ranged part acts as
in a periodic cell, on the modes that the grid resolves; the long-ranged part is smooth, and summed on the torus:

    Â(q) = (2/E'|q|) erf(|q|/2α) + (aₓ a_y/πE') Σ_r erf(α r)/r cos(q·r),

the first term 2/(√π α E') at q = 0, the summand 2α/√π at r = 0, and r the least distance on the torus.  The sum runs
over the rows and columns of a quadrant, as Â is even in qx and in qy.

A layer of thickness d adds (1/πE') ∫ (1/F(q) − 1) J0(qr) dq to the kernel, which is smooth over d.  If d is of the
order of a spacing, erfc(q/2α) times the integrand is summed on the torus, and the rest is added to the compliance of
the modes, as in a periodic cell.  On a rigid base the kernel falls off exponentially over d: the modes of a torus that
is much wider than d are those of a periodic cell.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.domain import SPLIT
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.grid.transforms import ColumnAction
from pgfmd.parallel.collectives import slab_starts
from pgfmd.parallel.mpi import MPI, datatype
from pgfmd.physics.solids.solid import Solid, half_q_squared

CLOSE = 6.0  # α r from which erf is 1 in double precision
THIN = 0.04  # thickness over half a side of the torus up to which images of a slab on a rigid base are below 1e-12
RESOLVED = 1.5, 3.0  # least thickness, in spacings, whose change of the kernel the grid resolves: of a layer, of a slab
THICK = 25.0  # q d from which F is 1 to the last digit
BAND = 64  # rows at a time, so that temporary arrays stay small
NODES = 600  # of the spline: its error is below 1e-9 of the values


def half_space_table(grid: SlabGrid) -> np.ndarray:
    """E' Â(q) of a half-space for the modes of this rank with kx ≥ 0: (nky_local, Nx // 2 + 1).  Collective."""
    return _table(grid, SPLIT / max(grid.spacing), 0.0, True)


def tangential_action(grid: SlabGrid, poisson: float, along: bool) -> ColumnAction:
    """Column action: E'(1 − ν)/N times the displacement along x or, unless `along`, along y, of a half-space under a
    traction along x.  Collective.
    """
    # In a cell α is so small that the long-ranged part is left out.
    alpha = 0.05 / max(grid.period) if grid.domain.wraps else SPLIT / max(grid.spacing)
    table, sign = _table(grid, alpha, poisson, along), 1 if along else -1
    table /= grid.modes
    most = table.shape[1]

    def act(block: np.ndarray, first: int, stop: int) -> None:
        block[:, :most] *= table[first:stop]
        block[:, most:] *= sign * table[first:stop, block.shape[1] - most : 0 : -1]

    return act


def _table(grid: SlabGrid, alpha: float, poisson: float, along: bool) -> np.ndarray:
    """The symbol of `tangential_action`; at ν = 0 along x, E' Â(q).  Collective.

    π times the kernels: (1 − ν)/r + νx²/r³ and νxy/r³ (Johnson, Contact Mechanics, 1985, section 3.6), which are
    1/r − ν∂²r/∂x² and −ν∂²r/∂x∂y.  With r erf(α r) + exp(−α²r²)/√π α for the long-ranged part ϱ of r

        ∂²ϱ/∂x² = g x²/r² + erf(α r) y²/r³,        g = (2α/√π) exp(−α²r²),

    and r − ϱ has the modes −s/q², s = (2/q) erf(q/2α) − (2/√π α) exp(−q²/4α²).
    """
    from scipy.special import erf  # slow to import

    def kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        far = _long_ranged(x, y, alpha)
        if not poisson:
            return far
        r = np.hypot(x, y)  # no squares of lengths: they may overflow
        near, origin = 2 * alpha / math.sqrt(math.pi) * np.exp(-((alpha * r) ** 2)), r == 0
        cos, sin = x / (r + origin), y / (r + origin)
        change = near * cos**2 + far * (sin**2 + origin) if along else (near - far) * cos * sin
        return far * along - poisson * change

    most = grid.torus[0] // 2 + 1
    if grid.domain.wraps or not (along or poisson):
        table = np.zeros((grid.spectral_shape[0], most))
    else:
        table = cosine_transform(grid, kernel, odd=not along)
    for first in range(0, len(table), BAND):
        part = slice(first, min(first + BAND, len(table)))
        qx, qy = grid.qx[:, :most], grid.qy[part]
        q = np.maximum(np.hypot(qx, qy), 1e-8 * alpha)  # squares may underflow
        near = 2 * erf(q / (2 * alpha)) / q
        table[part] += near * along
        if poisson:
            near -= 2 / math.sqrt(math.pi) / alpha * np.exp(-((q / (2 * alpha)) ** 2))
            table[part] -= poisson * near * (qx / q) * ((qx if along else qy) / q)
    return table


def layer_table(grid: SlabGrid, solid: Solid, d: float) -> np.ndarray:
    """E' Â(q) of a slab on a rigid base, a layer on a half-space or, with d = inf, a half-space.  Collective."""
    if math.isinf(d):
        return half_space_table(grid)
    q, rigid = np.sqrt(half_q_squared(grid)), solid.mean_stiffness(periodic=False)
    if rigid > 0 and d <= THIN * min(grid.period) / 2:
        table = solid.contact_modulus * solid.compliance(q)
        table[q == 0] = solid.contact_modulus / rigid
        return table
    resolved = d >= RESOLVED[rigid > 0] * max(grid.spacing)
    if rigid > 0 and not resolved:  # the kernel of a torus on which d is thin, cut off
        nx, ny = (max(n, math.ceil(1.01 * d / (THIN * a))) for n, a in zip(grid.shape, grid.spacing, strict=True))
        wide = grid.like(grid.comm, (nx, ny), (nx * grid.spacing[0], ny * grid.spacing[1]))
        return cropped_table(wide, grid, layer_table(wide, solid, d))
    alpha = SPLIT / max(grid.spacing)
    cut = not rigid and not resolved
    change = _change(solid, d, math.hypot(*grid.period) / 2, alpha if cut else math.inf)
    table = half_space_table(grid)
    table += cosine_transform(grid, lambda x, y: change(np.hypot(x, y)))
    if cut:
        from scipy.special import erf

        waves = np.where(q > 0, q, 1e-9 / d)
        table += (1 / solid.factor(waves) - 1) * 2 * erf(waves / (2 * alpha)) / waves
    return table


def _change(solid: Solid, d: float, furthest: float, alpha: float) -> Callable[[np.ndarray], np.ndarray]:
    """∫ (1/F(q) − 1) erfc(q/2α) J0(qr) dq as a function of r up to `furthest`: a spline through values by Gauss's rule,
    on pieces with about one zero of J0 each.
    """
    from scipy.interpolate import CubicSpline  # slow to import
    from scipy.special import erfc, j0

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


def cosine_transform(
    grid: SlabGrid, kernel: Callable[[np.ndarray, np.ndarray], np.ndarray], odd: bool = False
) -> np.ndarray:
    """aₓ a_y/π Σ kernel(x, y) exp(−iq·r) over the torus, (nky_local, Nx // 2 + 1), by a quadrant; kernel: at rows x
    (count, 1) and columns y (1, Ny // 2 + 1), even in x and in y, or odd in both.  Collective.
    """
    starts = slab_starts(grid.torus[0] // 2 + 1, grid.comm.size)
    x = np.arange(starts[grid.comm.rank], starts[grid.comm.rank + 1])[:, None] * grid.spacing[0]
    y = np.arange(grid.torus[1] // 2 + 1)[None, :] * grid.spacing[1]
    rows = np.empty((len(x), y.size))
    for first in range(0, len(x), BAND):
        part = slice(first, first + BAND)
        np.multiply(kernel(x[part], y), grid.pixel_area / math.pi, out=rows[part])
    sums = _cosines(grid, rows, y.size, odd)
    return -sums if odd else sums


def cropped_table(wide: SlabGrid, grid: SlabGrid, table: np.ndarray) -> np.ndarray:
    """The table, like `half_space_table`, of a `grid` with a smaller torus than `wide`, and the same spacing and ranks,
    by the kernel of `wide`, whose table is given.  Collective.
    """
    counts = [n // 2 + 1 for n in grid.torus]
    entries = _cosines(wide, table.copy(), counts[0])[:, : counts[1]] / wide.modes
    return _cosines(grid, entries, counts[1])


def _cosines(grid: SlabGrid, rows: np.ndarray, count: int, odd: bool = False) -> np.ndarray:
    """Σ f(i, j) cos(π i k/I) cos(π j m/J) over −I < i ≤ I, −J < j ≤ J of an even f, (count split over the ranks, I + 1)
    with m first, of which the first `count`; sines of an odd f; rows: (I + 1 split over the ranks, J + 1), overwritten.
    Collective.
    """
    rows = _along_rows(rows, grid.threads.count, odd)
    starts = slab_starts(count, grid.comm.size)
    if (comm := grid.comm).size > 1:  # counted in numbers: bytes may be more than 2³¹
        parts = [rows[:, first:stop].copy() for first, stop in zip(starts[:-1], starts[1:], strict=True)]
        pieces, item = [np.empty((n, parts[comm.rank].shape[1])) for n in comm.allgather(len(rows))], datatype(float)
        requests = [comm.Irecv([piece, item], rank) for rank, piece in enumerate(pieces)]
        MPI.Request.Waitall(requests + [comm.Isend([part, item], rank) for rank, part in enumerate(parts)])
        rows = np.concatenate(pieces)
    turned = np.ascontiguousarray(rows[:, : starts[grid.comm.rank + 1] - starts[grid.comm.rank]].T)
    return _along_rows(turned, grid.threads.count, odd)


def _along_rows(rows: np.ndarray, workers: int, odd: bool) -> np.ndarray:
    """Σ rows[:, j] cos(π j m/J) over −J < j ≤ J, or with sines; the rows are overwritten."""
    from scipy.fft import dct, dst

    if not odd:
        return np.asarray(dct(rows, type=1, axis=1, workers=workers, overwrite_x=True))
    rows[:, [0, -1]] = 0
    rows[:, 1:-1] = dst(rows[:, 1:-1], type=1, axis=1, workers=workers)
    return rows


def positive(grid: SlabGrid, table: np.ndarray) -> np.ndarray:
    """The table; raises InputError unless all its entries are positive.  Collective."""
    if not (least := grid.reduction.min(table)) > 0:
        nx, ny = grid.shape
        raise InputError(
            f'grid.boundary = "open": the response of {nx} x {ny} points with spacings {grid.spacing[0]:g} and '
            f"{grid.spacing[1]:g} is not positive ({least:.2g}); take pixels or sides that are less oblong"
        )
    return table


def kept_table(grid: SlabGrid, name: tuple, make: Callable[[], np.ndarray]) -> np.ndarray:
    """`positive` of make(), kept on the grid under the name.  Collective."""
    if name not in grid.tables:
        grid.tables[name] = positive(grid, make())
    return grid.tables[name]
