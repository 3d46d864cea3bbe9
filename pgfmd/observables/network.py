"""Flow through the faces between neighbouring points of a periodic grid, bounded from both sides.

With conductances T of the faces and potentials u of the points, a drop of 1 across the cell drives the flow K, the
least Σ T (u_j − u_i + w)² over u, w = ±1 on faces across the cell's border and 0 elsewhere.  The energy of any u is a
bound from above.  If a flux f balances the residual r = b − Au (Σ_j f_ij = r_i), the energy less Σ f²/T is one from
below, since Σ f²/T is at least ⟨r, A⁻¹r⟩; T(u_i − u_j − w) + f is then a flux that is balanced in each point.

At the start the total pressure is constant in the largest aggregates, so that the drop lies on the faces between them:
from u = 0 the energy would begin up to 3e7 times too high.  f is made on the coarsest level, shared over finer faces in
proportion to T, and balanced in each aggregate.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from pgfmd.errors import InputError, SolverError
from pgfmd.grid.slab_grid import SlabGrid
from pgfmd.observables import flow_graph
from pgfmd.observables.flow_graph import Graph, crossing, face
from pgfmd.observables.multigrid import Halo, Level
from pgfmd.observables.patch_table import label_patches
from pgfmd.parallel.compiled import compiled

MOST, PATIENCE = 300, 12  # iterations; those without halving the error, after which the bounds stay as they are
SURE = 0.2  # of the width: error, as the multigrid estimates it, at which bounds are computed first
SINGLE = 1e-5  # for widths from here on conductances are in single precision, 8 bytes less; the bounds allow for it
NEGLIGIBLE = 1e-6  # of the largest gap: smaller ones count as closed if paths are left.  What rounding leaves in pools
# behind them would have to leave through them, and the bounds would be as far apart.


class Flow(NamedTuple):
    """Bounds of K in T's unit; the balanced flux to the next row and column (nx_local, ny) if asked for; iterations."""

    lower: float
    upper: float
    fluxes: tuple[np.ndarray, np.ndarray] | None
    iterations: int


def slab_graph(grid: SlabGrid, down: np.ndarray, right: np.ndarray) -> Graph:
    """The graph of conductances to the next row and column (nx_local, ny), 0 without a face.  Collective."""
    (around,), (nx, ny) = grid.neighbours([down]), down.shape
    weight = np.concatenate([around[:1], down, right])
    flags = np.zeros(down.shape, np.int8)
    flags[:, 0] += flow_graph.LEFTMOST
    flags[:, -1] += flow_graph.RIGHTMOST
    flags[0] += flow_graph.BORDER_ABOVE * (grid.rows.start == 0)
    flags[-1] += flow_graph.BORDER_BELOW * (grid.rows.stop == grid.shape[0])
    other = np.array([nx * ny, ny], np.int32)
    return Graph(np.empty(0, np.int64), other, weight.ravel(), flags.ravel())


def flow_of(grid: SlabGrid, graph: Graph, axis: int, width: float, with_flux: bool = False) -> Flow:
    """The flow through a graph of a slab along x (axis 0) or y (1): K to bounds of that relative width, or to what
    rounding leaves.  Raises SolverError if the iteration does not end.  Collective.
    """
    n, ny = graph.other
    level = Level(graph, Halo(grid.comm, n, [np.arange(ny), np.arange(n - ny, n)], [ny, ny]))
    kind = (flow_graph.ACROSS_X, flow_graph.ACROSS_Y)[axis]
    r, step, moved = level.new(), None, True
    sources(graph, kind, r)
    u = level.start(r, kind)
    level.rest(r, u, r)
    ready, least, since = SURE * width, math.inf, 0
    for iteration in range(MOST):
        z = level.cycle(r)
        estimate = level.dot(r, z)
        upper = level.form(u, u, kind)
        if estimate < least / 2:
            least, since = estimate, iteration
        stuck = iteration - since >= PATIENCE or not estimate > 0 or not moved
        if estimate <= ready * upper or stuck:
            del z  # it and the direction would be there at the peak of memory
            step = None
            r[:] = 0  # the updated residual drifts from that of u, to which the bounds belong
            sources(graph, kind, r)
            flux, square = level.fluxes(level.rest(r, u, r), with_flux)
            square = grid.reduction.sum(square) / 2
            if square <= width * upper or stuck:
                del r  # as memory peaks with the flux
                fluxes = forward_faces(graph, kind, u, flux) if with_flux else None
                return Flow(max(upper - square, 0.0), upper, fluxes, iteration)
            z = level.cycle(r)
            ready = 0.7 * width * estimate / square
        step = level.advance(u, r, z, step)
        moved = step is not None
        del z
    raise SolverError(f"leakage: no bounds after {MOST} iterations")


def flow_through(
    grid: SlabGrid, gap: np.ndarray, mask: np.ndarray, axis: int, width: float, with_flux: bool = False
) -> Flow:
    """The flow through a gap (nx_local, ny) where a mask is set, as `flow_of` gives it: K for g³ as conductivity,
    the flux per width for a mean gradient of −1.  Collective.

    Components that do not wind around the cell along the axis carry nothing, and are left out.
    """
    unit = float(grid.reduction.max(gap[mask]))
    for least in (NEGLIGIBLE * unit, 0.0):
        labels = label_patches(grid.comm, mask & (gap > least), grid.starts, 4)
        own = np.flatnonzero(labels.winds[:, axis]) + labels.kept_from
        winding = np.concatenate(grid.comm.allgather(own))
        if len(winding):
            break
    else:
        return Flow(0.0, 0.0, (np.zeros(mask.shape), np.zeros(mask.shape)) if with_flux else None, 0)
    cube = unit * unit * unit
    if not 1e-280 < cube < 1e280:
        raise InputError(f"leakage: the cube of the largest gap, {unit:g}, is beyond double precision: change the unit")
    mask = np.isin(labels.label_field(), winding)
    del labels
    smallest = (least / unit) ** 3 * min(grid.spacing) / max(grid.spacing)
    single = width >= SINGLE and smallest > np.finfo(np.float32).tiny
    graph = conductances(grid, gap, mask, unit, np.float32 if single else np.float64)
    del mask
    rounding = float(np.finfo(np.float32).eps) if single else 0.0  # no T changes by a larger part, so K does not
    found = flow_of(grid, graph, axis, width - 2 * rounding, with_flux)
    (lx, ly), (ax, ay) = grid.lengths, grid.spacing
    scale = cube * (lx / ly if axis == 0 else ly / lx)
    fluxes = found.fluxes
    if fluxes is not None:
        drop = cube * grid.lengths[axis]
        fluxes = fluxes[0] * (drop / ay), fluxes[1] * (drop / ax)
    bounds = scale * (1 - rounding) * found.lower, scale * (1 + rounding) * found.upper
    return Flow(*bounds, fluxes, found.iterations)


def conductances(grid: SlabGrid, gap: np.ndarray, mask: np.ndarray, unit: float, dtype: DTypeLike = float) -> Graph:
    """The graph of the points of a mask whose faces have the harmonic mean of (gap/unit)³.  Collective."""
    k = np.where(mask, gap / unit, 0.0)
    for row in k:
        row *= row * row
    after, (ax, ay) = grid.neighbours([k])[0][1:], grid.spacing
    down, right = np.empty(k.shape, dtype), np.empty(k.shape, dtype)
    harmonic_means(k, after, (ay / ax, ax / ay), (down, right))
    return slab_graph(grid, down, right)


@compiled()
def harmonic_means(
    k: np.ndarray, after: np.ndarray, ratios: tuple[float, float], faces: tuple[np.ndarray, np.ndarray]
) -> None:
    """Ratios times the harmonic means of k (nx_local, ny) and the next row's and column's, 0 where either is 0."""
    nx, ny = k.shape
    for i in range(nx):
        below = k[i + 1] if i + 1 < nx else after[0]
        for j in range(ny):
            a, down, right = k[i, j], below[j], k[i, j + 1 if j + 1 < ny else 0]
            faces[0][i, j] = 2 * a * down / (a + down) * ratios[0] if a * down > 0 else 0.0
            faces[1][i, j] = 2 * a * right / (a + right) * ratios[1] if a * right > 0 else 0.0


@compiled()
def sources(graph: Graph, kind: int, out: np.ndarray) -> None:
    """b_i = Σ_j T_ij w_ij."""
    first, other, weight, border = graph
    for i in range(len(border)):
        for k in range(4 * i, 4 * i + (4 if border[i] else 0)):
            _, t, crossed = face(first, other, weight, border, i, k)
            out[i] += t * crossing(crossed, kind)


@compiled()
def forward_faces(graph: Graph, kind: int, u: np.ndarray, flux: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T (u_j − u_i + w) − f of the faces to the next row and to the next column (nx_local, ny)."""
    first, other, weight, border = graph
    out = np.empty((2, len(border)))
    for i in range(len(border)):
        for side in (2, 3):
            j, t, crossed = face(first, other, weight, border, i, 4 * i + side)
            out[side - 2, i] = t * (u[j] - u[i] + crossing(crossed, kind)) - flux[2 * i + side - 2]
    return out[0].reshape(-1, other[1]), out[1].reshape(-1, other[1])
